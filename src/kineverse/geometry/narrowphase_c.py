"""C text: GJK distances and penetration depths of convex solids, after :mod:`.support_c`.

The iteration of Gilbert, Johnson and Keerthi (IEEE J. Robotics and Automation 4, 1988) finds the point v = b
- a of the Minkowski difference {b - a} that is nearest to the origin. The distance of two cores is then
``|v|``; that of two solids is less by their radii, also where these overlap. Every step has a support point w
in direction v, and ``vᵀw / |v| <= distance of the cores <= |v|``. A distance is returned only once both
bounds meet, so it is right whatever the steps were. Of cores that nearly touch, both are those of the last
step, so that its direction is certain. Deeper penetration is left to :data:`PENETRATION`, and uncertain pairs
to coal. Results are remembered only for equal poses, so they depend on the poses alone.

The depth is the distance of the origin from the surface of {b - a}. In the expanding polytope algorithm of
van den Bergen (Proximity queries and penetration depth computation on 3D game objects, 2001), a polytope
inside of {b - a} grows at the face nearest to the origin until that face lies on the surface. The distance of
the face is a lower bound of the depth, and the support of {b - a} along its normal an upper bound. A depth is
returned only once both bounds meet.
"""

SIMPLEX = r"""
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
"""

NARROW = r"""
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
EXPORT void measure(
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
      *known = (Memory){t->count * i + j + 1, t->travel[i], t->travel[j], distances[k]};
      for (int r = 0; r < 9; r++) known->witness[r] = witnesses[9 * k + r];
    }
  }
}

/* Returns 0 only if two objects are certainly further apart than a limit. The search begins in a direction
   from the one to the other, in the world, and leaves there the one that it ends with; 0 for none. */
EXPORT int64_t is_within(const Table *t, int64_t i, int64_t j, double limit, double *direction) {
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
"""


PENETRATION = r"""
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
  const int *c = best.corner;
  const Vector n = best.normal, x = p.w[c[0]], y = p.w[c[1]], z = p.w[c[2]];
  double weight[3] = {dot(n, cross(y, z)), dot(n, cross(z, x)), dot(n, cross(x, y))}, sum = 0.0;
  for (int k = 0; k < 3; k++) sum += weight[k] = larger(weight[k], 0.0);
  if (!(sum > 0.0)) return NAN;
  *a = (Vector){{0.0, 0.0, 0.0}};
  for (int k = 0; k < 3; k++) *a = plus(*a, weight[k] / sum, p.a[c[k]]);
  *normal = (Vector){{-n.x[0], -n.x[1], -n.x[2]}};
  return best.height;
}
"""
