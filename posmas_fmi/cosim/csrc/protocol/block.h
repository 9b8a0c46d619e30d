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
void WITH_LANES(columns_step)(const Controller *c, double t, const double *disagreement,
                              const double *memory, double *next, double *u, double *applied,
                              int64_t n);

/* Agents first …, of the columns of a block, in so many vectors. */
LANES_INLINE void of_block(const int groups, const Controller *c, int first, double t,
                           const double *driven, const double *disagreement, const double *memory,
                           double *next, double *u, double *applied)
{
    Lanes all[GROUPS][MESSAGE], before[GROUPS][M], after[GROUPS][M];
    Lanes input[GROUPS][P], taken[GROUPS][P], counts[GROUPS];
    for (int k = 0; k < groups; k++) {
        load(&counts[k], driven, first + k * LANES, 1);
        load(all[k], disagreement, first + k * LANES, MESSAGE);
        load(before[k], memory, first + k * LANES, M);
    }
    step(groups, c, t, counts, (const Lanes(*)[MESSAGE])all, (const Lanes(*)[M])before, after,
         input, taken);
    for (int k = 0; k < groups; k++) {
        store(next, after[k], first + k * LANES, M);
        store(u, input[k], first + k * LANES, P);
        store(applied, taken[k], first + k * LANES, P);
    }
}

void WITH_LANES(controller_block)(const Controller *c, int agents, double t, const double *driven,
                                  const double *disagreement, const double *memory, double *next,
                                  double *u, double *applied)
{
    int first = 0;
    for (; first + LANES < agents; first += GROUPS * LANES)
        of_block(GROUPS, c, first, t, driven, disagreement, memory, next, u, applied);
    if (first < agents) /* one vector is enough */
        of_block(1, c, first, t, driven, disagreement, memory, next, u, applied);
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

LANES_INLINE void some_step(const Controller *c, double t, const double *disagreement,
                            const double *memory, double *next, double *u, double *applied,
                            int64_t first, int64_t n, int64_t count)
{
    Lanes all[GROUPS][MESSAGE], before[GROUPS][M], after[GROUPS][M];
    Lanes input[GROUPS][P], taken[GROUPS][P], driven[GROUPS];
    int64_t of_group[GROUPS];
    for (int k = 0; k < GROUPS; k++) {
        const int64_t at = first + k * LANES, left = count - k * LANES;
        of_group[k] = left < 0 ? 0 : left < LANES ? left : LANES;
        driven[k] = lanes_of(1);
        load_columns(all[k], disagreement, at, n, MESSAGE, of_group[k]);
        load_columns(before[k], memory, at, n, M, of_group[k]);
    }
    step(GROUPS, c, t, driven, (const Lanes(*)[MESSAGE])all, (const Lanes(*)[M])before, after,
         input, taken);
    for (int k = 0; k < GROUPS; k++) {
        const int64_t at = first + k * LANES;
        store_columns(next, after[k], at, n, M, of_group[k]);
        store_columns(u, input[k], at, n, P, of_group[k]);
        store_columns(applied, taken[k], at, n, P, of_group[k]);
    }
}

void WITH_LANES(columns_step)(const Controller *c, double t, const double *disagreement,
                              const double *memory, double *next, double *u, double *applied,
                              int64_t n)
{
    enum { WHOLE = GROUPS * LANES };
    int64_t first = 0;
    for (; first + WHOLE <= n; first += WHOLE) /* a constant: no calls to copy */
        some_step(c, t, disagreement, memory, next, u, applied, first, n, WHOLE);
    if (first < n)
        some_step(c, t, disagreement, memory, next, u, applied, first, n, n - first);
}
