"""C text: contact manifolds, further facing points of near pairs, after :mod:`.narrowphase_c`.

Parallel faces are nearest at every point, and GJK returns one of them. A small turn of one solid brings
another end nearest: its points are where the faces would meet. Physics engines fill their contact manifolds
in this way.
"""

MANIFOLD = r"""
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

/* Writes further facing points of pairs with known witnesses, at most 4 a pair, `apart` from each other and
   from the nearest one, with the index of the pair and the distance along its normal. Returns how many. */
EXPORT int64_t extend(Table *t, const int32_t *pairs, int64_t n, const double *witnesses, double angle,
                      double apart, int64_t *which, double *distances, double *further) {
  int64_t found = 0;
  for (int64_t k = 0; k < n; k++) {
    const int64_t i = pairs[2 * k], j = pairs[2 * k + 1], first = found;
    if (t->corner_count[i] < 0 || t->corner_count[j] < 0) continue;
    const double *known = witnesses + 9 * k;
    const Vector pivot = {{known[0], known[1], known[2]}}, normal = {{known[6], known[7], known[8]}};
    const Vector tangent = tangent_of(normal);
    for (int turn = 0; turn < TILTS; turn++) {
      const Vector axis = turn < 2 ? tangent : cross(normal, tangent);
      double *point = further + 9 * found;
      int is_new =
          points_after_turn(t, i, j, pivot, normal, axis, turn % 2 ? -angle : angle, point);
      for (int64_t m = first - 1; m < found && is_new; m++) {
        const double *other = m < first ? known : further + 9 * m;
        is_new = square(point[0] - other[0]) + square(point[1] - other[1]) + square(point[2] - other[2]) >
                 square(apart);
      }
      if (!is_new) continue;
      distances[found] = 0.0;
      for (int r = 0; r < 3; r++) distances[found] += normal.x[r] * (point[3 + r] - point[r]);
      which[found++] = k;
    }
  }
  return found;
}
"""
