/* For any processor: SSE2 and NEON have two lanes. Here too it is chosen which one is used. */
#define LANES 2
#define GROUPS 2
#include "block.h"
#include "export.h"

typedef void Block(const Controller *, int, double, const double *, const double *, const double *,
                   double *, double *, double *);
typedef void Step(const Controller *, double, const double *, const double *, double *, double *,
                  double *, int64_t);
Block controller_block_4, controller_block_8;
Step columns_step_4, columns_step_8;

static int lanes_here(void)
{
#if defined __x86_64__
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        return 8;
    if (__builtin_cpu_supports("avx2"))
        return 4;
#endif
    return 2;
}

#if defined __x86_64__
#define CHOOSE(name) (lanes == 8 ? name##_8 : lanes == 4 ? name##_4 : name##_2)
#else
#define CHOOSE(name) ((void)lanes, name##_2)
#endif

void controller_block(const Controller *c, int agents, double t, const double *driven,
                      const double *disagreement, const double *memory, double *next, double *u,
                      double *applied)
{
    const int lanes = lanes_here();
    CHOOSE(controller_block)(c, agents, t, driven, disagreement, memory, next, u, applied);
}

EXPORT void controller_columns(const Controller *c, double t, const double *disagreement,
                               const double *memory, double *next, double *u, double *applied,
                               int64_t n, const double *leader, double *leader_next)
{
    const int lanes = lanes_here();
    controller_leader(c, t, leader, leader_next);
    CHOOSE(columns_step)(c, t, disagreement, memory, next, u, applied, n);
}
