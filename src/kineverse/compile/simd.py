"""C source of SIMD vector types and of elementary functions within 4 ulp.

A vector ``V`` contains the same quantity of W configurations, where W is the width of the machine's widest
register. Rows of numbers are converted to that form and back by transposing W×W blocks. The code is generic
in W; intrinsics are only used for instructions without a notation in the vector extension.

Every function reduces its argument to a small interval and evaluates a minimax polynomial there (Remez'
algorithm in 60 digits, then rounded; the error is given beside each, an ulp being 1.1e-16 to 2.2e-16). Lanes
outside of the range of the reduction (huge, tiny, infinite, outside of the domain) are computed by the C
library, one by one. NaN propagates.
"""

TYPES = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if defined(__x86_64__) || defined(__i386__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define W 8
#define EACH(f) {f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)}
#elif defined(__AVX__)
#define W 4
#define EACH(f) {f(0), f(1), f(2), f(3)}
#else
#define W 2
#define EACH(f) {f(0), f(1)}
#endif

typedef double V __attribute__((vector_size(8 * W)));
typedef long long I __attribute__((vector_size(8 * W)));
typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias));
typedef double Aligned __attribute__((vector_size(8 * W), may_alias));

#define INLINE static inline __attribute__((always_inline))
#define NOINLINE __attribute__((noinline))
#define APART static __attribute__((noinline, cold))
#define UNROLLED _Pragma("GCC unroll 8")

INLINE V splat(double x) {
#define ITEM(i) x
  return (V)EACH(ITEM);
#undef ITEM
}
INLINE I splat_bits(long long x) {
#define ITEM(i) x
  return (I)EACH(ITEM);
#undef ITEM
}

#define SIGN splat_bits((long long)0x8000000000000000ULL)
#define ONE ((I)splat(1.0))

INLINE V select_(I mask, V a, V b) { return (V)((mask & (I)a) | (~mask & (I)b)); }
INLINE V truth(I mask) { return (V)(mask & ONE); }
INLINE V magnitude(V x) { return (V)((I)x & ~SIGN); }
INLINE V with_sign_of(V x, V s) { return (V)(((I)x & ~SIGN) | ((I)s & SIGN)); }
INLINE I is_true(V x) { return x != splat(0.0); }

