/* Penetration depths of convex solids.

   The depth is the distance of the origin from the surface of {b - a}. In the expanding polytope algorithm
   of van den Bergen (Proximity queries and penetration depth computation on 3D game objects, 2001), a
   polytope inside of {b - a} grows at the face nearest to the origin until that face lies on the surface.
   The distance of the face is a lower bound of the depth, and the support of {b - a} along its normal an
   upper bound. A depth is returned only once both bounds meet. */
#pragma once
#include "simplex.h"

/* Tolerances of the bounds of a depth: to converge, and to accept when the polytope is full [m]. */
#define DEEP_MET 1e-9
#define DEEP_STUCK 1e-7
#define MOST_CORNERS 160
#define MOST_FACES (2 * MOST_CORNERS)
/* Points nearer to a plane than this part of the size of both are in it. */
#define FLAT 1e-13

typedef struct {
  int corner[3], seen;
  Vector normal;
  double height; /* of the plane above the origin; infinite for a removed face */
} Facet;

typedef struct {
  int corners, faces;
  Vector w[MOST_CORNERS], a[MOST_CORNERS];
  Facet face[MOST_FACES];
  int16_t beside[MOST_CORNERS][MOST_CORNERS]; /* the face to the left of each edge */
} Polytope;

static int add_corner(Polytope *p, Vector w, Vector a) {
  p->w[p->corners] = w;
  p->a[p->corners] = a;
  return p->corners++;
}

/* Writes a face, its corners counter-clockwise from outside; returns 0 if it is degenerate. */
static inline int put_face(Polytope *p, int place, int i, int j, int k) {
  const Vector n = cross(plus(p->w[j], -1.0, p->w[i]), plus(p->w[k], -1.0, p->w[i]));
  const double size = sqrt(dot(n, n));
  if (!(size > 1e-30)) return 0;
  const Vector normal = plus((Vector){{0.0, 0.0, 0.0}}, 1.0 / size, n);
  p->face[place] = (Facet){{i, j, k}, 0, normal, dot(normal, p->w[i])};
  p->beside[i][j] = p->beside[j][k] = p->beside[k][i] = (int16_t)place;
  return 1;
}

static double above(const Polytope *p, int i, int j, int k, Vector w) {
  const Vector n = cross(plus(p->w[j], -1.0, p->w[i]), plus(p->w[k], -1.0, p->w[i]));
  const double size = sqrt(dot(n, n));
  return size > 0.0 ? dot(n, plus(w, -1.0, p->w[i])) / size : 0.0;
}

/* Four corners far from each other; the origin may be outside of them. */
static int spread(Polytope *p, const Pair *pair, double size) {
  Vector w[8], a[8];
  int first = 0, second = 0, third = -1;
  double most = 0.0;
  for (int k = 0; k < 6; k++) {
    Vector way = {{0.0, 0.0, 0.0}};
    way.x[k / 2] = k % 2 ? 1.0 : -1.0;
    w[k] = against(pair, way, a + k);
    for (int m = 0; m < k; m++) {
      const Vector between = plus(w[k], -1.0, w[m]);
      const double square = dot(between, between);
      if (square > most) most = square, first = m, second = k;
    }
  }
  const double enough = 1e-7 * size;
  if (!(sqrt(most) > enough)) return 0;
  const Vector line = plus(w[second], -1.0, w[first]);
  most = square(enough) * dot(line, line);
  for (int k = 0; k < 6; k++) {
    const Vector n = cross(line, plus(w[k], -1.0, w[first]));
    if (dot(n, n) > most) most = dot(n, n), third = k;
  }
  if (third < 0) return 0;
  add_corner(p, w[first], a[first]);
  add_corner(p, w[second], a[second]);
  add_corner(p, w[third], a[third]);
  const Vector n = cross(line, plus(w[third], -1.0, w[first]));
  w[6] = against(pair, n, a + 6);
  w[7] = against(pair, (Vector){{-n.x[0], -n.x[1], -n.x[2]}}, a + 7);
  const int last = fabs(above(p, 0, 1, 2, w[6])) > fabs(above(p, 0, 1, 2, w[7])) ? 6 : 7;
  add_corner(p, w[last], a[last]);
  return fabs(above(p, 0, 1, 2, w[last])) > enough;
}

static int begin(Polytope *p, const Pair *pair, const Simplex *s, double size) {
  p->corners = p->faces = 0;
  if (s)
    for (int k = 0; k < 4; k++) add_corner(p, s->w[k], s->a[k]);
  if (!s || !(fabs(above(p, 0, 1, 2, p->w[3])) > 1e-7 * size)) {
    p->corners = 0;
    if (!spread(p, pair, size)) return 0;
  }
  const int turn = above(p, 0, 1, 2, p->w[3]) > 0.0, i = turn, j = !turn;
  p->faces = 4;
  return put_face(p, 0, i, j, 2) && put_face(p, 1, j, i, 3) && put_face(p, 2, 2, j, 3) &&
         put_face(p, 3, i, 2, 3);
}

