/* GJK distances of convex solids.

   The iteration of Gilbert, Johnson and Keerthi (IEEE J. Robotics and Automation 4, 1988) finds the point v
   = b - a of the Minkowski difference {b - a} that is nearest to the origin. The distance of two cores is
   then |v|; that of two solids is less by their radii, also where these overlap. Every step has a support
   point w in direction v, and vᵀw / |v| <= distance of the cores <= |v|. A distance is returned only once
   both bounds meet, so it is right whatever the steps were. Of cores that nearly touch, both are those of
   the last step, so that its direction is certain. Deeper penetration is left to penetration_depth.h, and
   uncertain pairs to coal. Results are remembered only for equal poses, so they depend on the poses alone. */
#pragma once
#include "penetration_depth.h"

/* Writes the points of both and the normal in the world, for a in the frame of the first object. */
static void write(const Table *t, int64_t i, Vector a, Vector normal, double distance, double *witness) {
  const double *pose = t->poses + 12 * i;
  const Vector world_a = turned(pose, 4, 1, a), world_n = turned(pose, 4, 1, normal);
  for (int r = 0; r < 3; r++) {
    witness[r] = world_a.x[r] + pose[4 * r + 3];
    witness[3 + r] = witness[r] + distance * world_n.x[r];
    witness[6 + r] = world_n.x[r];
  }
}

/* Distance of overlapping cores: minus their depth and both radii. */
static double deep(const Table *t, int64_t i, int64_t j, const Pair *p, const Simplex *s, double *witness,
                   double *low) {
  Vector a, normal;
  const double depth = depth_of(p, s, t->radius[i] + t->radius[j], &a, &normal);
  if (isnan(depth)) return NAN;
  const double distance = -depth - t->round[i] - t->round[j];
  write(t, i, plus(a, t->round[i], normal), normal, distance, witness);
  *low = distance;
  return distance;
}

/* Writes the points of both and the normal in the world. Returns NaN for unsolved pairs, and infinity beyond
   the limit, where `low` is a lower bound of the distance. */
static double measured(const Table *t, int64_t i, int64_t j, double limit, double *witness, double *low) {
  if (t->corner_count[i] < 0 || t->corner_count[j] < 0) return NAN;
  const Pair pair = pair_of(t, i, j);
  const double round_a = t->round[i], round_b = t->round[j];
  const double *p = t->place + 3 * i, *q = t->place + 3 * j;
  Vector v = turned(t->poses + 12 * i, 1, 4, (Vector){{q[0] - p[0], q[1] - p[1], q[2] - p[2]}});
  Simplex s;
  Part part = {0};
  s.n = 0;
  double high = INFINITY, best = -INFINITY;
  for (int step = 0; step < STEPS; step++) {
    const double length = sqrt(dot(v, v));
    if (!(length > 0.0)) return deep(t, i, j, &pair, NULL, witness, low);
    Vector a;
    const Vector w = against(&pair, v, &a);
    const double bound = dot(v, w) / length;
    best = high < CLOSE ? bound : larger(best, bound);
    const double known = best - round_a - round_b;
    /* Stop only halfway to the upper bound, so that the lower bound is of use at later states. */
    if (known > limit + STUCK && 2.0 * best > high + limit + round_a + round_b) {
      *low = known;
      return INFINITY;
    }
    if (high - best <= MET) break;
    s.w[s.n] = w;
    s.a[s.n] = a;
    s.n++;
    const Part next = nearest(&s);
    if (!next.n) return deep(t, i, j, &pair, &s, witness, low);
    const double nearer = sqrt(next.square);
    if (!(nearer < high)) break; /* The previous point is the better one. */
    keep(&s, &next);
    part = next;
    high = nearer;
    if (high < CLOSE && part.n == 3) {
      part.v = foot(&s);
      high = sqrt(dot(part.v, part.v));
    }
    v = part.v;
    if (high < LEAST) return deep(t, i, j, &pair, NULL, witness, low);
  }
  if (!(high - best <= STUCK)) return high < CLOSE ? deep(t, i, j, &pair, NULL, witness, low) : NAN;
  Vector a = {{0.0, 0.0, 0.0}};
  for (int k = 0; k < part.n; k++) a = plus(a, part.weight[k], s.a[k]);
  const Vector normal = plus((Vector){{0.0, 0.0, 0.0}}, 1.0 / high, part.v);
  const double distance = high - round_a - round_b;
  write(t, i, plus(a, round_a, normal), normal, distance, witness);
  *low = distance;
  return distance;
}

/* Measures pairs of objects, and records bounds of their distances. Remembered pairs are not
   measured again. */
EXPORTED void measure(
    Table *t, const int32_t *pairs, int64_t n, double limit, double *distances, double *witnesses) {
  for (int64_t k = 0; k < n; k++) {
    const int64_t i = pairs[2 * k], j = pairs[2 * k + 1];
    Memory *known = memory_of(t, i, j);
    if (is_known(known, t, i, j)) {
      distances[k] = known->distance;
      for (int r = 0; r < 9; r++) witnesses[9 * k + r] = known->witness[r];
      continue;
    }
    double low = 0.0;
    distances[k] = measured(t, i, j, limit, witnesses + 9 * k, &low);
    if (t->bounds && !isnan(distances[k]))
      t->bounds[t->count * i + j] = low + t->travel[i] + t->travel[j];
    if (distances[k] < INFINITY) {
      *known = (Memory){t->count * i + j + 1, t->travel[i], t->travel[j], distances[k], {0}};
      for (int r = 0; r < 9; r++) known->witness[r] = witnesses[9 * k + r];
    }
  }
}

/* Returns 0 only if two objects are certainly further apart than a limit. The search begins in a direction
   from the one to the other, in the world, and leaves there the one that it ends with; 0 for none. */
EXPORTED int64_t is_within(const Table *t, int64_t i, int64_t j, double limit, double *direction) {
  if (lower_bound(t, i, j) > limit) return 0;
  if (t->corner_count[i] < 0 || t->corner_count[j] < 0) return 1;
  const Pair pair = pair_of(t, i, j);
  const double reach = limit + t->round[i] + t->round[j], *p = t->place + 3 * i, *q = t->place + 3 * j;
  Vector start = {{direction[0], direction[1], direction[2]}};
  if (!(dot(start, start) > 0.0)) start = (Vector){{q[0] - p[0], q[1] - p[1], q[2] - p[2]}};
  Vector v = turned(t->poses + 12 * i, 1, 4, start);
  Simplex s;
  s.n = 0;
  double high = INFINITY;
  for (int step = 0; step < STEPS; step++) {
    const double length = sqrt(dot(v, v));
    if (!(length > LEAST)) return 1;
    Vector a;
    const Vector w = against(&pair, v, &a);
    if (dot(v, w) / length > reach) {
      const Vector way = turned(t->poses + 12 * i, 4, 1, v);
      for (int r = 0; r < 3; r++) direction[r] = way.x[r] / length;
      return 0;
    }
    s.w[s.n] = w;
    s.a[s.n++] = a;
    const Part next = nearest(&s);
    if (!next.n) return 1;
    const double nearer = sqrt(next.square);
    if (nearer <= reach || !(nearer < high)) return 1;
    keep(&s, &next);
    v = next.v;
    high = nearer;
  }
  return 1;
}
