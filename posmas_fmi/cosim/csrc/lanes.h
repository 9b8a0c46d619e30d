/* Several agents at once: a `Lanes` holds one number of each of LANES agents.
 *
 * It is a vector of the compiler (GCC, clang), or one double where LANES is 1: the same source gives
 * a controller for many agents and one for a single agent. Only + - * / and operations on bits are
 * used, so that a lane is computed alike wherever it stands and whatever the processor (compile with
 * -ffp-contract=off): results do not depend on how agents are grouped.
 *
 * sin, cos, exp and tanh: reduction after Cody and Waite (Software Manual for the Elementary
 * Functions, 1980) with polynomials fitted at Chebyshev nodes, at most 3 units in the last place
 * (exp 2, tanh 4). An argument beyond the range of the reduction (see LanesRange), and every other
 * function, goes lane by lane to math.h. */
#ifndef LANES_H
#define LANES_H

#include <math.h>
#include <stdint.h>
#if defined __SSE2__
#include <immintrin.h>
#endif

#if LANES > 1
typedef double Lanes __attribute__((vector_size(LANES * 8)));
typedef int64_t Bits __attribute__((vector_size(LANES * 8)));
#define LANES_WHERE(condition) (condition) /* all bits of a lane where it holds, else none */
#else
typedef double Lanes;
typedef int64_t Bits;
#define LANES_WHERE(condition) (-(int64_t)(condition))
#endif

#define LANES_INLINE static inline __attribute__((always_inline, unused))

typedef union {
    Lanes value;
    Bits bits;
    double lane[LANES];
    int64_t lane_bits[LANES];
} LanesView;

/* The same number in all lanes. */
LANES_INLINE Lanes lanes_of(double value)
{
    LanesView to;
    for (int l = 0; l < LANES; l++)
        to.lane[l] = value;
    return to.value;
}

LANES_INLINE Bits lanes_bits(Lanes x)
{
    return (LanesView){.value = x}.bits;
}

LANES_INLINE Lanes lanes_from(Bits bits)
{
    return (LanesView){.bits = bits}.value;
}

/* yes where the mask has all bits, else no */
LANES_INLINE Lanes lanes_select(Bits mask, Lanes yes, Lanes no)
{
    return lanes_from((mask & lanes_bits(yes)) | (~mask & lanes_bits(no)));
}

LANES_INLINE Lanes lanes_abs(Lanes x)
{
    return lanes_from(lanes_bits(x) & INT64_MAX);
}

/* NaN where either is. */
LANES_INLINE Lanes lanes_min(Lanes a, Lanes b)
{
    return lanes_select(LANES_WHERE(a < b) | LANES_WHERE(a != a), a, b);
}

LANES_INLINE Lanes lanes_max(Lanes a, Lanes b)
{
    return lanes_select(LANES_WHERE(a > b) | LANES_WHERE(a != a), a, b);
}

LANES_INLINE Lanes lanes_sign(Lanes x)
{
    const Lanes zero = {0}, one = lanes_of(1);
    const Lanes sign = lanes_select(LANES_WHERE(x > zero), one, zero) -
                       lanes_select(LANES_WHERE(x < zero), one, zero);
    return lanes_select(LANES_WHERE(x != x), x, sign);
}

/* A function of math.h, lane by lane. */
LANES_INLINE Lanes lanes_each(double (*f)(double), Lanes x)
{
    LanesView to = {.value = x};
    for (int l = 0; l < LANES; l++)
        to.lane[l] = f(to.lane[l]);
    return to.value;
}

LANES_INLINE Lanes lanes_pow(Lanes x, Lanes y)
{
    LanesView to = {.value = x}, exponent = {.value = y};
    for (int l = 0; l < LANES; l++)
        to.lane[l] = pow(to.lane[l], exponent.lane[l]);
    return to.value;
}

LANES_INLINE Lanes lanes_sqrt(Lanes x)
{
    LanesView to = {.value = x};
    for (int l = 0; l < LANES; l++)
        to.lane[l] = sqrt(to.lane[l]); /* correctly rounded everywhere */
    return to.value;
}

/* Whether a mask is empty. */
LANES_INLINE int lanes_none(Bits mask)
{
    const LanesView view = {.bits = mask};
#if defined __AVX512DQ__ && LANES == 8
    return !_mm512_movepi64_mask((__m512i)view.bits);
#elif defined __AVX__ && LANES == 4
    return !_mm256_movemask_pd((__m256d)view.value);
#elif defined __SSE2__ && LANES == 2
    return !_mm_movemask_pd((__m128d)view.value);
#else
    int64_t any = 0;
    for (int l = 0; l < LANES; l++)
        any |= view.lane_bits[l];
    return !any;
#endif
}

/* What is done about arguments beyond the range of a reduction. Where `mends` is set they go to
 * math.h at once. Otherwise they are only noted: without a branch at each sin the compiler can lay
 * what does not depend on each other side by side. Where `beyond` is not empty after that, no lane is
 * to be used and all is to be computed again with `mends`; other lanes have the same bits both ways. */
typedef struct {
    int mends;
    Bits beyond;
} LanesRange;

/* The lanes that are not below the limit by math.h. */
static __attribute__((noinline, cold, unused)) Lanes lanes_mended(double (*f)(double), Lanes x,
                                                                  double limit, Lanes y)
{
    const LanesView from = {.value = x};
    LanesView to = {.value = y};
    for (int l = 0; l < LANES; l++)
        if (!(fabs(from.lane[l]) < limit))
            to.lane[l] = f(from.lane[l]);
    return to.value;
}

