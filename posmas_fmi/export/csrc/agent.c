/* See agent.h. */
#include "agent.h"

#include <string.h>

enum { FIRST = MESSAGE - INNOVATION };

void agent_send(const double *own, const AgentInputs *in, const double *memory, double *message)
{
    controller_send(&CONTROLLER, own, memory, in->measured, message);
}

void agent_act(const AgentLinks *links, const double *own, double t, const AgentInputs *in,
               double *memory, double *u)
{
    double mine[MESSAGE], heard[MESSAGE] = {0}, disagreement[MESSAGE], next[MEMORY], applied[P];
    agent_send(own, in, memory, mine);
    for (int k = 0; k < HEARD; k++)
        for (int j = 0; j < MESSAGE; j++)
            heard[j] += (j < FIRST ? links->weight : links->innovation_weight)[k] * in->heard[k][j];
    for (int j = 0; j < FIRST; j++)
        disagreement[j] = links->own * mine[j] - heard[j] - links->leader * in->leader[j];
    for (int j = FIRST; j < MESSAGE; j++)
        disagreement[j] = links->own_innovation * mine[j] - heard[j];
    controller_step(&CONTROLLER, own, t, in->measured, disagreement, in->silence, memory, next, u,
                    applied);
    memcpy(memory, next, sizeof next);
}

void agent_lead_send(const double *memory, double *message)
{
    controller_leader_send(&CONTROLLER, memory, message);
}

void agent_lead(double t, double *memory)
{
    double next[MEMORY];
    controller_leader(&CONTROLLER, t, memory, next);
    memcpy(memory, next, sizeof next);
}
