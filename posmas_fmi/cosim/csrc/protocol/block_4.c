/* For processors with AVX2. */
#if defined __x86_64__
#if defined __clang__
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC target("avx2")
#endif

#define LANES 4
#define GROUPS 2
#include "block.h"

#if defined __clang__
#pragma clang attribute pop
#endif
#else
typedef int nothing_here;
#endif