/* y, which is f(x) where |x| is below the limit; NaN is not. */
LANES_INLINE Lanes lanes_within(double (*f)(double), Lanes x, double limit, Lanes y,
                                LanesRange *range)
{
    const Bits beyond = ~LANES_WHERE(lanes_abs(x) < lanes_of(limit));
    if (!range->mends) {
        range->beyond |= beyond;
        return y;
    }
    return lanes_none(beyond) ? y : lanes_mended(f, x, limit, y);
}

#define LANES_TO_INTEGER 6755399441055744.0 /* 1.5 * 2^52: adding it rounds to an integer */

/* c[0] + c[1] z + … + c[5] z^5, in pairs: what waits for nothing is computed side by side */
LANES_INLINE Lanes lanes_polynomial(const double *c, Lanes z)
{
    const Lanes zz = z * z, a = c[0] + c[1] * z, b = c[2] + c[3] * z, d = c[4] + c[5] * z;
    return a + zz * (b + zz * d);
}

/* sin x for |x| < 1e6, or cos x where `half` is 0.5: x = q pi + y with q a whole number for sin, and
 * that and a half for cos, so that what is left is sin y or -sin y with |y| up to pi / 2 */
LANES_INLINE Lanes lanes_circular(Lanes x, double half)
{
    static const double S[] = {-0.16666666666666666, 0.008333333333333316, -0.00019841269841254974,
                               2.755731921916323e-06, -2.5052107616995878e-08,
                               1.6058977312444268e-10, -7.643970296165793e-13,
                               2.73144475909634e-15};
    /* pi in three parts, the first two of 33 bits: their products with q are exact, and so is what
     * is left where most is cancelled */
    const double P1 = 3.1415926534682512, P2 = 1.2154201012607932e-10, P3 = 4.044532497591901e-21;
    const Lanes turns = x * 0.3183098861837907;
    const Lanes shifted = (half == 0 ? turns : turns - half) + LANES_TO_INTEGER;
    const Lanes n = shifted - LANES_TO_INTEGER, q = half == 0 ? n : n + half;
    const Lanes y = ((x - q * P1) - q * P2) - q * P3, z = y * y, zz = z * z;
    const Lanes low = (S[0] + S[1] * z) + zz * (S[2] + S[3] * z);
    const Lanes high = (S[4] + S[5] * z) + zz * (S[6] + S[7] * z);
    const Lanes sine = y + y * z * (low + zz * zz * high);
    const Bits turned = half == 0 ? lanes_bits(shifted) : ~lanes_bits(shifted); /* odd: the sign */
    return lanes_from(lanes_bits(sine) ^ (turned << 63));
}

#define LANES_TURNS 1e6 /* sin and cos are reduced below it */

LANES_INLINE Lanes lanes_sin(Lanes x, LanesRange *range)
{
    return lanes_within(sin, x, LANES_TURNS, lanes_circular(x, 0), range); /* sin(-0) is +0 */
}

LANES_INLINE Lanes lanes_cos(Lanes x, LanesRange *range)
{
    return lanes_within(cos, x, LANES_TURNS, lanes_circular(x, 0.5), range);
}

/* x = n ln 2 + r; power: 2^n; returns e^r - 1, for |x| < 700 */
LANES_INLINE Lanes lanes_expm1_reduced(Lanes x, Lanes *power)
{
    static const double E[] = {0.16666666666666669, 0.041666666666666664, 0.008333333333330065,
                               0.0013888888888886554, 0.00019841269863040922,
                               2.4801587317135435e-05, 2.7557268479724004e-06,
                               2.7557282983637385e-07, 2.510037611136142e-08,
                               2.0911229928855294e-09};
    const double LOG2_HIGH = 0.6931471803691238, LOG2_LOW = 1.9082149292705877e-10;
    const Lanes shifted = x * 1.4426950408889634 + LANES_TO_INTEGER;
    const Lanes n = shifted - LANES_TO_INTEGER;
    const Lanes high = x - n * LOG2_HIGH, low = n * LOG2_LOW, r = high - low;
    const Lanes tail = (high - r) - low, z = r * r;
    *power = lanes_from((lanes_bits(shifted) << 52) + lanes_bits(lanes_of(1)));
    const Lanes higher = (E[6] + E[7] * r) + z * (E[8] + E[9] * r);
    const Lanes cubic = lanes_polynomial(E, r) + z * z * z * higher;
    return r + (0.5 * z + (z * r * cubic + (tail + tail * r)));
}

#define LANES_EXPONENT 700.0 /* e^x is normal, with room, below it */

LANES_INLINE Lanes lanes_exp(Lanes x, LanesRange *range)
{
    Lanes power, less = lanes_expm1_reduced(x, &power);
    return lanes_within(exp, x, LANES_EXPONENT, power + power * less, range);
}

/* tanh x = e / (e + 2) with e = e^(2x) - 1; beyond 20 it is 1 to the last bit */
LANES_INLINE Lanes lanes_tanh(Lanes x)
{
    const Bits sign = lanes_bits(x) & INT64_MIN;
    const Lanes a = lanes_min(lanes_abs(x), lanes_of(20.0)), one = lanes_of(1);
    Lanes power, less = lanes_expm1_reduced(2.0 * a, &power);
    const Lanes e = power * less + (power - one);
    return lanes_from(lanes_bits(e / (e + 2.0)) | sign);
}

#endif
