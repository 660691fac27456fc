/* Contact manifolds: further facing points of near pairs.

   Parallel faces are nearest at every point, and GJK returns one of them. A small turn of one solid brings
   another end nearest: its points are where the faces would meet. Physics engines fill their contact
   manifolds in this way. */
#pragma once
#include "near_pairs.h"

/* Turns about each of the two tangents, one way and the other. */
#define TILTS 4

static Vector scaled(double s, Vector a) { return plus((Vector){{0.0, 0.0, 0.0}}, s, a); }

/* Unit vector across another one. */
static Vector tangent_of(Vector n) {
  int least = 0;
  for (int r = 1; r < 3; r++)
    if (fabs(n.x[r]) < fabs(n.x[least])) least = r;
  Vector side = {{0.0, 0.0, 0.0}};
  side.x[least] = 1.0;
  const Vector t = cross(n, side);
  return scaled(1.0 / sqrt(dot(t, t)), t);
}

/* Vector turned about a unit axis (Rodrigues). */
static Vector turned_about(Vector axis, double angle, Vector v) {
  const Vector along = scaled(dot(axis, v) * (1.0 - cos(angle)), axis);
  return plus(plus(along, cos(angle), v), sin(angle), cross(axis, v));
}

/* Points that are nearest once the first object is turned about a point and taken back along the normal, so
   that the turn does not press it into the other one. Returns 0 if GJK does not solve it. */
static int points_after_turn(
    Table *t, int64_t i, int64_t j, Vector pivot, Vector normal, Vector axis, double angle, double *witness) {
  double *pose = t->poses + 12 * i, kept[12], low;
  const double back = 2.0 * fabs(angle) * (t->radius[i] < t->radius[j] ? t->radius[i] : t->radius[j]);
  memcpy(kept, pose, sizeof kept);
  for (int c = 0; c < 4; c++) {
    Vector v = {{kept[c], kept[4 + c], kept[8 + c]}};
    if (c == 3) v = plus(v, -1.0, pivot);
    v = turned_about(axis, angle, v);
    if (c == 3) v = plus(plus(v, 1.0, pivot), -back, normal);
    for (int r = 0; r < 3; r++) pose[4 * r + c] = v.x[r];
  }
  const double distance = measured(t, i, j, INFINITY, witness, &low);
  memcpy(pose, kept, sizeof kept);
  if (!(distance < INFINITY)) return 0;
  Vector a = {{witness[0], witness[1], witness[2]}};
  a = plus(turned_about(axis, -angle, plus(plus(a, back, normal), -1.0, pivot)), 1.0, pivot);
  for (int r = 0; r < 3; r++) {
    witness[r] = a.x[r];
    witness[6 + r] = normal.x[r];
  }
  return 1;
}

/* Writes further facing points of a pair with a known witness, at most 4, `apart` from each other and from
   the nearest one. Returns how many. */
static int64_t face(Table *t, int64_t i, int64_t j, const double *known, double angle, double apart,
                    double *further) {
  int64_t found = 0;
  if (t->corner_count[i] < 0 || t->corner_count[j] < 0) return 0;
  const Vector pivot = {{known[0], known[1], known[2]}}, normal = {{known[6], known[7], known[8]}};
  const Vector tangent = tangent_of(normal);
  for (int turn = 0; turn < TILTS; turn++) {
    const Vector axis = turn < 2 ? tangent : cross(normal, tangent);
    double *point = further + 9 * found;
    int is_new = points_after_turn(t, i, j, pivot, normal, axis, turn % 2 ? -angle : angle, point);
    for (int64_t m = -1; m < found && is_new; m++) {
      const double *other = m < 0 ? known : further + 9 * m;
      is_new = square(point[0] - other[0]) + square(point[1] - other[1]) + square(point[2] - other[2]) >
               square(apart);
    }
    found += is_new;
  }
  return found;
}

