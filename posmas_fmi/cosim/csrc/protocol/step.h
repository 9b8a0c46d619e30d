/* The step of the protocol for the agents of all lanes at once; LANES is set by who includes this.
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
    for (int i = 0; i < rows; i++)
        to[i] = lanes_of(0);
    add_product(to, W, from, rows, columns);
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

/* One step of x' = A x + H g(t, x) + w with w held. */
LANES_INLINE void propagate(const Controller *c, double t, const Lanes *x, const Lanes *w,
                            Lanes *next)
{
    Lanes ga[M], gb[M], gc[M], gd[M], base[M], a[M], stage[M], sum[M];
    const double middle = t + 0.5 * c->h;
    weighted_g(c, t, x, ga);
    set_product(base, c->half, x, M, M);
    add_product(base, c->half_gamma, w, M, M);
    copy(a, base);
    add_product(a, c->half_gamma, ga, M, M);
    weighted_g(c, middle, a, gb);
    copy(stage, base);
    add_product(stage, c->half_gamma, gb, M, M);
    weighted_g(c, middle, stage, gc);
    for (int i = 0; i < M; i++)
        sum[i] = 2.0 * gc[i] - ga[i] + w[i];
    set_product(stage, c->half, a, M, M);
    add_product(stage, c->half_gamma, sum, M, M);
    weighted_g(c, t + c->h, stage, gd);
    for (int i = 0; i < M; i++)
        sum[i] = gb[i] + gc[i];
    set_product(stage, c->full, x, M, M);
    add_product(stage, c->gamma, w, M, M);
    add_product(stage, c->start, ga, M, M);
    add_product(stage, c->middle, sum, M, M);
    add_product(stage, c->end, gd, M, M);
    copy(next, stage);
}

/* As controller_step, for all lanes. */
LANES_INLINE void step(const Controller *c, double t, const Lanes *disagreement,
                       const Lanes *memory, Lanes *next, Lanes *u, Lanes *applied)
{
    Lanes held[M];
    set_product(u, c->K, disagreement, P, M);
    agent_sec(u, applied);
    set_product(held, c->B, applied, M, P);
    add_product(held, c->E, disagreement + M, M, Q);
    propagate(c, t, memory, held, next);
}

#endif
