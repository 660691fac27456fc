/* Elementary functions of SIMD vectors within 4 ulp.

   Every function reduces its argument to a small interval and evaluates a minimax polynomial there (Remez'
   algorithm, in 60 digits for double, then rounded; the error is given next to each, an ulp being 1.1e-16 to
   2.2e-16 in double and 6e-8 to 1.2e-7 in float). Lanes outside of the range of the reduction (huge, tiny,
   infinite, outside of the domain) are computed by the C library, one by one and in double. NaN propagates. */
#pragma once
#include "simd_vectors.h"

/* The nearest multiple of pi/2 is `turns` quarter turns, and x is r beyond it.
   Where r is small it is a small difference: pi/2 is subtracted in parts. Up to LARGEST_ANGLE the product of
   `turns` and the first part is exact. Adding ROUNDING rounds to a whole number and leaves it in the lowest
   bits. */
#ifdef KINEVERSE_FLOAT
#define LARGEST_ANGLE 1e5f
#define ROUNDING 0x1.8p23f

INLINE V reduce_angle(V x, V turns) {
#if FUSED
  /* All parts are positive, so that zero keeps its sign. */
  V r = fused(turns, splat(-0x1.921fb4p+0f), x);
  r = fused(turns, splat(-0x1.4442dp-24f), r);
  return fused(turns, splat(-0x1.846988p-48f), r);
#else
  typedef double Wide __attribute__((vector_size(2 * REGISTER)));
  Wide k = __builtin_convertvector(turns, Wide), r = __builtin_convertvector(x, Wide);
  r = r - k * 0x1.921fb544p+0;
  return __builtin_convertvector(r - k * 0x1.0b4611a626331p-34, V);
#endif
}

/* (sin r / r - 1) / r^2 on |r| <= .795, z = r^2: 4.0e-9 */
INLINE V sine_polynomial(V z) {
  V p = fused(z, splat(-0.00019509063f), splat(0.0083321185f));
  return fused(z, p, splat(-0.16666654f));
}
/* (cos r - 1) / r^2: 1.1e-10 */
INLINE V cosine_polynomial(V z) {
  V q = fused(z, splat(2.442921289e-05f), splat(-0.001388728893f));
  q = fused(z, q, splat(0.04166664531f));
  return fused(z, q, splat(-0.5f));
}
#else
#define LARGEST_ANGLE 1.6e6
#define ROUNDING 0x1.8p52

INLINE V reduce_angle(V x, V turns) {
#if FUSED
  V r = fused(turns, splat(-0x1.921fb54442d18p+0), x);
  /* All parts are positive, so that zero keeps its sign. */
  r = fused(turns, splat(-0x1.1a62633145c06p-54), r);
  return fused(turns, splat(-0x1.c1cd129024e09p-107), r);
#else
  V r = x - turns * splat(0x1.921fb544p+0);
  r = r - turns * splat(0x1.0b4611a6p-34);
  V rest = r, last = turns * splat(0x1.3198a2ep-69);
  r = rest - last;
  return r - (turns * splat(0x1.b839a252049c1p-104) - ((rest - r) - last));
#endif
}

/* (sin r / r - 1) / r^2 on |r| <= pi/4, z = r^2: 3.5e-18 */
INLINE V sine_polynomial(V z) {
  V p = fused(z, splat(1.589688623753468e-10), splat(-2.505075988500799e-08));
  p = fused(z, p, splat(2.755731370504002e-06));
  p = fused(z, p, splat(-0.00019841269829853325));
  p = fused(z, p, splat(0.008333333333322486));
  return fused(z, p, splat(-0.16666666666666632));
}
/* (cos r - 1) / r^2: 5.7e-20 */
INLINE V cosine_polynomial(V z) {
  V q = fused(z, splat(-1.1358732578393472e-11), splat(2.087570511283029e-09));
  q = fused(z, q, splat(-2.755731421529269e-07));
  q = fused(z, q, splat(2.4801587288997478e-05));
  q = fused(z, q, splat(-0.0013888888888873338));
  q = fused(z, q, splat(0.041666666666666595));
  return fused(z, q, splat(-0.5));
}
#endif

APART void sincos_lanes(const V *x, V *s, V *c) {
  for (int i = 0; i < W; i++)
    if (!(fabs((*x)[i]) <= LARGEST_ANGLE)) {
      (*s)[i] = sin((*x)[i]);
      (*c)[i] = cos((*x)[i]);
    }
}

INLINE void sincos_(V x, V *sine, V *cosine) {
  const V shift = splat(ROUNDING);
  V shifted = fused(x, splat(REAL(0x1.45f306dc9c883p-1)), shift), turns = shifted - shift;
  I quadrant = (I)shifted;
  V r = reduce_angle(x, turns), z = r * r;
  V s = with_sign_of(fused(z * r, sine_polynomial(z), r), r);
  V c = fused(z, cosine_polynomial(z), splat(REAL(1.0)));
  I odd = -(quadrant & 1);
  V a = select_(odd, c, s), b = select_(odd, s, c);
  *sine = (V)((I)a ^ shift_left(quadrant & 2, 8 * sizeof(Real) - 2));
  *cosine = (V)((I)b ^ shift_left(add_bits(quadrant, splat_bits(1)) & 2, 8 * sizeof(Real) - 2));
  if (__builtin_expect(any(magnitude(x) > splat(LARGEST_ANGLE)), 0)) sincos_lanes(&x, sine, cosine);
}

