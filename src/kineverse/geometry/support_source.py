"""C text: how far the cores of convex solids reach in a direction, after the table of :mod:`.sweep_source`.

A *core* is a hull plus a box plus an ellipsoid, all within a radius: a capsule is a line within one, a
cylinder a line plus a disc. A cone is the hull of a disc and its tip. What is asked of two is how far
{b - a}, all differences of their points, reaches.
"""

SUPPORT = r"""
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

/* Two pieces: seen from a, b is turned and shifted. */
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

/* The point of {b - a} that is furthest against a direction, and the point a that it comes from. */
static inline Vector against(const Pair *p, Vector way, Vector *a) {
  const Vector back = {{-way.x[0], -way.x[1], -way.x[2]}};
  *a = furthest(p->t, p->i, way);
  const Vector own = furthest(p->t, p->j, turned(p->relative, 1, 3, back));
  return plus(plus(p->shift, 1.0, turned(p->relative, 3, 1, own)), -1.0, *a);
}
"""
