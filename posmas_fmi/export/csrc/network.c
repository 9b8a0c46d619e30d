/* An example: the controllers of all agents of the network in one process.
 *
 *     network < measured.csv > inputs.csv
 *
 * Reads what the agents measure at t = 0, h, 2 h, … (a line each: t, then y of every agent, with a
 * header) and writes u of every agent from there on. Messages go from agent to agent in memory; in a
 * plant they would go over a bus, and y and u to sensors and valves. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "agent.h"
#include "agents.h" /* AGENTS, LINKS, SENDER, START and S0, generated */

static AgentInputs in[AGENTS];
static AgentState state[AGENTS];
static AgentOutputs out[AGENTS];

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
        for (int j = 0; j < Q; j++)
            good &= take(&line, &in[i].y[j]);
    return good;
}

static void exchange(const double *s)
{
    for (int i = 0; i < AGENTS; i++) {
        memcpy(in[i].s, s, sizeof in[i].s);
        for (int k = 0; k < HEARD; k++)
            if (SENDER[i][k] >= 0)
                memcpy(in[i].heard[k], out[SENDER[i][k]].sent, sizeof in[i].heard[k]);
    }
}

int main(void)
{
    static char line[64 + AGENTS * Q * 32];
    double t, s[M];
    memcpy(s, S0, sizeof s);
    for (int i = 0; i < AGENTS; i++)
        memcpy(state[i].xhat, START[i], sizeof START[i]);
    if (!fgets(line, sizeof line, stdin))
        return 1; /* no header */
    printf("time");
    for (int i = 0; i < AGENTS; i++)
        for (int j = 0; j < P; j++)
            printf(",agent%d.u%d", i + 1, j + 1);
    printf("\n");
    for (int begun = 0; fgets(line, sizeof line, stdin); begun = 1) {
        if (!measure(line, &t)) {
            fprintf(stderr, "expected t and %d values in each line, got: %s", AGENTS * Q, line);
            return 1;
        }
        for (int i = 0; !begun && i < AGENTS; i++)
            agent_show(&state[i], &out[i]); /* what they send at first */
        exchange(s);
        for (int i = 0; !begun && i < AGENTS; i++) {
            const char *why = agent_begin(&LINKS[i], &in[i], &state[i]);
            if (why) {
                fprintf(stderr, "agent %d cannot begin: %s\n", i + 1, why);
                return 1;
            }
            agent_show(&state[i], &out[i]);
        }
        exchange(s);
        printf("%.17g", t);
        for (int i = 0; i < AGENTS; i++)
            for (int j = 0; j < P; j++)
                printf(",%.17g", out[i].u[j]);
        printf("\n");
        for (int i = 0; i < AGENTS; i++) {
            agent_act(&LINKS[i], &in[i], t, &state[i]);
            agent_show(&state[i], &out[i]);
        }
        agent_lead(t, s);
    }
    return 0;
}
