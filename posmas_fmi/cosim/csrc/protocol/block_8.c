/* For processors with AVX-512. */
#if defined __x86_64__
#if defined __clang__
#pragma clang attribute push(__attribute__((target("avx512f,avx512dq,avx512vl"))), apply_to = function)
#else
#pragma GCC target("avx512f,avx512dq,avx512vl")
#endif

#define LANES 8
#define GROUPS 2
#include "block.h"

#if defined __clang__
#pragma clang attribute pop
#endif
#else
typedef int nothing_here;
#endif
