/* The point of a simplex that is nearest to the origin, for GJK. */
#pragma once
#include "support_functions.h"

/* Tolerances of the two bounds: to converge, and to accept when no step improves any more [m]. */
#define MET 1e-10
#define STUCK 1e-9
/* Below this distance the direction between the cores is too uncertain [m]; below the second one it has to
   prove itself, and is that of a face where there is one. */
#define LEAST 1e-7
#define CLOSE 1e-4
#define STEPS 64

/* Points of {b - a}, with the points a that they come from. */
typedef struct {
  int n;
  Vector w[4], a[4];
} Simplex;

/* Point of a simplex nearest to the origin, and the points and weights that it is made of. */
typedef struct {
  int n, which[3];
  double weight[3], square;
  Vector v;
} Part;

static inline Part at_corner(const Simplex *s, int i) {
  return (Part){1, {i}, {1.0}, dot(s->w[i], s->w[i]), s->w[i]};
}

/* The nearest feature of a simplex contains its last point, which was the support point towards the origin:
   other edges and faces are skipped. */
static inline Part on_segment(const Simplex *s, int i, int j) {
  const Vector p = s->w[i], way = plus(s->w[j], -1.0, p);
  const double length = dot(way, way), t = -dot(p, way);
  if (!(t < length)) return at_corner(s, j);
  if (!(t > 0.0)) return at_corner(s, i);
  const Vector v = plus(p, t / length, way);
  return (Part){2, {i, j}, {1.0 - t / length, t / length}, dot(v, v), v};
}

static inline Part on_triangle(const Simplex *s, int i, int j, int k) {
  const Vector p = s->w[i], q = s->w[j], r = s->w[k];
  const Vector n = cross(plus(q, -1.0, p), plus(r, -1.0, p));
  const double x = dot(n, cross(q, r)), y = dot(n, cross(r, p)), z = dot(n, cross(p, q));
  const double sum = x + y + z;
  if (x > 0.0 && y > 0.0 && z > 0.0) {
    const Vector v = plus(plus(plus((Vector){{0.0, 0.0, 0.0}}, x / sum, p), y / sum, q), z / sum, r);
    return (Part){3, {i, j, k}, {x / sum, y / sum, z / sum}, dot(v, v), v};
  }
  const Part one = on_segment(s, i, k), other = on_segment(s, j, k);
  return other.square < one.square ? other : one;
}

/* Has no points if the origin is inside. */
static Part nearest(const Simplex *s) {
  if (s->n == 1) return at_corner(s, 0);
  if (s->n == 2) return on_segment(s, 0, 1);
  if (s->n == 3) return on_triangle(s, 0, 1, 2);
  Part found;
  found.n = 0;
  found.square = INFINITY;
  for (int f = 0; f < 3; f++) {
    const int i = f == 2, j = f == 0 ? 1 : 2, other = 2 - f;
    const Vector p = s->w[3], n = cross(plus(s->w[i], -1.0, p), plus(s->w[j], -1.0, p));
    if (dot(n, plus(s->w[other], -1.0, p)) * -dot(n, p) > 0.0) continue;
    const Part face = on_triangle(s, i, j, 3);
    if (face.square < found.square) found = face;
  }
  return found;
}

/* Point of a face nearest to the origin, along the normal of the face: rounding errors do not turn it. */
static inline Vector foot(const Simplex *s) {
  const Vector n = cross(plus(s->w[1], -1.0, s->w[0]), plus(s->w[2], -1.0, s->w[0]));
  return plus((Vector){{0.0, 0.0, 0.0}}, dot(n, s->w[0]) / dot(n, n), n);
}

static void keep(Simplex *s, const Part *part) {
  for (int k = 0; k < part->n; k++) { /* indices ascend, so nothing is overwritten too early */
    s->w[k] = s->w[part->which[k]];
    s->a[k] = s->a[part->which[k]];
  }
  s->n = part->n;
}
