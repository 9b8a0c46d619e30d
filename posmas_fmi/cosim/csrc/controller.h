/* The controller of one agent: input (6), its saturation sec, and the sampled observer (5) or (22).
 *
 * No memory of its own, no library but math.h. One communication step of an agent is
 *
 *     controller_innovation     y - C xhat, which is also what the agent sends besides xhat
 *     ...                       the caller gathers what has come over the arcs
 *     controller_input          u and sec(u) from the weighted disagreement
 *     controller_observe        xhat at the next communication point
 *
 * and `controller_leader` is the same step for the leader. The sizes M, P, Q and the functions g and
 * sec come from `agent_functions.h`, generated from the agent's expressions. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include "agent_functions.h"

/* All that agents have in common; nothing but doubles, matrices row by row. */
typedef struct {
    double h;           /* communication step [s] */
    double K[P * M];    /* feedback gain */
    double E[M * Q];    /* observer gain */
    double B[M * P];
    double C[Q * M];
    double H[M * M];
    double full[M * M]; /* e^(A h) */
    double half[M * M]; /* e^(A h/2) */
    double gamma[M * M];      /* integral of e^(A tau) from 0 to h */
    double half_gamma[M * M]; /* the same to h/2 */
    double start[M * M];      /* weights of H g at the start, the middle and the end of the step */
    double middle[M * M];
    double end[M * M];
} Controller;

/* innovation (Q) = y - C xhat */
void controller_innovation(const Controller *c, const double *y, const double *xhat,
                           double *innovation);

/* u (P) = K disagreement, and sec(u); disagreement (M) is phi [sum a_ij (xhat_i - xhat_j) + d_i (xhat_i - s)] */
void controller_input(const Controller *c, const double *disagreement, double *u, double *sec_u);

/* xhat (M) at t + h from xhat at t; innovation (Q) is weighted as (5) or (22) says. */
void controller_observe(const Controller *c, double t, const double *sec_u,
                        const double *innovation, const double *xhat, double *next);

/* s (M) at t + h from s at t. */
void controller_leader(const Controller *c, double t, const double *s, double *next);

#endif
