/* See agent.h. */
#include "agent.h"

#include <stddef.h>
#include <string.h>

static void disagree(const AgentLinks *links, const AgentInputs *in, AgentState *state)
{
    for (int j = 0; j < M; j++) {
        double heard = links->leader * in->s[j];
        for (int k = 0; k < HEARD; k++)
            heard += links->weight[k] * in->heard[k][j];
        state->disagreement[j] = links->own * state->xhat[j] - heard;
    }
}

static void innovate(const AgentInputs *in, const AgentState *state, double *innovation)
{
    double message[MESSAGE];
    controller_send(&CONTROLLER, NULL, state->xhat, in->y, message);
    memcpy(innovation, message + M, Q * sizeof *innovation);
}

const char *agent_begin(const AgentLinks *links, const AgentInputs *in, AgentState *state)
{
    if (!(links->own != 0))
        return "its parameter own is 0: set the parameters of an agent of the network";
    disagree(links, in, state);
#if DISTRIBUTED
    innovate(in, state, state->innovation);
#endif
    return NULL;
}

void agent_act(const AgentLinks *links, const AgentInputs *in, double t, AgentState *state)
{
    const double silence[2] = {0, 0};
    double disagreement[MESSAGE], next[MEMORY], u[P], sec_u[P];
    double *innovation = disagreement + M; /* as (5) or (22) weights it */
    memcpy(disagreement, state->disagreement, sizeof state->disagreement);
    innovate(in, state, innovation);
#if DISTRIBUTED
    memcpy(state->innovation, innovation, sizeof state->innovation); /* what neighbours hear next */
    for (int j = 0; j < Q; j++) {
        innovation[j] *= links->own_innovation;
        for (int k = 0; k < HEARD; k++)
            innovation[j] -= links->innovation_weight[k] * in->heard[k][M + j];
    }
#endif
    controller_step(&CONTROLLER, NULL, t, in->y, disagreement, silence, state->xhat, next, u, sec_u);
    memcpy(state->xhat, next, sizeof next);
    disagree(links, in, state);
}

void agent_show(const AgentState *state, AgentOutputs *out)
{
    controller_input(&CONTROLLER, state->disagreement, out->u, out->sec_u);
    memcpy(out->sent, state->xhat, M * sizeof *out->sent);
#if DISTRIBUTED
    memcpy(out->sent + M, state->innovation, Q * sizeof *out->sent);
#endif
}

void agent_lead(double t, double *s)
{
    double next[MEMORY];
    controller_leader(&CONTROLLER, t, s, next);
    memcpy(s, next, M * sizeof *s);
}