/* Adds a corner above a face and replaces all faces that are visible from it or coplanar with it; returns 0
   if these are not connected. New faces reuse the slots of removed ones, which keeps searches short. */
static int grow(Polytope *p, int from, Vector w, Vector a, double flat) {
  int16_t waiting[MOST_FACES], gone[MOST_FACES], next[MOST_CORNERS];
  int depth = 0, count = 0, edges = 0, start = 0;
  const int tip = add_corner(p, w, a);
  for (int k = 0; k < tip; k++) next[k] = -1;
  waiting[depth++] = (int16_t)from;
  p->face[from].seen = 1;
  while (depth) {
    const int f = waiting[--depth];
    gone[count++] = (int16_t)f;
    for (int k = 0; k < 3; k++) {
      const int i = p->face[f].corner[k], j = p->face[f].corner[(k + 1) % 3], other = p->beside[j][i];
      Facet *facet = p->face + other;
      if (facet->seen) continue;
      if (dot(facet->normal, w) - facet->height > -flat) {
        facet->seen = 1;
        waiting[depth++] = (int16_t)other;
      } else {
        if (next[i] >= 0) return 0;
        next[i] = (int16_t)j;
        start = i;
        edges++;
      }
    }
  }
  /* Faces are written last, as the loop above reads the old edges. */
  int round = 0;
  for (int i = start; round < edges; round++) {
    const int j = next[i];
    if (round == count && p->faces == MOST_FACES) return 0;
    if (round == count) gone[count++] = (int16_t)p->faces++;
    if (j < 0 || !put_face(p, gone[round], i, j, tip)) return 0;
    i = j;
    if (i == start && round + 1 < edges) return 0;
  }
  for (; round < count; round++) p->face[gone[round]].height = INFINITY;
  return edges >= 3;
}

/* Point of a triangle nearest to another point. */
static Part on_facet(const Polytope *p, const Facet *facet, Vector v, Simplex *s) {
  s->n = 3;
  for (int k = 0; k < 3; k++) {
    s->w[k] = plus(p->w[facet->corner[k]], -1.0, v);
    s->a[k] = p->a[facet->corner[k]];
  }
  const Part part = on_triangle(s, 0, 1, 2), edge = on_segment(s, 0, 1);
  return edge.square < part.square ? edge : part;
}

/* Point a that the foot of the origin on a facet's plane comes from. The foot is on the surface of {b - a},
   but where triangles share a plane, or nearly, it may be in another one than that which was found. */
static Vector point_below(const Polytope *p, const Facet *facet) {
  const Vector foot = plus((Vector){{0.0, 0.0, 0.0}}, facet->height, facet->normal);
  Simplex s, other;
  Part part = on_facet(p, facet, foot, &s);
  if (part.square > square(DEEP_MET))
    for (int f = 0; f < p->faces; f++) {
      if (!(p->face[f].height <= facet->height + DEEP_STUCK)) continue;
      const Part one = on_facet(p, p->face + f, foot, &other);
      if (one.square < part.square) part = one, s = other;
    }
  Vector a = {{0.0, 0.0, 0.0}};
  for (int k = 0; k < part.n; k++) a = plus(a, part.weight[k], s.a[part.which[k]]);
  return a;
}

/* Returns the depth of two cores, the deepest point a of the first and the normal from there to the second,
   in the frame of the first; NaN if the bounds do not meet, or the cores do not overlap. A simplex of four
   points is the initial polytope. */
static double depth_of(const Pair *pair, const Simplex *s, double size, Vector *a, Vector *normal) {
  Polytope p;
  if (!begin(&p, pair, s, size)) return NAN;
  double high = INFINITY, low = -INFINITY;
  Facet best;
  for (;;) {
    int nearest = 0;
    for (int f = 1; f < p.faces; f++)
      if (p.face[f].height < p.face[nearest].height) nearest = f;
    const Facet facet = p.face[nearest];
    low = facet.height;
    if (p.corners == MOST_CORNERS) break;
    Vector from;
    const Vector m = facet.normal, w = against(pair, (Vector){{-m.x[0], -m.x[1], -m.x[2]}}, &from);
    const double reach = dot(m, w);
    if (reach - low <= DEEP_STUCK && reach < high) {
      high = reach;
      best = facet;
    }
    if (reach - low <= DEEP_MET || !grow(&p, nearest, w, from, FLAT * size)) break;
  }
  if (!(high - low <= DEEP_STUCK && best.height >= -LEAST)) return NAN;
  const Vector n = best.normal;
  *a = point_below(&p, &best);
  *normal = (Vector){{-n.x[0], -n.x[1], -n.x[2]}};
  return best.height;
}
