/* Functions of many agents in pieces of LANES; their names end in the number of lanes. */
#include <string.h>

#include "step.h"

#define PASTE(name, lanes) name##_##lanes
#define PASTE_VALUE(name, lanes) PASTE(name, lanes)
#define WITH_LANES(name) PASTE_VALUE(name, LANES)

/* Columns first … first + LANES - 1 of a matrix with CONTROLLER_BLOCK columns. */
LANES_INLINE void load(Lanes *to, const double *from, int first, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(&to[i], from + i * CONTROLLER_BLOCK + first, sizeof(Lanes));
}

LANES_INLINE void store(double *to, const Lanes *from, int first, int rows)
{
    for (int i = 0; i < rows; i++)
        memcpy(to + i * CONTROLLER_BLOCK + first, &from[i], sizeof(Lanes));
}

void WITH_LANES(controller_block)(const Controller *c, int agents, double t, const double *driven,
                                  const double *disagreement, const double *memory, double *next,
                                  double *u, double *applied);
void WITH_LANES(columns_g)(double t, const double *x, double *g, int64_t n);
void WITH_LANES(columns_sec)(const double *u, double *sec, int64_t n);

void WITH_LANES(controller_block)(const Controller *c, int agents, double t, const double *driven,
                                  const double *disagreement, const double *memory, double *next,
                                  double *u, double *applied)
{
    for (int first = 0; first < agents; first += GROUPS * LANES) {
        Lanes all[GROUPS][MESSAGE], before[GROUPS][M], after[GROUPS][M];
        Lanes input[GROUPS][P], taken[GROUPS][P], counts[GROUPS];
        for (int k = 0; k < GROUPS; k++) {
            load(&counts[k], driven, first + k * LANES, 1);
            load(all[k], disagreement, first + k * LANES, MESSAGE);
            load(before[k], memory, first + k * LANES, M);
        }
        step(c, t, counts, (const Lanes(*)[MESSAGE])all, (const Lanes(*)[M])before, after, input,
             taken);
        for (int k = 0; k < GROUPS; k++) {
            store(next, after[k], first + k * LANES, M);
            store(u, input[k], first + k * LANES, P);
            store(applied, taken[k], first + k * LANES, P);
        }
    }
}

/* Columns first … first + count - 1 of a matrix with n columns; the other lanes are 0. */
LANES_INLINE void load_columns(Lanes *to, const double *from, int64_t first, int64_t n, int rows,
                               int64_t count)
{
    for (int i = 0; i < rows; i++) {
        to[i] = lanes_of(0);
        memcpy(&to[i], from + i * n + first, (size_t)count * sizeof(double));
    }
}

LANES_INLINE void store_columns(double *to, const Lanes *from, int64_t first, int64_t n, int rows,
                                int64_t count)
{
    for (int i = 0; i < rows; i++)
        memcpy(to + i * n + first, &from[i], (size_t)count * sizeof(double));
}

LANES_INLINE void some_g(double t, const double *x, double *g, int64_t first, int64_t n,
                         int64_t count)
{
    Lanes state[M], value[M];
    load_columns(state, x, first, n, M, count);
    agent_g(lanes_of(t), state, value);
    store_columns(g, value, first, n, M, count);
}

LANES_INLINE void some_sec(const double *u, double *sec, int64_t first, int64_t n, int64_t count)
{
    Lanes input[P], value[P];
    load_columns(input, u, first, n, P, count);
    agent_sec(input, value);
    store_columns(sec, value, first, n, P, count);
}

void WITH_LANES(columns_g)(double t, const double *x, double *g, int64_t n)
{
    int64_t first = 0;
    for (; first + LANES <= n; first += LANES)
        some_g(t, x, g, first, n, LANES); /* a constant: no calls to copy */
    if (first < n)
        some_g(t, x, g, first, n, n - first);
}

void WITH_LANES(columns_sec)(const double *u, double *sec, int64_t n)
{
    int64_t first = 0;
    for (; first + LANES <= n; first += LANES)
        some_sec(u, sec, first, n, LANES);
    if (first < n)
        some_sec(u, sec, first, n, n - first);
}
