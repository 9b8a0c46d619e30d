/* Functions of many agents in pieces of LANES; their names end in the number of lanes. */
#include <string.h>

#include "step.h"

#define PASTE(name, lanes) name##_##lanes
#define PASTE_VALUE(name, lanes) PASTE(name, lanes)
#define WITH_LANES(name) PASTE_VALUE(name, LANES)

void WITH_LANES(controller_block)(const Controller *c, int agents, double t, const double *driven,
                                  const double *disagreement, const double *memory, double *next,
                                  double *u, double *applied);
void WITH_LANES(columns_step)(const Controller *c, double t, const double *disagreement,
                              const double *memory, double *next, double *u, double *applied,
                              int64_t n);

/* Matrices whose columns are agents, all with `stride` columns. */
typedef struct {
    const double *driven; /* NULL: all are */
    const double *disagreement, *memory;
    double *next, *u, *applied;
    int64_t stride;
} Columns;

/* Columns first … first + count - 1 of a matrix; other lanes are 0. */
LANES_INLINE void load(Lanes *to, const double *from, int64_t first, int64_t stride, int rows,
                       int64_t count)
{
    for (int i = 0; i < rows; i++) {
        to[i] = lanes_of(0);
        memcpy(&to[i], from + i * stride + first, (size_t)count * sizeof(double));
    }
}

LANES_INLINE void store(double *to, const Lanes *from, int64_t first, int64_t stride, int rows,
                        int64_t count)
{
    for (int i = 0; i < rows; i++)
        memcpy(to + i * stride + first, &from[i], (size_t)count * sizeof(double));
}

/* Of `count` columns those in vector k. */
LANES_INLINE int64_t in_group(int k, int64_t count)
{
    const int64_t left = count - k * LANES;
    return left < 0 ? 0 : left < LANES ? left : LANES;
}

/* The step for columns first … first + count - 1, in so many vectors. Returns whether it holds: not
 * where an argument was beyond a range and `mends` is not set. */
LANES_INLINE int step_columns(const int groups, const int mends, const Controller *c, double t,
                              const Columns *of, int64_t first, int64_t count)
{
    Lanes all[GROUPS][MESSAGE], before[GROUPS][M], after[GROUPS][M];
    Lanes input[GROUPS][P], taken[GROUPS][P], driven[GROUPS];
    LanesRange range = {.mends = mends};
    for (int k = 0; k < groups; k++) {
        const int64_t at = first + k * LANES, some = in_group(k, count);
        driven[k] = lanes_of(1);
        if (of->driven)
            load(&driven[k], of->driven, at, of->stride, 1, some);
        load(all[k], of->disagreement, at, of->stride, MESSAGE, some);
        load(before[k], of->memory, at, of->stride, M, some);
    }
    step(groups, c, t, driven, (const Lanes(*)[MESSAGE])all, (const Lanes(*)[M])before, after,
         input, taken, &range);
    for (int k = 0; k < groups; k++) {
        const int64_t at = first + k * LANES, some = in_group(k, count);
        store(of->next, after[k], at, of->stride, M, some);
        store(of->u, input[k], at, of->stride, P, some);
        store(of->applied, taken[k], at, of->stride, P, some);
    }
    return lanes_none(range.beyond);
}

static __attribute__((noinline, cold)) void mend(const Controller *c, double t, const Columns *of,
                                                 int64_t first, int64_t count)
{
    for (int64_t end = first + count; first < end; first += LANES)
        step_columns(1, 1, c, t, of, first, end - first < LANES ? end - first : LANES);
}

enum { WHOLE = GROUPS * LANES };

void WITH_LANES(controller_block)(const Controller *c, int agents, double t, const double *driven,
                                  const double *disagreement, const double *memory, double *next,
                                  double *u, double *applied)
{
    const Columns of = {driven, disagreement, memory, next, u, applied, CONTROLLER_BLOCK};
    int first = 0;
    for (; first + LANES < agents; first += WHOLE)
        if (!step_columns(GROUPS, 0, c, t, &of, first, WHOLE))
            mend(c, t, &of, first, WHOLE);
    if (first < agents && !step_columns(1, 0, c, t, &of, first, LANES)) /* one vector is enough */
        mend(c, t, &of, first, LANES);
}

void WITH_LANES(columns_step)(const Controller *c, double t, const double *disagreement,
                              const double *memory, double *next, double *u, double *applied,
                              int64_t n)
{
    const Columns of = {NULL, disagreement, memory, next, u, applied, n};
    int64_t first = 0;
    for (; first + WHOLE <= n; first += WHOLE) /* a constant: no calls to copy */
        if (!step_columns(GROUPS, 0, c, t, &of, first, WHOLE))
            mend(c, t, &of, first, WHOLE);
    if (first < n && !step_columns(GROUPS, 0, c, t, &of, first, n - first))
        mend(c, t, &of, first, n - first);
}
