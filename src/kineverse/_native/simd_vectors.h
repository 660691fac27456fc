/* SIMD vectors, in double or float (KINEVERSE_FLOAT): types and arithmetic.

   A vector V contains the same quantity of W configurations, where W is the width of the machine's widest
   register in numbers of type Real. A vector I contains whole numbers of the same size: masks, whose bits
   are all 1 or all 0, and the bits of numbers. The code is generic in W and Real; intrinsics are only used
   for instructions without a notation in the vector extension. Machines without these intrinsics compute
   lane by lane. No program uses all functions. */
#pragma once
#include "definitions.h"

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

#define NOINLINE __attribute__((noinline))
#define APART static __attribute__((noinline, cold, unused))
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
