/* The step of the protocol for many agents at once: up to GROUPS vectors of LANES, which are set by
 * who includes this.
 *
 * The observer's step is ETDRK4 (Cox and Matthews, J. Comput. Phys. 176, 2002): exact in A and in the
 * held input, fourth order in g. */
#ifndef STEP_H
#define STEP_H

#include "controller.h"
#include "lanes.h"

/* W from, with W of shape (rows, columns) */
LANES_INLINE void set_product(Lanes *to, const double *W, const Lanes *from, int rows, int columns)
{
    for (int i = 0; i < rows; i++) {
        to[i] = W[i * columns] * from[0];
        for (int j = 1; j < columns; j++)
            to[i] += W[i * columns + j] * from[j];
    }
}

/* to += W from: the sum of a product comes last, for it is what is waited for */
LANES_INLINE void add_product(Lanes *to, const double *W, const Lanes *from, int rows, int columns)
{
    for (int i = 0; i < rows; i++) {
        Lanes product;
        set_product(&product, W + i * columns, from, 1, columns);
        to[i] += product;
    }
}

/* One step of x' = A x + H g(t, x) + w with w held, for some vectors in turn: a stage waits for
 * the one before it, and meanwhile the processor can compute that of another group. */
LANES_INLINE void propagate(const int groups, const Controller *c, double t, const Lanes x[][M],
                            const Lanes w[][M], Lanes next[][M], LanesRange *range)
{
    Lanes g[GROUPS][4][M]; /* at the start, twice in the middle, and at the end */
    Lanes base[GROUPS][M], known[GROUPS][M], stage[GROUPS][M];
    const Lanes middle = lanes_of(t + 0.5 * c->h), end = lanes_of(t + c->h);
    for (int k = 0; k < groups; k++)
        agent_g(lanes_of(t), x[k], g[k][0], range);
    for (int k = 0; k < groups; k++) {
        Lanes of_w[M], of_g[M];
        set_product(base[k], c->half, x[k], M, M);
        set_product(of_w, c->half_gamma, w[k], M, M);
        set_product(of_g, c->half_g, g[k][0], M, M);
        for (int i = 0; i < M; i++) {
            base[k][i] += of_w[i];
            stage[k][i] = base[k][i] + of_g[i];
            known[k][i] = of_w[i] - of_g[i];
        }
        add_product(known[k], c->half, stage[k], M, M);
        agent_g(middle, stage[k], g[k][1], range);
    }
    for (int k = 0; k < groups; k++) {
        for (int i = 0; i < M; i++)
            stage[k][i] = base[k][i];
        add_product(stage[k], c->half_g, g[k][1], M, M);
        agent_g(middle, stage[k], g[k][2], range);
    }
    for (int k = 0; k < groups; k++) {
        for (int i = 0; i < M; i++)
            stage[k][i] = known[k][i];
        add_product(stage[k], c->twice_half_g, g[k][2], M, M);
        agent_g(end, stage[k], g[k][3], range);
    }
    for (int k = 0; k < groups; k++) {
        Lanes sum[M];
        for (int i = 0; i < M; i++)
            sum[i] = g[k][1][i] + g[k][2][i];
        set_product(next[k], c->full, x[k], M, M);
        add_product(next[k], c->gamma, w[k], M, M);
        add_product(next[k], c->start_g, g[k][0], M, M);
        add_product(next[k], c->middle_g, sum, M, M);
        add_product(next[k], c->end_g, g[k][3], M, M);
    }
}

/* Equation (6): u = K disagreement, and what the saturation makes of it. */
LANES_INLINE void input(const Controller *c, const Lanes *disagreement, Lanes *u, Lanes *applied,
                        LanesRange *range)
{
    set_product(u, c->K, disagreement, P, M);
    agent_sec(u, applied, range);
}

/* As controller_step, for all lanes of some vectors; what is held counts `driven` times. */
LANES_INLINE void step(const int groups, const Controller *c, double t, const Lanes *driven,
                       const Lanes disagreement[][MESSAGE], const Lanes memory[][M],
                       Lanes next[][M], Lanes u[][P], Lanes applied[][P], LanesRange *range)
{
    Lanes held[GROUPS][M];
    for (int k = 0; k < groups; k++) {
        input(c, disagreement[k], u[k], applied[k], range);
        set_product(held[k], c->E, disagreement[k] + M, M, Q);
        add_product(held[k], c->B, applied[k], M, P);
        for (int i = 0; i < M; i++)
            held[k][i] *= driven[k];
    }
    propagate(groups, c, t, memory, held, next, range);
}

#endif