/* Facing points that a query is asked for, see FacingPoints in geometry/bindings.py. */
typedef struct {
  const double *margins; /* (bodies, bodies) */
  double usual, angle, apart;
} Facing;

typedef struct {
  double distance;
  int64_t pair;
  double witness[9];
} FacingPoint;

/* Adds further facing points of near pairs to the `kept` results of a query, which are sorted. Returns the
   number of results: -1 without memory; more than there is room for if nothing was added. */
EXPORTED int64_t extend(Table *t, Query *q, const Facing *facing) {
  const int64_t kept = q->kept;
  int64_t found = 0, room = 0;
  FacingPoint *points = NULL;
  for (int64_t k = 0; k < kept; k++) {
    const int32_t i = q->pieces[2 * k], j = q->pieces[2 * k + 1];
    const double margin = facing->margins[t->bodies * q->bodies[2 * k] + q->bodies[2 * k + 1]];
    const double smaller = t->radius[i] < t->radius[j] ? t->radius[i] : t->radius[j];
    if (margin != facing->usual || !(q->distance[k] - margin < 2.0 * facing->angle * smaller)) continue;
    double witnesses[9 * TILTS];
    const int64_t count = face(t, i, j, q->witness + 9 * k, facing->angle, facing->apart, witnesses);
    if (found + count > room) {
      room = 2 * (found + count) + 16;
      FacingPoint *more = realloc(points, room * sizeof(FacingPoint));
      if (!more) {
        free(points);
        return -1;
      }
      points = more;
    }
    for (int64_t m = 0; m < count; m++) {
      FacingPoint one = {0.0, k, {0.0}};
      memcpy(one.witness, witnesses + 9 * m, sizeof one.witness);
      for (int r = 0; r < 3; r++)
        one.distance += one.witness[6 + r] * (one.witness[3 + r] - one.witness[r]);
      int64_t at = found++;
      for (; at && one.distance < points[at - 1].distance; at--) points[at] = points[at - 1];
      points[at] = one;
    }
  }
  if (kept + found <= q->room) {
    /* What pairs they are of is looked up before results move. */
    for (int64_t m = 0; m < found; m++) {
      const int64_t k = points[m].pair;
      memcpy(&points[m].pair, q->pieces + 2 * k, 2 * sizeof(int32_t));
    }
    int64_t last = kept - 1;
    for (int64_t m = found - 1; m >= 0; m--) {
      for (; last >= 0 && q->distance[last] > points[m].distance; last--) {
        const int64_t to = last + m + 1;
        memcpy(q->pieces + 2 * to, q->pieces + 2 * last, 2 * sizeof(int32_t));
        memcpy(q->bodies + 2 * to, q->bodies + 2 * last, 2 * sizeof(int32_t));
        memcpy(q->witness + 9 * to, q->witness + 9 * last, 9 * sizeof(double));
        q->distance[to] = q->distance[last];
      }
      const int64_t to = last + m + 1;
      memcpy(q->pieces + 2 * to, &points[m].pair, 2 * sizeof(int32_t));
      for (int r = 0; r < 2; r++) q->bodies[2 * to + r] = t->body[q->pieces[2 * to + r]];
      memcpy(q->witness + 9 * to, points[m].witness, 9 * sizeof(double));
      q->distance[to] = points[m].distance;
    }
    q->kept = kept + found;
  }
  free(points);
  return kept + found;
}

/* Places the moving objects where a function of some inputs puts them, searches, and adds facing points,
   unless `facing` is NULL. Returns the number of results, or -1 if something is left for single steps. */
EXPORTED int64_t search_at(
    Table *t, Query *q, const Facing *facing, Function compute, const double *inputs, double *poses) {
  if (compute(&inputs, &poses, NULL, NULL, 0) || place(t, poses) != PLACED) return -1;
  const int64_t found = search(t, q);
  if (found < 0 || found > q->room || q->kept < 0) return -1;
  const int64_t kept = facing && q->kept ? extend(t, q, facing) : q->kept;
  return kept <= q->room ? kept : -1;
}
