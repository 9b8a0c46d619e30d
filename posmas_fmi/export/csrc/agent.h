/* The controller of one agent as it is shipped: what it measures and hears goes in, its input and what
 * it tells its neighbours come out. Nothing but doubles, pure functions, no library but math.h.
 *
 *     agent_begin    once, with what is known at the start
 *     agent_show     u, to be held over the period that begins now, and what is sent
 *     agent_act      over that period, with what was measured and heard at its beginning
 *
 * and so on with agent_show. What is heard at a communication point acts on u from the next one on:
 * every message takes one period. So no output depends on an input at the same time, and any master
 * or bus that passes values on once in a period gives the same result. */
#ifndef AGENT_H
#define AGENT_H

#include "controller.h"
#include "controller_data.h" /* HEARD, DISTRIBUTED and CONTROLLER, generated */

enum { SENT = M + (DISTRIBUTED ? Q : 0) };

/* In which agents differ: the weights of (6), phi included, and of (22). */
typedef struct {
    double own;                             /* of the agent's own estimate: 0 is no agent */
    double leader;                          /* 0: does not hear the leader */
    double weight[HEARD];                   /* of each neighbour's estimate; 0: there is none */
#if DISTRIBUTED
    double own_innovation;
    double innovation_weight[HEARD];
#endif
} AgentLinks;

typedef struct {
    double y[Q];                            /* measured */
    double heard[HEARD][SENT];              /* last message of each neighbour */
    double s[M];                            /* last message of the leader: its state */
} AgentInputs;

typedef struct {
    double xhat[M];                         /* the estimate */
    double disagreement[M];                 /* from which u follows */
#if DISTRIBUTED
    double innovation[Q];                   /* y - C xhat at the last communication point */
#endif
} AgentState;

typedef struct {
    double u[P];
    double sent[SENT];                      /* xhat, and the innovation where it is distributed */
    double sec_u[P];                        /* what the observer takes u for */
} AgentOutputs;

/* NULL, or why it cannot begin. */
const char *agent_begin(const AgentLinks *links, const AgentInputs *in, AgentState *state);
void agent_act(const AgentLinks *links, const AgentInputs *in, double t, AgentState *state);
void agent_show(const AgentState *state, AgentOutputs *out);

/* The leader: its state over one period. */
void agent_lead(double t, double *s);

#endif
