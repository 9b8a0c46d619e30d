/* The controller of one agent as it is shipped: what the engine of the simulation does for an agent at
 * a communication point. Pure functions of doubles, no library but math.h. At each point t,
 *
 *     agent_send     what the agent tells those that hear it
 *     ...            the bus: messages come in, the last one of each neighbour stays
 *     agent_act      its input, to be held from t to t + CONTROLLER.h
 *
 * and `agent_lead_send`, `agent_lead` for the leader, wherever that runs. What is measured and heard
 * should be of t. Messages that are a period old, or lost now and then, are a matter for the
 * certificate: see README.md. */
#ifndef AGENT_H
#define AGENT_H

#include "controller.h"
#include "controller_data.h" /* HEARD and CONTROLLER, generated */

/* In which agents differ: the weights of their disagreement with what they hear. */
typedef struct {
    double own;                      /* of what the agent itself sends */
    double leader;                   /* of what the leader sends; 0: it is not heard */
    double weight[HEARD];            /* of what each neighbour sends; 0: there is none */
    double own_innovation;           /* the same for the last INNOVATION values of a message */
    double innovation_weight[HEARD];
} AgentLinks;

/* What an agent is told; measured as controller.h has it, silence is how long ago [s] the oldest of
 * the last messages of neighbours was sent, and that of the leader. */
typedef struct {
    double measured[MEASURED];
    double heard[HEARD][MESSAGE];
    double leader[MESSAGE];
    double silence[2];
} AgentInputs;

/* own: OWN values of the agent, or NULL where OWN is 0. */
void agent_send(const double *own, const AgentInputs *in, const double *memory, double *message);

/* u (P), and the memory (MEMORY) a period later in place of that of now. */
void agent_act(const AgentLinks *links, const double *own, double t, const AgentInputs *in,
               double *memory, double *u);

void agent_lead_send(const double *memory, double *message);
void agent_lead(double t, double *memory);

#endif
