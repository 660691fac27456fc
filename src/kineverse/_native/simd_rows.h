/* Rows of doubles in and out of SIMD vectors.

   They are transposed in blocks of W by W numbers, and results may be written past the caches. */
#pragma once
#include "simd_vectors.h"

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
