"""C source of SIMD vectors, in double or float: types, arithmetic, and rows of doubles in and out.

A vector ``V`` contains the same quantity of W configurations, where W is the width of the machine's widest
register in numbers of type ``Real``. A vector ``I`` contains whole numbers of the same size: masks, whose
bits are all 1 or all 0, and the bits of numbers. The code is generic in W and ``Real``; intrinsics are only
used for instructions without a notation in the vector extension. Machines without these intrinsics compute
lane by lane. Rows are transposed in blocks of W by W numbers, and results may be written past the caches.
"""

from __future__ import annotations

from .simd_functions import EXPONENTIAL, TRIGONOMETRIC, Scalar, scalar_fallbacks

_TYPES = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if defined(__AVX__) && !defined(__clang__) && (__GNUC__ == 11 || __GNUC__ == 12)
/* Part of <immintrin.h>, in its order: all of it takes gcc 0.6 s, several times as long as most programs. */
#define _IMMINTRIN_H_INCLUDED
#include <smmintrin.h>
#include <avxintrin.h>
#ifdef __FMA__
#include <fmaintrin.h>
#endif
#ifdef __AVX512DQ__
#include <avx2intrin.h>
#include <avx512fintrin.h>
#include <avx512dqintrin.h>
#endif
#elif defined(__x86_64__) || defined(__i386__)
#include <immintrin.h>
#elif defined(__aarch64__) && defined(__ARM_NEON)
#include <arm_neon.h>
#endif

/* Bytes of a vector. */
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define REGISTER 64
#elif defined(__AVX__)
#define REGISTER 32
#else
#define REGISTER 16
#endif

#ifdef KINEVERSE_FLOAT
typedef float Real;
typedef int Bits;
typedef unsigned UnsignedBits;
#define REAL(x) x##f
#define W (REGISTER / 4)
#else
typedef double Real;
typedef long long Bits;
typedef unsigned long long UnsignedBits;
#define REAL(x) x
#define W (REGISTER / 8)
#endif

#if W == 16
#define EACH(f) {f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7), \
                 f(8), f(9), f(10), f(11), f(12), f(13), f(14), f(15)}
#elif W == 8
#define EACH(f) {f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)}
#elif W == 4
#define EACH(f) {f(0), f(1), f(2), f(3)}
#else
#define EACH(f) {f(0), f(1)}
#endif

typedef Real V __attribute__((vector_size(REGISTER)));
typedef Bits I __attribute__((vector_size(REGISTER)));
typedef UnsignedBits U __attribute__((vector_size(REGISTER)));
typedef Real Unaligned __attribute__((vector_size(REGISTER), aligned(sizeof(Real)), may_alias));
typedef Real Aligned __attribute__((vector_size(REGISTER), may_alias));

#define INLINE static inline __attribute__((always_inline))
#define NOINLINE __attribute__((noinline))
#define APART static __attribute__((noinline, cold))
#define EXPORTED __attribute__((visibility("default")))
#define UNROLLED _Pragma("GCC unroll 16")

INLINE V splat(Real x) {
#define ITEM(i) x
  return (V)EACH(ITEM);
#undef ITEM
}
INLINE I splat_bits(Bits x) {
#define ITEM(i) x
  return (I)EACH(ITEM);
#undef ITEM
}

#define SIGN ((I)splat(REAL(-0.0)))
#define ONE ((I)splat(REAL(1.0)))

INLINE V select_(I mask, V a, V b) { return (V)((mask & (I)a) | (~mask & (I)b)); }
INLINE V truth(I mask) { return (V)(mask & ONE); }
INLINE V magnitude(V x) { return (V)((I)x & ~SIGN); }
INLINE V with_sign_of(V x, V s) { return (V)(((I)x & ~SIGN) | ((I)s & SIGN)); }
/* Of bits that may overflow, which signed numbers must not. */
INLINE I add_bits(I a, I b) { return (I)((U)a + (U)b); }
INLINE I subtract_bits(I a, I b) { return (I)((U)a - (U)b); }
INLINE I shift_left(I a, int n) { return (I)((U)a << n); }
INLINE I is_true(V x) { return x != splat(REAL(0.0)); }
"""

_ARITHMETIC = r"""
#ifdef KINEVERSE_FLOAT
#define X86(bits, name) _mm##bits##_##name##_ps
#define X86_MASK _mm512_movepi32_mask
#define NEON(name) (V)name##_f32
#define NEON_TYPE float32x4_t
#else
#define X86(bits, name) _mm##bits##_##name##_pd
#define X86_MASK _mm512_movepi64_mask
#define NEON(name) (V)name##_f64
#define NEON_TYPE float64x2_t
#endif

