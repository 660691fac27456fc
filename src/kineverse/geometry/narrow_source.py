"""C text: distances of all convex solids but cones, after the table of :mod:`.sweep_source`.

They are a *core*, a hull plus a box plus an ellipsoid, all within a radius: a capsule is a line within one, a
cylinder a line plus a disc. With v = b - a the nearest point to the origin of {b - a}, found by the iteration
of Gilbert, Johnson and Keerthi (IEEE J. Robotics and Automation 4, 1988), the distance of two is ``|v|`` less
their radii, also where these overlap. Every step has a support point w in direction v, and ``vᵀw / |v| <=
distance of the cores <= |v|``: an answer is given only once the two meet, so it is right however the steps
went. Everything else is left to coal. Nothing is remembered from one call to the next: an answer follows from
the poses alone.
"""

NARROW = r"""
/* The two bounds of a distance have to meet to this [m], or if no step is better any more, to the second. */
#define MET 1e-10
#define STUCK 1e-9
/* Nearer than this the direction from core to core is not known well enough [m]. */
#define LEAST 1e-5
#define STEPS 64
#define LANES 8

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

/* The corner that is furthest in a direction; their number is a multiple of LANES, all x before all y. */
static Vector corner(const double *corners, int64_t n, Vector way) {
  const double *x = corners, *y = corners + n, *z = corners + 2 * n;
  const double a = way.x[0], b = way.x[1], c = way.x[2];
  double best[LANES], at[LANES];
  for (int l = 0; l < LANES; l++) {
    best[l] = a * x[l] + b * y[l] + c * z[l];
    at[l] = l;
  }
  for (int64_t k = LANES; k < n; k += LANES)
    for (int l = 0; l < LANES; l++) {
      const double value = a * x[k + l] + b * y[k + l] + c * z[k + l];
      at[l] = value > best[l] ? (double)(k + l) : at[l];
      best[l] = value > best[l] ? value : best[l];
    }
  int first = 0;
  for (int l = 1; l < LANES; l++)
    if (best[l] > best[first] || (best[l] == best[first] && at[l] < at[first])) first = l;
  const int64_t k = (int64_t)at[first];
  return (Vector){{x[k], y[k], z[k]}};
}

/* The point of a core that is furthest in a direction. */
static inline Vector furthest(const Table *t, int64_t piece, Vector way) {
  const double *edges = t->edges + 3 * piece;
  const int64_t n = t->corner_count[piece];
  Vector out = n ? corner(t->corners[piece], n, way) : (Vector){{0.0, 0.0, 0.0}};
  for (int r = 0; r < 3; r++) out.x[r] += way.x[r] > 0.0 ? edges[r] : -edges[r];
  const double *radii = t->radii + 3 * piece;
  if (radii[0] > 0.0) {
    double reach = 0.0;
    for (int r = 0; r < 3; r++) reach += square(radii[r] * way.x[r]);
    if (reach > 0.0) /* not along the axis of a disc */
      for (int r = 0; r < 3; r++) out.x[r] += square(radii[r]) * way.x[r] / sqrt(reach);
  }
  return out;
}

/* Some points of {b - a} with the points a that they come from. */
typedef struct {
  int n;
  Vector w[4], a[4];
} Simplex;

/* The nearest point to the origin of a simplex, and the points with weights that make it. */
typedef struct {
  int n, which[3];
  double weight[3], square;
  Vector v;
} Part;

static inline Part at_corner(const Simplex *s, int i) {
  return (Part){1, {i}, {1.0}, dot(s->w[i], s->w[i]), s->w[i]};
}

/* The last point of a simplex is where the way to the origin led to, so that what is nearest has it in: edges
   and faces without it are left out. */
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

/* None of the points if the origin is inside. */
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

static void keep(Simplex *s, const Part *part) {
  for (int k = 0; k < part->n; k++) { /* which is in order, so nothing is overwritten too early */
    s->w[k] = s->w[part->which[k]];
    s->a[k] = s->a[part->which[k]];
  }
  s->n = part->n;
}

static Vector turned(const double *rotation, int64_t stride, int64_t step, Vector p) {
  Vector out;
  for (int r = 0; r < 3; r++)
    out.x[r] = rotation[stride * r] * p.x[0] + rotation[stride * r + step] * p.x[1] +
               rotation[stride * r + 2 * step] * p.x[2];
  return out;
}

/* Writes the points of both and the normal in the world. Returns NaN for what is not solved, and infinity
   for what is further apart than the limit; `low` is what is known of the distance then. */
static double measured(const Table *t, int64_t i, int64_t j, double limit, double *witness, double *low) {
  if (t->corner_count[i] < 0 || t->corner_count[j] < 0) return NAN;
  const double *at_a = t->poses + 12 * i, *at_b = t->poses + 12 * j;
  const double round_a = t->round[i], round_b = t->round[j];
  const Vector apart = {{at_b[3] - at_a[3], at_b[7] - at_a[7], at_b[11] - at_a[11]}};
  const Vector shift = turned(at_a, 1, 4, apart);
  double relative[9]; /* a_R_b */
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++)
      relative[3 * r + c] = at_a[r] * at_b[c] + at_a[4 + r] * at_b[4 + c] + at_a[8 + r] * at_b[8 + c];
  const double *p = t->place + 3 * i, *q = t->place + 3 * j;
  Vector v = turned(at_a, 1, 4, (Vector){{q[0] - p[0], q[1] - p[1], q[2] - p[2]}});
  Simplex s;
  Part part = {0};
  s.n = 0;
  double high = INFINITY, best = -INFINITY;
  for (int step = 0; step < STEPS; step++) {
    const double length = sqrt(dot(v, v));
    if (!(length > 0.0)) return NAN;
    const Vector back = {{-v.x[0], -v.x[1], -v.x[2]}};
    const Vector a = furthest(t, i, v);
    const Vector own = furthest(t, j, turned(relative, 1, 3, back));
    const Vector b = plus(shift, 1.0, turned(relative, 3, 1, own));
    const Vector w = plus(b, -1.0, a);
    best = larger(best, dot(v, w) / length);
    const double known = best - round_a - round_b;
    /* Half of the way to what is known from the other side, so that it is of use for some states. */
    if (known > limit + STUCK && 2.0 * best > high + limit + round_a + round_b) {
      *low = known;
      return INFINITY;
    }
    if (high - best <= MET) break;
    s.w[s.n] = w;
    s.a[s.n] = a;
    s.n++;
    const Part next = nearest(&s);
    if (!next.n) return NAN;
    const double nearer = sqrt(next.square);
    if (!(nearer < high)) break; /* What was found before is the better one. */
    keep(&s, &next);
    part = next;
    v = next.v;
    high = nearer;
    if (high < LEAST) return NAN;
  }
  if (!(high - best <= STUCK)) return NAN;
  Vector a = {{0.0, 0.0, 0.0}};
  for (int k = 0; k < part.n; k++) a = plus(a, part.weight[k], s.a[k]);
  const Vector normal = plus((Vector){{0.0, 0.0, 0.0}}, 1.0 / high, part.v);
  const double distance = high - round_a - round_b;
  a = plus(a, round_a, normal);
  const Vector world_a = turned(at_a, 4, 1, a), world_n = turned(at_a, 4, 1, normal);
  for (int r = 0; r < 3; r++) {
    witness[r] = world_a.x[r] + at_a[4 * r + 3];
    witness[3 + r] = witness[r] + distance * world_n.x[r];
    witness[6 + r] = world_n.x[r];
  }
  *low = distance;
  return distance;
}

/* Measures pairs of pieces, and keeps what is known of their distances. */
EXPORT void measure(
    Table *t, const int32_t *pairs, int64_t n, double limit, double *distances, double *witnesses) {
  for (int64_t k = 0; k < n; k++) {
    const int64_t i = pairs[2 * k], j = pairs[2 * k + 1];
    double low = 0.0;
    distances[k] = measured(t, i, j, limit, witnesses + 9 * k, &low);
    if (t->bounds && !isnan(distances[k]))
      t->bounds[t->count * i + j] = low + t->travel[i] + t->travel[j];
  }
}

typedef struct {
  double distance;
  int64_t bodies;
  int32_t i, j, at;
} Found;

#define ORDER(x, y) if ((x) != (y)) return (x) < (y) ? -1 : 1

static int by_bodies(const void *first, const void *second) {
  const Found *a = first, *b = second;
  ORDER(a->bodies, b->bodies);
  ORDER(a->distance, b->distance);
  ORDER(a->i, b->i);
  ORDER(a->j, b->j);
  return 0;
}

static int by_distance(const void *first, const void *second) {
  const Found *a = first, *b = second;
  ORDER(a->distance, b->distance);
  ORDER(a->bodies, b->bodies);
  return 0;
}

/* Writes which pairs are the nearest ones of their bodies and within a radius, nearest first; `order` has
   room for all. Returns how many, -1 if there is no memory. */
EXPORT int64_t rank(
    const Table *t, const int32_t *pairs, int64_t n, const double *distances, double radius, int64_t *order) {
  Found *found = malloc((n + 1) * sizeof(Found));
  if (!found) return -1;
  int64_t count = 0, kept = 0;
  for (int64_t k = 0; k < n; k++)
    if (distances[k] <= radius) {
      const int32_t i = pairs[2 * k], j = pairs[2 * k + 1], a = t->body[i], b = t->body[j];
      const int64_t bodies = a < b ? t->bodies * a + b : t->bodies * b + a;
      found[count++] = (Found){distances[k], bodies, i, j, (int32_t)k};
    }
  qsort(found, count, sizeof(Found), by_bodies);
  for (int64_t k = 0; k < count; k++)
    if (!kept || found[k].bodies != found[kept - 1].bodies) found[kept++] = found[k];
  qsort(found, kept, sizeof(Found), by_distance);
  for (int64_t k = 0; k < kept; k++) order[k] = found[k].at;
  free(found);
  return kept;
}

/* All of it: what may be within `reach`, measured, and ranked. Returns how many pairs that are, of which the
   nearest `kept` come in `order`; that is -1 if some are left to coal, or if there is no room. */
EXPORT int64_t search(
    Table *t, double reach, double radius, int64_t room, int32_t *pairs, double *lows, double *distances,
    double *witnesses, int64_t *order, int64_t *kept) {
  const int64_t found = near(t, reach, pairs, lows, room);
  *kept = -1;
  if (found > room) return found;
  measure(t, pairs, found, radius, distances, witnesses);
  for (int64_t k = 0; k < found; k++)
    if (isnan(distances[k])) return found;
  *kept = rank(t, pairs, found, distances, radius, order);
  return found;
}
"""
