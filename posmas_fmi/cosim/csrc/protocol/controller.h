/* The protocol: input (6), its saturation sec, and the sampled observer (5) or (22).
 *
 * No memory of its own, no library but math.h: pure functions of one agent, called at each
 * communication point in this order,
 *
 *     controller_send     what the agent tells its neighbours
 *     ...                 the caller gathers what has come over the arcs
 *     controller_step     the input, and what the agent remembers until the next point
 *
 * and `controller_leader_send`, `controller_leader` for the leader. Any controller that the engine
 * runs has these functions and these names of sizes; here M, P, Q and the functions g and sec come
 * from `agent_functions.h`, generated from the agent's expressions. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdint.h>

#include "agent_functions.h"

enum {
    MEMORY = M,      /* xhat; the first M of any controller's memory are the estimate */
    MEASURED = Q,    /* y; what else an agent measures comes after it */
    INNOVATION = Q,  /* of the message: weighted as (5) or (22) says, the rest as (6) says */
    MESSAGE = M + INNOVATION,
    OWN = 0          /* parameters in which agents differ */
};

/* All that agents have in common; nothing but doubles, matrices row by row. */
typedef struct {
    double h;           /* communication step [s] */
    double K[P * M];    /* feedback gain */
    double E[M * Q];    /* observer gain */
    double B[M * P];
    double C[Q * M];
    double full[M * M];         /* e^(A h) */
    double half[M * M];         /* e^(A h/2) */
    double gamma[M * M];        /* integral of e^(A tau) from 0 to h */
    double half_gamma[M * M];   /* the same to h/2 */
    double half_g[M * M];       /* half_gamma H, the weight of g over half a step */
    double twice_half_g[M * M]; /* and that twice */
    double start_g[M * M];      /* weights of g at the start, the middle and the end of the step */
    double middle_g[M * M];
    double end_g[M * M];
} Controller;

/* message (MESSAGE) = [xhat, y - C xhat] */
void controller_send(const Controller *c, const double *own, const double *memory,
                     const double *measured, double *message);

/* u (P) = K disagreement, applied = sec(u), and the memory (MEMORY) at t + h.
 *
 * disagreement (MESSAGE) is phi [sum a_ij (x_i - x_j) + d_i (x_i - s)] of what is sent, for the
 * innovation as (5) or (22) says; silence (2) is how long ago [s] the oldest of the last messages of
 * the neighbours was sent, and that of the leader. `memory` and `next` are never the same. */
void controller_step(const Controller *c, const double *own, double t, const double *measured,
                     const double *disagreement, const double *silence, const double *memory,
                     double *next, double *u, double *applied);

/* Only the input: u (P) = K disagreement, and applied = sec(u). */
void controller_input(const Controller *c, const double *disagreement, double *u, double *applied);

/* controller_step for many agents at once, to the same bits: columns are agents, so disagreement is
 * (MESSAGE, CONTROLLER_BLOCK). All columns are to hold numbers, those of the first `agents` count.
 * Where `driven` (CONTROLLER_BLOCK) is 0 and not 1 the model runs free: there is room for the leader.
 * A controller without this function is called for one agent at a time. */
#define CONTROLLER_BLOCK 16
void controller_block(const Controller *c, int agents, double t, const double *driven,
                      const double *disagreement, const double *memory, double *next, double *u,
                      double *applied);

/* The same for any number n of agents, from disagreement (MESSAGE, n) and memory (M, n) to next (M, n),
 * u (P, n) and applied (P, n), and for the leader. For a loop that is not in C: block_2.c exports it. */
void controller_columns(const Controller *c, double t, const double *disagreement,
                        const double *memory, double *next, double *u, double *applied, int64_t n,
                        const double *leader, double *leader_next);

/* The leader: its memory (MEMORY) at t + h, and what it sends (MESSAGE). */
void controller_leader(const Controller *c, double t, const double *memory, double *next);
void controller_leader_send(const Controller *c, const double *memory, double *message);

#endif