/* fused: a * b + c, rounded once where the machine does that in one instruction (FUSED), else twice. */
#if REGISTER == 64
#define FUSED 1
INLINE V fused(V a, V b, V c) { return X86(512, fmadd)(a, b, c); }
INLINE int any(I mask) { return X86_MASK((__m512i)mask) != 0; }
INLINE V root(V x) { return X86(512, sqrt)(x); }
INLINE V down(V x) { return X86(512, roundscale)(x, 0x09); }
INLINE V up(V x) { return X86(512, roundscale)(x, 0x0a); }
#elif REGISTER == 32
#ifdef __FMA__
#define FUSED 1
INLINE V fused(V a, V b, V c) { return X86(256, fmadd)(a, b, c); }
#else
#define FUSED 0
#endif
INLINE int any(I mask) { return X86(256, movemask)((V)mask) != 0; }
INLINE V root(V x) { return X86(256, sqrt)(x); }
INLINE V down(V x) { return X86(256, floor)(x); }
INLINE V up(V x) { return X86(256, ceil)(x); }
#elif defined(__aarch64__) && defined(__ARM_NEON)
#define FUSED 1
INLINE V fused(V a, V b, V c) { return NEON(vfmaq)((NEON_TYPE)c, (NEON_TYPE)a, (NEON_TYPE)b); }
INLINE int any(I mask) { return vmaxvq_u32((uint32x4_t)mask) != 0; }
INLINE V root(V x) { return NEON(vsqrtq)((NEON_TYPE)x); }
INLINE V down(V x) { return NEON(vrndmq)((NEON_TYPE)x); }
INLINE V up(V x) { return NEON(vrndpq)((NEON_TYPE)x); }
#else
#define FUSED 0
#ifdef __SSE2__
INLINE int any(I mask) { return X86(, movemask)((V)mask) != 0; }
INLINE V root(V x) { return X86(, sqrt)(x); }
#else
INLINE int any(I mask) {
  Bits some = 0;
  UNROLLED for (int i = 0; i < W; i++) some |= mask[i];
  return some != 0;
}
INLINE V root(V x) {
  UNROLLED for (int i = 0; i < W; i++) x[i] = sqrt(x[i]);
  return x;
}
#endif
INLINE V down(V x) {
  UNROLLED for (int i = 0; i < W; i++) x[i] = floor(x[i]);
  return x;
}
INLINE V up(V x) {
  UNROLLED for (int i = 0; i < W; i++) x[i] = ceil(x[i]);
  return x;
}
#endif
#if !FUSED
INLINE V fused(V a, V b, V c) { return a * b + c; }
#endif

/* The first of two equal ones, and where an operand is NaN the other one, as in the C library. */
INLINE V smaller(V a, V b) { return select_((a <= b) | (b != b), a, b); }
INLINE V larger(V a, V b) { return select_((a >= b) | (b != b), a, b); }
INLINE V sign_(V x) {
  return select_(x < splat(REAL(0.0)), splat(REAL(-1.0)), select_(x > splat(REAL(0.0)), splat(REAL(1.0)), x));
}
"""


def vector_header(scalar: Scalar) -> str:
    """Return the C header of vectors: types, arithmetic and elementary functions.

    Generated functions and other C that is compiled with the flags of the same :class:`.Toolchain` have the
    same vectors, and so may call each other.

    Notes
    -----
    ``V``, ``I``
        A vector of ``W`` numbers of type ``Real``, and one of as many whole numbers of type ``Bits``.
    ``REAL(1.5)``
        A literal.
    ``INLINE``, ``NOINLINE``, ``APART``, ``EXPORTED``, ``UNROLLED``
        How functions and loops are compiled.
    ``splat``, ``splat_bits``
        The vector of one number.
    ``a < b``, ``any``, ``select_``, ``truth``, ``is_true``
        Masks, whether a lane is set, the choice by a mask, and masks as the numbers 0 and 1 and back.
    ``fused``, ``root``, ``down``, ``up``, ``smaller``, ``larger``, ``magnitude``, ``sign_``, ``with_sign_of``
        Arithmetic.
    ``sincos_``, ``tan_``, ``atan2_``, ``asin_``, ``acos_``, ``atan_``, ``exp_``, ``expm1_``, ``log_``, ...
        Elementary functions, within 4 ulp.
    """
    texts = [_TYPES, _ARITHMETIC, TRIGONOMETRIC]
    if scalar == "float":
        texts.insert(0, "#define KINEVERSE_FLOAT\n")
    else:
        texts.append(EXPONENTIAL)
    return "".join([*texts, scalar_fallbacks(scalar)])


ROWS = r"""
#if REGISTER == 64
INLINE void stream(double *p, V x) { _mm512_stream_pd(p, x); }
INLINE void stream_end(void) { _mm_sfence(); }
#elif REGISTER == 32
INLINE void stream(double *p, V x) { _mm256_stream_pd(p, x); }
INLINE void stream_end(void) { _mm_sfence(); }
#elif defined(__SSE2__)
INLINE void stream(double *p, V x) { _mm_stream_pd(p, x); }
INLINE void stream_end(void) { _mm_sfence(); }
#else
INLINE void stream(double *p, V x) { *(Aligned *)p = x; }
INLINE void stream_end(void) {}
#endif

#ifdef __clang__
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define PICK(a, b, ...) __builtin_shuffle(a, b, (I){__VA_ARGS__})
#endif

/* Transpose W vectors of W numbers: blocks of 1, 2, 4 numbers change places next to the diagonal. */
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

/* Write W rows of m numbers; past the caches if `streaming`: `rows` and m must be multiples of W then. */
INLINE void write_rows(const V *x, int m, double *rows, int streaming) {
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

/* One output. Where rows do not begin at multiples of W they go through `pending`, a piece of them in a
   cache that is streamed in whole vectors; what is left of a vector waits there for the next rows. */
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
