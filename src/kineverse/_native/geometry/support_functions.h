/* Support functions of the cores of convex solids.

   A core is a hull, or the Minkowski sum of a box, an ellipsoid and a ball: a capsule is a line plus a ball,
   a cylinder a line plus a disc. A cone is the hull of a disc and its tip. The support function of a pair is
   that of the Minkowski difference {b - a}. */
#pragma once
#include "broad_phase.h"

/* Corners are padded to multiples of 8, of which W are processed at a time; the result is the same. */
#define LANES 8
#if defined(__AVX512F__)
#define W 8
#elif defined(__AVX2__)
#define W 4
#else
#define W 2
#endif
#define PARTS (LANES / W)

typedef struct { double x[3]; } Vector;

static inline double dot(Vector a, Vector b) {
  return a.x[0] * b.x[0] + a.x[1] * b.x[1] + a.x[2] * b.x[2];
}

static inline Vector plus(Vector a, double s, Vector b) {
  return (Vector){{a.x[0] + s * b.x[0], a.x[1] + s * b.x[1], a.x[2] + s * b.x[2]}};
}

static inline Vector cross(Vector a, Vector b) {
  return (Vector){{a.x[1] * b.x[2] - a.x[2] * b.x[1], a.x[2] * b.x[0] - a.x[0] * b.x[2],
                   a.x[0] * b.x[1] - a.x[1] * b.x[0]}};
}

typedef double Lanes __attribute__((vector_size(8 * W)));
typedef int64_t Numbers __attribute__((vector_size(8 * W)));

/* Largest value of each lane, and its index. */
typedef struct {
  Lanes value;
  Numbers at;
} Largest;

static inline Largest larger_of(Largest a, Largest b) {
  const Numbers more = b.value > a.value;
  const Numbers value = (more & (Numbers)b.value) | (~more & (Numbers)a.value);
  return (Largest){(Lanes)value, (more & b.at) | (~more & a.at)};
}

#ifdef __clang__
#define PICK(a, ...) __builtin_shufflevector(a, a, __VA_ARGS__)
#else
#define PICK(a, ...) __builtin_shuffle(a, (Numbers){__VA_ARGS__})
#endif
#define ACROSS(found, ...) \
  larger_of(found, (Largest){PICK((found).value, __VA_ARGS__), PICK((found).at, __VA_ARGS__)})

/* Values of W corners along a direction. */
static inline Largest reaches(const double *corners, int64_t n, Vector way, int64_t from) {
  Lanes x, y, z;
  memcpy(&x, corners + from, sizeof x);
  memcpy(&y, corners + n + from, sizeof y);
  memcpy(&z, corners + 2 * n + from, sizeof z);
#if W == 8
  const Numbers lane = {0, 1, 2, 3, 4, 5, 6, 7};
#elif W == 4
  const Numbers lane = {0, 1, 2, 3};
#else
  const Numbers lane = {0, 1};
#endif
  return (Largest){way.x[0] * x + way.x[1] * y + way.x[2] * z, lane + from};
}

/* Furthest corner along a direction; the number of corners is a multiple of LANES, all x before all y. No
   branch depends on the data, as it would be unpredictable. Two interleaved searches hide the latency of each
   step. */
INLINE Vector corner(const double *corners, int64_t n, Vector way) {
  Largest found[PARTS], other[PARTS];
  for (int p = 0; p < PARTS; p++) {
    found[p] = reaches(corners, n, way, p * W);
    other[p] = reaches(corners, n, way, n - LANES + p * W);
  }
  for (int64_t k = LANES; k < n - LANES; k += 2 * LANES)
    for (int p = 0; p < PARTS; p++) {
      found[p] = larger_of(found[p], reaches(corners, n, way, k + p * W));
      other[p] = larger_of(other[p], reaches(corners, n, way, k + LANES + p * W));
    }
  for (int p = 0; p < PARTS; p++) found[p] = larger_of(found[p], other[p]);
  for (int half = PARTS / 2; half; half /= 2)
    for (int p = 0; p < half; p++) found[p] = larger_of(found[p], found[p + half]);
  Largest best = found[0];
#if W == 8
  best = ACROSS(best, 4, 5, 6, 7, 0, 1, 2, 3);
  best = ACROSS(best, 2, 3, 0, 1, 6, 7, 4, 5);
  best = ACROSS(best, 1, 0, 3, 2, 5, 4, 7, 6);
#elif W == 4
  best = ACROSS(best, 2, 3, 0, 1);
  best = ACROSS(best, 1, 0, 3, 2);
#else
  best = ACROSS(best, 1, 0);
#endif
  const int64_t k = best.at[0];
  return (Vector){{corners[k], corners[n + k], corners[2 * n + k]}};
}

/* Support point of a core along a direction. */
static inline Vector furthest(const Table *t, int64_t piece, Vector way) {
  const int64_t n = t->corner_count[piece];
  if (n) return corner(t->corners[piece], n, way);
  const double *edges = t->edges + 3 * piece;
  Vector out;
  for (int r = 0; r < 3; r++) out.x[r] = way.x[r] > 0.0 ? edges[r] : -edges[r];
  const double *radii = t->radii + 3 * piece, tip = t->tip[piece];
  if (tip > 0.0) {
    /* A cone: its tip or the rim. */
    const double side = sqrt(square(way.x[0]) + square(way.x[1]));
    if (2.0 * tip * way.x[2] >= radii[0] * side) {
      out.x[2] += tip;
      return out;
    }
    out.x[2] -= tip;
  }
  if (radii[0] > 0.0) {
    double reach = 0.0;
    for (int r = 0; r < 3; r++) reach += square(radii[r] * way.x[r]);
    if (reach > 0.0) /* not along the axis of a disc */
      for (int r = 0; r < 3; r++) out.x[r] += square(radii[r]) * way.x[r] / sqrt(reach);
  }
  return out;
}

static Vector turned(const double *rotation, int64_t stride, int64_t step, Vector p) {
  Vector out;
  for (int r = 0; r < 3; r++)
    out.x[r] = rotation[stride * r] * p.x[0] + rotation[stride * r + step] * p.x[1] +
               rotation[stride * r + 2 * step] * p.x[2];
  return out;
}

/* Pair of objects, in the frame of a. */
typedef struct {
  const Table *t;
  int64_t i, j;
  Vector shift;
  double relative[9]; /* a_R_b */
} Pair;

static Pair pair_of(const Table *t, int64_t i, int64_t j) {
  const double *at_a = t->poses + 12 * i, *at_b = t->poses + 12 * j;
  const Vector apart = {{at_b[3] - at_a[3], at_b[7] - at_a[7], at_b[11] - at_a[11]}};
  Pair p = {t, i, j, turned(at_a, 1, 4, apart), {0.0}};
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++)
      p.relative[3 * r + c] = at_a[r] * at_b[c] + at_a[4 + r] * at_b[4 + c] + at_a[8 + r] * at_b[8 + c];
  return p;
}

/* Support point of {b - a} against a direction, and the point a that it comes from. */
static inline Vector against(const Pair *p, Vector way, Vector *a) {
  const Vector back = {{-way.x[0], -way.x[1], -way.x[2]}};
  *a = furthest(p->t, p->i, way);
  const Vector own = furthest(p->t, p->j, turned(p->relative, 1, 3, back));
  return plus(plus(p->shift, 1.0, turned(p->relative, 3, 1, own)), -1.0, *a);
}