INLINE V tan_(V x) {
  V s, c;
  sincos_(x, &s, &c);
  return s / c;
}

/* A part of pi/4 beyond the number keeps sums of angles right to the last digit. */
#define QUARTER_PI REAL(0x1.921fb54442d18p-1)
#ifdef KINEVERSE_FLOAT
#define QUARTER_PI_REST -0x1.777a5cp-26f
#define LARGEST_LENGTH 1e37f
#define SMALLEST_LENGTH 1e-30f
/* (atan t / t - 1) / t^2 on |t| <= tan(pi/8), z = t^2: 6.6e-10 */
INLINE V arctangent_polynomial(V z) {
  V p = fused(z, splat(-0.0608299422f), splat(0.105958294f));
  p = fused(z, p, splat(-0.1424382678f));
  p = fused(z, p, splat(0.1999848835f));
  return fused(z, p, splat(-0.3333331549f));
}
#else
#define QUARTER_PI_REST 0x1.1a62633145c07p-55
#define LARGEST_LENGTH 1e300
#define SMALLEST_LENGTH 1e-290
/* (atan t / t - 1) / t^2 on |t| <= tan(pi/8), z = t^2: 1.3e-18 */
INLINE V arctangent_polynomial(V z) {
  V p = fused(z, splat(-0.01790624316725345), splat(0.03806357206338629));
  p = fused(z, p, splat(-0.05039261972181992));
  p = fused(z, p, splat(0.05847879124227555));
  p = fused(z, p, splat(-0.06663102590288424));
  p = fused(z, p, splat(0.0769206008714078));
  p = fused(z, p, splat(-0.09090897751214984));
  p = fused(z, p, splat(0.1111111078329987));
  p = fused(z, p, splat(-0.14285714280196393));
  p = fused(z, p, splat(0.19999999999953652));
  return fused(z, p, splat(-0.333333333333332));
}
#endif

APART V atan2_lanes(V y, V x, V r, I wrong) {
  for (int i = 0; i < W; i++)
    if (wrong[i]) r[i] = atan2(y[i], x[i]);
  return r;
}

/* The smaller by the larger magnitude is the tangent of an angle t <= pi/4; from pi/8 on, of t - pi/4. */
INLINE V atan2_(V y, V x) {
  V ay = magnitude(y), ax = magnitude(x);
  I steep = ay > ax;
  V low = select_(steep, ax, ay), high = select_(steep, ay, ax);
  I upper = low > high * splat(REAL(0.4142135623730951));
  V numerator = select_(upper, low - high, low), denominator = select_(upper, high + low, high);
  V t = numerator / denominator, z = t * t;
  V angle = fused(t * z, arctangent_polynomial(z), t);
  angle = angle + (V)((I)splat(QUARTER_PI_REST) & upper);
  angle = angle + (V)((I)splat(QUARTER_PI) & upper);
  V complement = splat(2 * QUARTER_PI) - (angle - splat(2 * QUARTER_PI_REST));
  angle = select_(steep, complement, angle);
  I backward = (I)x < 0;
  V supplement = splat(4 * QUARTER_PI) - (angle - splat(4 * QUARTER_PI_REST));
  V result = with_sign_of(select_(backward, supplement, angle), y);
  I wrong = ~((high <= splat(LARGEST_LENGTH)) & (high >= splat(SMALLEST_LENGTH)));
  if (__builtin_expect(any(wrong), 0)) result = atan2_lanes(y, x, result, wrong);
  return result;
}

INLINE V atan_(V x) { return atan2_(x, splat(REAL(1.0))); }
INLINE V asin_(V x) { return atan2_(x, root((splat(REAL(1.0)) - x) * (splat(REAL(1.0)) + x))); }
INLINE V acos_(V x) { return atan2_(root((splat(REAL(1.0)) - x) * (splat(REAL(1.0)) + x)), x); }

/* In float these are evaluated lane by lane. */
#ifndef KINEVERSE_FLOAT
/* k and r with x = k log 2 + r, |r| <= log(2)/2, and e^r - 1. */
INLINE V expm1_reduced(V x, V *k) {
  V shifted = fused(x, splat(0x1.71547652b82fep+0), splat(6755399441055744.0));
  *k = shifted - splat(6755399441055744.0);
  V r = fused(*k, splat(-0x1.62e42fefa3p-1), x);
  V tail = *k * splat(0x1.3de6af278ece6p-42), whole = r;
  r = whole - tail;
  V lost = (whole - r) - tail, z = r * r;
  /* (e^r - 1 - r) / r^2: 4.9e-19 */
  V p = fused(r, splat(2.09245483500616e-09), splat(2.5109145214777218e-08));
  p = fused(r, p, splat(2.755724242772412e-07));
  p = fused(r, p, splat(2.7557243918235043e-06));
  p = fused(r, p, splat(2.4801587360931267e-05));
  p = fused(r, p, splat(0.00019841269886394203));
  p = fused(r, p, splat(0.001388888888886666));
  p = fused(r, p, splat(0.008333333333321534));
  p = fused(r, p, splat(0.0416666666666667));
  p = fused(r, p, splat(0.16666666666666677));
  p = fused(r, p, splat(0.5));
  return r + fused(z, p, lost);
}

