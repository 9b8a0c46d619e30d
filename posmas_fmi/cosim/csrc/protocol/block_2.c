/* For any processor: SSE2 and NEON have two lanes. Here too it is chosen which one is used. */
#define LANES 2
#define GROUPS 2
#define BLOCK_FUNCTION controller_block_2
#include "block.h"

typedef void Block(const Controller *, int, double, const double *, const double *, const double *,
                   double *, double *, double *);
Block controller_block_4, controller_block_8;

void controller_block(const Controller *c, int agents, double t, const double *driven,
                      const double *disagreement, const double *memory, double *next, double *u,
                      double *applied)
{
    Block *block = controller_block_2;
#if defined __x86_64__
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        block = controller_block_8;
    else if (__builtin_cpu_supports("avx2"))
        block = controller_block_4;
#endif
    block(c, agents, t, driven, disagreement, memory, next, u, applied);
}
