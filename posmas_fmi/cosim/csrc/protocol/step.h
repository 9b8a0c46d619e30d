/* The step of the protocol for many agents at once: up to GROUPS vectors of LANES, which are set by
 * who includes this.
 *
 * The observer's step is ETDRK4 (Cox and Matthews, J. Comput. Phys. 176, 2002): exact in A and in the
 * held input, fourth order in g. */
#ifndef STEP_H
#define STEP_H

#include "controller.h"
#include "lanes.h"

/* to += W from, with W of shape (rows, columns) */
LANES_INLINE void add_product(Lanes *to, const double *W, const Lanes *from, int rows, int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            to[i] += W[i * columns + j] * from[j];
}

LANES_INLINE void set_product(Lanes *to, const double *W, const Lanes *from, int rows, int columns)
{
    for (int i = 0; i < rows; i++) {
        to[i] = W[i * columns] * from[0];
        for (int j = 1; j < columns; j++)
            to[i] += W[i * columns + j] * from[j];
    }
}

LANES_INLINE void copy(Lanes *to, const Lanes *from)
{
    for (int i = 0; i < M; i++)
        to[i] = from[i];
}

/* slope (M) = H g(t, x) */
LANES_INLINE void weighted_g(const Controller *c, double t, const Lanes *x, Lanes *slope)
{
    Lanes g[M];
    agent_g(lanes_of(t), x, g);
    set_product(slope, c->H, g, M, M);
}

/* One step of x' = A x + H g(t, x) + w with w held, for some vectors in turn: a stage waits for
 * the one before it, and meanwhile the processor can compute that of another group. */
LANES_INLINE void propagate(const int groups, const Controller *c, double t, const Lanes x[][M],
                            const Lanes w[][M], Lanes next[][M])
{
    Lanes ga[GROUPS][M], gb[GROUPS][M], gc[GROUPS][M], gd[GROUPS][M];
    Lanes base[GROUPS][M], a[GROUPS][M], stage[GROUPS][M];
    const double middle = t + 0.5 * c->h;
    for (int k = 0; k < groups; k++)
        weighted_g(c, t, x[k], ga[k]);
    for (int k = 0; k < groups; k++) {
        set_product(base[k], c->half, x[k], M, M);
        add_product(base[k], c->half_gamma, w[k], M, M);
        copy(a[k], base[k]);
        add_product(a[k], c->half_gamma, ga[k], M, M);
        weighted_g(c, middle, a[k], gb[k]);
    }
    for (int k = 0; k < groups; k++) {
        copy(stage[k], base[k]);
        add_product(stage[k], c->half_gamma, gb[k], M, M);
        weighted_g(c, middle, stage[k], gc[k]);
    }
    for (int k = 0; k < groups; k++) {
        Lanes sum[M];
        for (int i = 0; i < M; i++)
            sum[i] = 2.0 * gc[k][i] - ga[k][i] + w[k][i];
        set_product(stage[k], c->half, a[k], M, M);
        add_product(stage[k], c->half_gamma, sum, M, M);
        weighted_g(c, t + c->h, stage[k], gd[k]);
    }
    for (int k = 0; k < groups; k++) {
        Lanes sum[M], end[M];
        for (int i = 0; i < M; i++)
            sum[i] = gb[k][i] + gc[k][i];
        set_product(end, c->full, x[k], M, M);
        add_product(end, c->gamma, w[k], M, M);
        add_product(end, c->start, ga[k], M, M);
        add_product(end, c->middle, sum, M, M);
        add_product(end, c->end, gd[k], M, M);
        copy(next[k], end);
    }
}

/* As controller_step, for all lanes of some vectors; what is held counts `driven` times. */
LANES_INLINE void step(const int groups, const Controller *c, double t, const Lanes *driven,
                       const Lanes disagreement[][MESSAGE], const Lanes memory[][M],
                       Lanes next[][M], Lanes u[][P], Lanes applied[][P])
{
    Lanes held[GROUPS][M];
    for (int k = 0; k < groups; k++) {
        set_product(u[k], c->K, disagreement[k], P, M);
        agent_sec(u[k], applied[k]);
        set_product(held[k], c->B, applied[k], M, P);
        add_product(held[k], c->E, disagreement[k] + M, M, Q);
        for (int i = 0; i < M; i++)
            held[k][i] *= driven[k];
    }
    propagate(groups, c, t, memory, held, next);
}

#endif