INLINE V power_of_two(V k) {
  I exponent = (I)(k + splat(6755399441055744.0)) & splat_bits(0x7ff);
  return (V)shift_left((exponent + splat_bits(1023)) & splat_bits(0x7ff), 52);
}

APART V exp_lanes(V x, V r) {
  for (int i = 0; i < W; i++)
    if (!(fabs(x[i]) <= 708.0)) r[i] = exp(x[i]);
  return r;
}

INLINE V exp_(V x) {
  V k, e = expm1_reduced(x, &k), result = (e + splat(1.0)) * power_of_two(k);
  if (__builtin_expect(any(magnitude(x) > splat(708.0)), 0)) result = exp_lanes(x, result);
  return result;
}

APART V expm1_lanes(V x, V r) {
  for (int i = 0; i < W; i++)
    if (!(fabs(x[i]) <= 700.0)) r[i] = expm1(x[i]);
  return r;
}

/* e^x - 1 = 2^k (e^r - 1) + (2^k - 1) */
INLINE V expm1_bounded(V x) {
  V k, e = expm1_reduced(x, &k), scale = power_of_two(k);
  return with_sign_of(fused(scale, e, scale - splat(1.0)), x);
}

INLINE V expm1_(V x) {
  V result = expm1_bounded(x);
  if (__builtin_expect(any(magnitude(x) > splat(700.0)), 0)) result = expm1_lanes(x, result);
  return result;
}

/* tanh x = (e^2x - 1) / (e^2x + 1), which is 1 in doubles from 20 on. */
INLINE V tanh_(V x) {
  V a = magnitude(x), bounded = select_(a > splat(20.0), splat(20.0), a);
  V e = expm1_bounded(bounded + bounded);
  return with_sign_of(e / (e + splat(2.0)), x);
}

APART V log_lanes(V x, V r) {
  for (int i = 0; i < W; i++)
    if (!(x[i] >= 0x1p-1022 && x[i] <= 0x1.fffffffffffffp+1023)) r[i] = log(x[i]);
  return r;
}

/* x = 2^k m with m around 1; log m = 2 artanh(s), s = (m - 1) / (m + 1). */
INLINE V log_(V x) {
  I bits = subtract_bits((I)x, splat_bits(0x3fe6a09e667f3bcdLL));
  I k = bits >> 52;
  V m = (V)subtract_bits((I)x, shift_left(k, 52)), f = m - splat(1.0);
  V exponent = (V)(k + (I)splat(6755399441055744.0)) - splat(6755399441055744.0);
  V s = f / (f + splat(2.0)), z = s * s;
  /* (2 artanh(s) / s - 2) / s^2 on |s| <= 0.1716: 1.2e-18 */
  V p = fused(z, splat(0.14795867447475322), splat(0.1531406390232789));
  p = fused(z, p, splat(0.18183563563428665));
  p = fused(z, p, splat(0.22222198593681128));
  p = fused(z, p, splat(0.28571428742112004));
  p = fused(z, p, splat(0.3999999999941642));
  p = fused(z, p, splat(0.6666666666666734));
  V mantissa = fused(s * z, p, s + s);
  V result = fused(exponent, splat(0x1.3de6af278ece6p-42), mantissa);
  result = fused(exponent, splat(0x1.62e42fefa3p-1), result);
  I right = (x >= splat(0x1p-1022)) & (x <= splat(0x1.fffffffffffffp+1023));
  if (__builtin_expect(any(~right), 0)) result = log_lanes(x, result);
  return result;
}
#endif

/* Functions that are seldom used, lane by lane by the C library and in double. */
#define UNARY_BY_LANE(name) \
  static NOINLINE UNUSED V name##_(V x) { \
    for (int i = 0; i < W; i++) x[i] = name(x[i]); \
    return x; \
  }
#define BINARY_BY_LANE(name) \
  static NOINLINE UNUSED V name##_(V x, V y) { \
    for (int i = 0; i < W; i++) x[i] = name(x[i], y[i]); \
    return x; \
  }
UNARY_BY_LANE(sinh)
UNARY_BY_LANE(cosh)
UNARY_BY_LANE(asinh)
UNARY_BY_LANE(acosh)
UNARY_BY_LANE(atanh)
UNARY_BY_LANE(erf)
UNARY_BY_LANE(log1p)
#ifdef KINEVERSE_FLOAT
UNARY_BY_LANE(exp)
UNARY_BY_LANE(expm1)
UNARY_BY_LANE(log)
UNARY_BY_LANE(tanh)
#endif
BINARY_BY_LANE(pow)
BINARY_BY_LANE(fmod)
BINARY_BY_LANE(remainder)
BINARY_BY_LANE(hypot)
