"""C text: vectors of doubles in GCC's (and Clang's) vector extension, and how rows of numbers become vectors.

A vector ``V`` holds the same quantity of W configurations, as many as the widest register of this machine has
room for. Rows of numbers are brought to that form and back by transposing W×W blocks. Everything is written
for any W; the few instructions that the extension has no notation for are named once, here.
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
