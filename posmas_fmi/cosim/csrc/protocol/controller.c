/* See controller.h. The observer's step is ETDRK4 (Cox and Matthews, J. Comput. Phys. 176, 2002):
 * exact in A and in the held input, fourth order in g. */
#include "controller.h"

/* to += W from, with W of shape (rows, columns) */
static inline void add_product(double *to, const double *W, const double *from, int rows,
                               int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            to[i] += W[i * columns + j] * from[j];
}

static inline void set_product(double *to, const double *W, const double *from, int rows,
                               int columns)
{
    for (int i = 0; i < rows; i++)
        to[i] = 0;
    add_product(to, W, from, rows, columns);
}

static inline void copy(double *to, const double *from)
{
    for (int i = 0; i < M; i++)
        to[i] = from[i];
}

/* slope (M) = H g(t, x) */
static inline void weighted_g(const Controller *c, double t, const double *x, double *slope)
{
    double g[M];
    agent_g(t, x, g);
    set_product(slope, c->H, g, M, M);
}

/* One step of x' = A x + H g(t, x) + w with w held. */
static inline void propagate(const Controller *c, double t, const double *x, const double *w,
                             double *next)
{
    double ga[M], gb[M], gc[M], gd[M], base[M], a[M], stage[M], sum[M];
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

void controller_send(const Controller *c, const double *own, const double *memory,
                     const double *measured, double *message)
{
    double estimate[Q];
    (void)own;
    copy(message, memory);
    set_product(estimate, c->C, memory, Q, M);
    for (int i = 0; i < Q; i++)
        message[M + i] = measured[i] - estimate[i];
}

void controller_step(const Controller *c, const double *own, double t, const double *measured,
                     const double *disagreement, const double *silence, const double *memory,
                     double *next, double *u, double *applied)
{
    double held[M];
    (void)own, (void)measured, (void)silence;
    set_product(u, c->K, disagreement, P, M);
    agent_sec(u, applied);
    set_product(held, c->B, applied, M, P);
    add_product(held, c->E, disagreement + M, M, Q);
    propagate(c, t, memory, held, next);
}

void controller_leader(const Controller *c, double t, const double *memory, double *next)
{
    const double none[M] = {0};
    propagate(c, t, memory, none, next);
}

void controller_leader_send(const Controller *c, const double *memory, double *message)
{
    (void)c;
    copy(message, memory);
    for (int i = 0; i < INNOVATION; i++)
        message[M + i] = 0;
}
