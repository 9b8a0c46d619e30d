/* An example: the controllers of all agents of the network in one process.
 *
 *     network < measured.csv > inputs.csv
 *
 * Reads what the agents measure at t = 0, h, 2 h, … (a line each: t, then the MEASURED values of every
 * agent, after a header; nan is not measured) and writes u of every agent from there on. Messages go
 * from agent to agent in memory, at once; in a plant they would go over a bus, and what is measured
 * and u to sensors and valves. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "agent.h"
#include "agents.h" /* AGENTS, LINKS, OWN_VALUES, SENDER, START and LEADER, generated */

static AgentInputs in[AGENTS];
static double memory[AGENTS][MEMORY], message[AGENTS][MESSAGE];

/* The next number of a line; 0 where there is none. */
static int take(char **text, double *value)
{
    char *end;
    *value = strtod(*text, &end);
    if (end == *text)
        return 0;
    *text = *end == ',' ? end + 1 : end;
    return 1;
}

static int measure(char *line, double *t)
{
    int good = take(&line, t);
    for (int i = 0; i < AGENTS; i++)
        for (int j = 0; j < MEASURED; j++)
            good &= take(&line, &in[i].measured[j]);
    return good;
}

static void exchange(const double *from_leader)
{
    for (int i = 0; i < AGENTS; i++) {
        memcpy(in[i].leader, from_leader, sizeof in[i].leader);
        for (int k = 0; k < HEARD; k++)
            if (SENDER[i][k] >= 0)
                memcpy(in[i].heard[k], message[SENDER[i][k]], sizeof in[i].heard[k]);
    }
}

int main(void)
{
    static char line[64 + AGENTS * MEASURED * 32];
    double t, leader[MEMORY], from_leader[MESSAGE], u[P];
    memcpy(leader, LEADER, sizeof leader);
    memcpy(memory, START, sizeof memory);
    if (!fgets(line, sizeof line, stdin))
        return 1; /* no header */
    printf("time");
    for (int i = 0; i < AGENTS; i++)
        for (int j = 0; j < P; j++)
            printf(",agent%d.u%d", i + 1, j + 1);
    printf("\n");
    while (fgets(line, sizeof line, stdin)) {
        if (!measure(line, &t)) {
            fprintf(stderr, "expected t and %d values in each line, got: %s", AGENTS * MEASURED, line);
            return 1;
        }
        for (int i = 0; i < AGENTS; i++)
            agent_send(OWN_VALUES[i], &in[i], memory[i], message[i]);
        agent_lead_send(leader, from_leader);
        exchange(from_leader);
        printf("%.17g", t);
        for (int i = 0; i < AGENTS; i++) {
            agent_act(&LINKS[i], OWN_VALUES[i], t, &in[i], memory[i], u);
            for (int j = 0; j < P; j++)
                printf(",%.17g", u[j]);
        }
        printf("\n");
        agent_lead(t, leader);
    }
    return 0;
}