/* a * b + c: rounded once where the machine does that in one instruction (FUSED), else twice. */
#if W == 8
#define FUSED 1
INLINE V fused(V a, V b, V c) { return (V)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
INLINE int any(I mask) { return _mm512_movepi64_mask((__m512i)mask) != 0; }
INLINE void stream(double *p, V x) { _mm512_stream_pd(p, (__m512d)x); }
INLINE void stream_end(void) { _mm_sfence(); }
INLINE V root(V x) { return (V)_mm512_sqrt_pd((__m512d)x); }
INLINE V down(V x) { return (V)_mm512_roundscale_pd((__m512d)x, 0x09); }
INLINE V up(V x) { return (V)_mm512_roundscale_pd((__m512d)x, 0x0a); }
#elif W == 4
#ifdef __FMA__
#define FUSED 1
INLINE V fused(V a, V b, V c) { return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
#else
#define FUSED 0
INLINE V fused(V a, V b, V c) { return a * b + c; }
#endif
INLINE int any(I mask) { return _mm256_movemask_pd((__m256d)mask) != 0; }
INLINE void stream(double *p, V x) { _mm256_stream_pd(p, (__m256d)x); }
INLINE void stream_end(void) { _mm_sfence(); }
INLINE V root(V x) { return (V)_mm256_sqrt_pd((__m256d)x); }
INLINE V down(V x) { return (V)_mm256_floor_pd((__m256d)x); }
INLINE V up(V x) { return (V)_mm256_ceil_pd((__m256d)x); }
#else
#ifdef __FP_FAST_FMA
#define FUSED 1
INLINE V fused(V a, V b, V c) {
  return (V){__builtin_fma(a[0], b[0], c[0]), __builtin_fma(a[1], b[1], c[1])};
}
#else
#define FUSED 0
INLINE V fused(V a, V b, V c) { return a * b + c; }
#endif
INLINE int any(I mask) { return (mask[0] | mask[1]) != 0; }
#ifdef __SSE2__
INLINE void stream(double *p, V x) { _mm_stream_pd(p, (__m128d)x); }
INLINE void stream_end(void) { _mm_sfence(); }
INLINE V root(V x) { return (V)_mm_sqrt_pd((__m128d)x); }
#else
INLINE void stream(double *p, V x) { *(Aligned *)p = x; }
INLINE void stream_end(void) {}
INLINE V root(V x) { return (V){sqrt(x[0]), sqrt(x[1])}; }
#endif
INLINE V down(V x) { return (V){floor(x[0]), floor(x[1])}; }
INLINE V up(V x) { return (V){ceil(x[0]), ceil(x[1])}; }
#endif
"""

ROWS = r"""
#ifdef __clang__
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define PICK(a, b, ...) __builtin_shuffle(a, b, (I){__VA_ARGS__})
#endif

/* Transpose W vectors of W numbers: blocks of 1, 2, 4 numbers change places beside the diagonal. */
INLINE void transpose(V *r) {
#if W == 8
  V s[8], t[8];
  UNROLLED for (int i = 0; i < 8; i += 2) {
    s[i] = PICK(r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    s[i + 1] = PICK(r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  UNROLLED for (int i = 0; i < 8; i++) {
    if (i & 2) continue;
    t[i] = PICK(s[i], s[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
    t[i + 2] = PICK(s[i], s[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
  }
  UNROLLED for (int i = 0; i < 4; i++) {
    r[i] = PICK(t[i], t[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[i + 4] = PICK(t[i], t[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
#elif W == 4
  V s[4];
  UNROLLED for (int i = 0; i < 4; i += 2) {
    s[i] = PICK(r[i], r[i + 1], 0, 4, 2, 6);
    s[i + 1] = PICK(r[i], r[i + 1], 1, 5, 3, 7);
  }
  UNROLLED for (int i = 0; i < 2; i++) {
    r[i] = PICK(s[i], s[i + 2], 0, 1, 4, 5);
    r[i + 2] = PICK(s[i], s[i + 2], 2, 3, 6, 7);
  }
#else
  V first = PICK(r[0], r[1], 0, 2);
  r[1] = PICK(r[0], r[1], 1, 3);
  r[0] = first;
#endif
}

/* Read W rows of n numbers; up to W - 1 numbers behind the last row are read and ignored. */
INLINE void read_rows(const double *rows, int n, V *x) {
  for (int c = 0; c < n; c += W) {
    UNROLLED for (int i = 0; i < W; i++) x[c + i] = *(const Unaligned *)(rows + (long long)i * n + c);
    transpose(x + c);
  }
}

/* Write W rows of m numbers; past the caches if `streaming`, for which `rows` and m must be multiples of W.
*/ INLINE void write_rows(const V *x, int m, double *rows, int streaming) {
  V r[W];
  int c = 0;
  for (; c + W <= m; c += W) {
    UNROLLED for (int i = 0; i < W; i++) r[i] = x[c + i];
    transpose(r);
    double *p = rows + c;
    if (streaming) {
      UNROLLED for (int i = 0; i < W; i++, p += m) stream(p, r[i]);
    } else {
      UNROLLED for (int i = 0; i < W; i++, p += m) *(Unaligned *)p = r[i];
    }
  }
  if (c == m) return;
  if (m > W) {
    /* The last columns together with some that are written already. */
    c = m - W;
    UNROLLED for (int i = 0; i < W; i++) r[i] = x[c + i];
    transpose(r);
    double *p = rows + c;
    UNROLLED for (int i = 0; i < W; i++, p += m) *(Unaligned *)p = r[i];
  } else {
    for (; c < m; c++)
      for (int i = 0; i < W; i++) rows[i * m + c] = x[c][i];
  }
}

/* One output. Where rows do not begin at multiples of W they go through `pending`, a piece of them in a cache
that
   is streamed in whole vectors; what is left of a vector waits there for the next rows. */
typedef struct {
  double *next;      /* where the next rows go */
  double *pending;   /* W + W * size numbers, or null to write directly */
  int size, carried, streaming, begun;
} Output;

INLINE void output_begin(Output *o, double *to, int size, double *pending, int streaming) {
  o->next = to;
  o->size = size;
  o->streaming = streaming;
  o->carried = (int)(((size_t)to / 8) % W);
  o->pending = streaming && (o->carried || size % W) ? pending : 0;
  o->begun = 0;
}

INLINE void output_write(Output *o, const V *x) {
  const int numbers = W * o->size, carried = o->carried;
  if (!o->pending) {
    write_rows(x, o->size, o->next, o->streaming);
  } else {
    double *from = o->pending, *to = o->next - carried;
    write_rows(x, o->size, from + carried, 0);
    int i = 0;
    if (carried && !o->begun) {
      /* What is in front of the first row is not ours. */
      memcpy(to + carried, from + carried, (W - carried) * sizeof(double));
      i = W;
    }
    for (; i + W <= numbers; i += W) stream(to + i, *(const Aligned *)(from + i));
    memcpy(from, from + numbers, carried * sizeof(double));
    o->begun = 1;
  }
  o->next += numbers;
}

INLINE void output_end(Output *o) {
  if (o->pending && o->begun) memcpy(o->next - o->carried, o->pending, o->carried * sizeof(double));
}
"""


TRIGONOMETRIC = r"""
/* Where x is close to a multiple of pi/2 the reduced argument is a small difference: pi/2 is subtracted in
parts.
   Up to LARGEST_ANGLE the product of the number of quarter turns and the first part is exact. */
#define LARGEST_ANGLE 1.6e6

APART void sincos_lanes(const V *x, V *s, V *c) {
  for (int i = 0; i < W; i++)
    if (!(fabs((*x)[i]) <= LARGEST_ANGLE)) {
      (*s)[i] = sin((*x)[i]);
      (*c)[i] = cos((*x)[i]);
    }
}

INLINE void sincos_(V x, V *sine, V *cosine) {
  /* Adding 1.5 * 2^52 rounds to a whole number and leaves it in the lowest bits. */
  const V shift = splat(6755399441055744.0);
  V shifted = fused(x, splat(0x1.45f306dc9c883p-1), shift), k = shifted - shift;
  I quadrant = (I)shifted;
#if FUSED
  V r = fused(k, splat(-0x1.921fb54442d18p+0), x);
  /* All parts are positive, so that zero keeps its sign. */
  r = fused(k, splat(-0x1.1a62633145c06p-54), r);
  r = fused(k, splat(-0x1.c1cd129024e09p-107), r);
#else
  V r = x - k * splat(0x1.921fb544p+0);
  r = r - k * splat(0x1.0b4611a6p-34);
  V rest = r, last = k * splat(0x1.3198a2ep-69);
  r = rest - last;
  r = r - (k * splat(0x1.b839a252049c1p-104) - ((rest - r) - last));
#endif
  V z = r * r;
  /* (sin r / r - 1) / r^2 on |r| <= pi/4: 3.5e-18 */
  V p = fused(z, splat(1.589688623753468e-10), splat(-2.505075988500799e-08));
  p = fused(z, p, splat(2.755731370504002e-06));
  p = fused(z, p, splat(-0.00019841269829853325));
  p = fused(z, p, splat(0.008333333333322486));
  p = fused(z, p, splat(-0.16666666666666632));
  /* (cos r - 1 + r^2 / 2) / r^4: 5.7e-20 */
  V q = fused(z, splat(-1.1358732578393472e-11), splat(2.087570511283029e-09));
  q = fused(z, q, splat(-2.755731421529269e-07));
  q = fused(z, q, splat(2.4801587288997478e-05));
  q = fused(z, q, splat(-0.0013888888888873338));
  q = fused(z, q, splat(0.041666666666666595));
  q = fused(z, q, splat(-0.5));
  V s = with_sign_of(fused(z * r, p, r), r), c = fused(z, q, splat(1.0));
  I odd = -(quadrant & 1);
  V a = select_(odd, c, s), b = select_(odd, s, c);
  *sine = (V)((I)a ^ ((quadrant & 2) << 62));
  *cosine = (V)((I)b ^ (((quadrant + 1) & 2) << 62));
  if (__builtin_expect(any(magnitude(x) > splat(LARGEST_ANGLE)), 0)) sincos_lanes(&x, sine, cosine);
}

INLINE V tan_(V x) {
  V s, c;
  sincos_(x, &s, &c);
  return s / c;
}

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
  I upper = low > high * splat(0.4142135623730951);
  V numerator = select_(upper, low - high, low), denominator = select_(upper, high + low, high);
  V t = numerator / denominator, z = t * t;
  /* (atan t / t - 1) / t^2 on |t| <= tan(pi/8): 1.3e-18 */
  V p = fused(z, splat(-0.01790624316725345), splat(0.03806357206338629));
  p = fused(z, p, splat(-0.05039261972181992));
  p = fused(z, p, splat(0.05847879124227555));
  p = fused(z, p, splat(-0.06663102590288424));
  p = fused(z, p, splat(0.0769206008714078));
  p = fused(z, p, splat(-0.09090897751214984));
  p = fused(z, p, splat(0.1111111078329987));
  p = fused(z, p, splat(-0.14285714280196393));
  p = fused(z, p, splat(0.19999999999953652));
  p = fused(z, p, splat(-0.333333333333332));
  V angle = fused(t * z, p, t);
  /* Parts of pi/4, pi/2 and pi beyond the double keep the sums right to the last digit. */
  angle = angle + (V)((I)splat(0x1.1a62633145c07p-55) & upper);
  angle = angle + (V)((I)splat(0x1.921fb54442d18p-1) & upper);
  V complement = splat(0x1.921fb54442d18p+0) - (angle - splat(0x1.1a62633145c07p-54));
  angle = select_(steep, complement, angle);
  I backward = ((I)x >> 63) != 0;
  V supplement = splat(0x1.921fb54442d18p+1) - (angle - splat(0x1.1a62633145c07p-53));
  V result = with_sign_of(select_(backward, supplement, angle), y);
  I wrong = ~((high <= splat(1e300)) & (high >= splat(1e-290)));
  if (__builtin_expect(any(wrong), 0)) result = atan2_lanes(y, x, result, wrong);
  return result;
}

INLINE V atan_(V x) { return atan2_(x, splat(1.0)); }
INLINE V asin_(V x) { return atan2_(x, root((splat(1.0) - x) * (splat(1.0) + x))); }
INLINE V acos_(V x) { return atan2_(root((splat(1.0) - x) * (splat(1.0) + x)), x); }
"""

EXPONENTIAL = r"""
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
  return (V)(((exponent + splat_bits(1023)) & splat_bits(0x7ff)) << 52);
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
  I bits = (I)x - splat_bits(0x3fe6a09e667f3bcdLL);
  I k = bits >> 52;
  V m = (V)((I)x - (k << 52)), f = m - splat(1.0);
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
"""

ARITHMETIC = r"""
/* The first of two equal ones, and where an operand is NaN the other one, as in the C library. */
INLINE V smaller(V a, V b) { return select_((a <= b) | (b != b), a, b); }
INLINE V larger(V a, V b) { return select_((a >= b) | (b != b), a, b); }
INLINE V sign_(V x) {
  return select_(x < splat(0.0), splat(-1.0), select_(x > splat(0.0), splat(1.0), x));
}
"""

# Functions that are seldom used, evaluated lane by lane by the C library.
UNARY_BY_LANE = ("sinh", "cosh", "asinh", "acosh", "atanh", "erf", "log1p")
BINARY_BY_LANE = ("pow", "fmod", "remainder", "hypot")


def scalar_fallbacks() -> str:
    """Return the C of functions without a version for vectors, lane by lane."""
    lanes = "for (int i = 0; i < W; i++)"
    unary = f"static NOINLINE V {{0}}_(V x) {{{{ {lanes} x[i] = {{0}}(x[i]); return x; }}}}\n"
    binary = f"static NOINLINE V {{0}}_(V x, V y) {{{{ {lanes} x[i] = {{0}}(x[i], y[i]); return x; }}}}\n"
    return "".join(map(unary.format, UNARY_BY_LANE)) + "".join(map(binary.format, BINARY_BY_LANE))
