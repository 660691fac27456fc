/* Edges between configurations: sampled, certified between the samples, or projected onto a manifold. */
#pragma once
#include "collision.h"

INLINE V ramp(void) {
  V r;
  for (int i = 0; i < W; i++) r[i] = (float)i;
  return r;
}

static float distance(const float *a, const float *b, int n) {
  float sum = 0.0f;
  for (int i = 0; i < n; i++) sum += (b[i] - a[i]) * (b[i] - a[i]);
  return sqrtf(sum);
}

/* The number of intervals of the way from a to b, of which each is short and turns no body by more than 1 rad. */
static float intervals(const Checker *c, const float *a, const float *b, float resolution) {
  float turn = 0.0f;
  for (int i = 0; i < c->coordinates; i++) turn += c->turns[i] * fabsf(b[i] - a[i]);
  return fmaxf(distance(a, b, (int)c->coordinates) * resolution, turn);
}

INLINE void evaluate(const Checker *c, Work *w) { c->compute(w->x, c->kept, w->store, w->o); }

/* The block at the fractions t of the way from a to b. */
INLINE void interpolate(const Checker *c, Work *w, const float *a, const float *b, V t) {
  for (int i = 0; i < c->coordinates; i++) w->x[i] = fused(t, splat(b[i] - a[i]), splat(a[i]));
}

/* Return 1 if all conditions hold on the way from a to b. Those that switch, such as locks, forbid thin ranges of their
   coordinates, so that these are sampled more often than collisions are. */
static int conditions_hold(const Checker *c, Work *w, const float *a, const float *b) {
  double samples = 0.0;
  for (int i = 0; i < c->coordinates; i++) samples += (double)c->fineness[i] * fabsf(b[i] - a[i]);
  const long long blocks = (long long)ceil(samples / W);
  const double step = 1.0 / fmax(samples, 1.0);
  for (long long k = 0; k < blocks; k++) {
    if (is_over(&w->watch)) return 0;
    /* The first sample of a block is computed in double: a fraction of a long way has not enough digits. */
    const double first = (k * W + 1) * step;
    const V lanes = smaller(ramp(), splat((float)fmax(samples - (k * W + 1), 0.0)));
    for (int i = 0; i < c->coordinates; i++) {
      const double way = (double)b[i] - a[i];
      w->x[i] = fused(lanes, splat((float)(step * way)), splat((float)(a[i] + first * way)));
    }
    evaluate(c, w);
    const V *conditions = w->o + 12 * c->poses;
    for (int i = 0; i < c->conditions; i++)
      if (any(~(conditions[i] <= splat(0.0f)))) return 0;
  }
  return 1;
}

/* Return 1 if no sample on the way from a, exclusive, to b, inclusive, collides. Every block sees the whole edge. */
static int edge_is_free(const Checker *c, Work *w, const float *a, const float *b, float resolution) {
  if (!conditions_hold(c, w, a, b)) return 0;
  const long long blocks = (long long)ceilf(fmaxf(distance(a, b, c->coordinates) * resolution, 1.0f) / W);
  const float step = 1.0f / (blocks * W);
  for (long long k = 0; k < blocks; k++) {
    if (is_over(&w->watch)) return 0;
    interpolate(c, w, a, b, (ramp() * splat((float)blocks) + splat((float)(blocks - k))) * splat(step));
    evaluate(c, w);
    if (collides(c, w)) return 0;
  }
  return 1;
}

/* Largest number of intervals of an edge that are looked at on one level. */
#define MOST_INTERVALS 4096

/* Write for every link the largest way of a point between the present block and another one at x + half, and return
   the largest of all. The ways of the corners of a box around the centres bound those of all centres, since
   displacements are affine. */
static float inflate(const Checker *c, Work *w, const V *before) {
  float largest = 0.0f;
  for (int k = 0; k < c->links; k++) {
    const Link *l = c->link + k;
    const V *S = before + 12 * l->pose, *T = w->o + 12 * l->pose;
    V way = splat(0.0f);
    for (int corner = 0; corner < 8; corner++) {
      float p[3];
      for (int i = 0; i < 3; i++) p[i] = corner >> i & 1 ? l->high[i] : l->low[i];
      V q[3], r[3];
      transform_point(S, p, q);
      transform_point(T, p, r);
      const V x = r[0] - q[0], y = r[1] - q[1], z = r[2] - q[2];
      way = larger(way, fused(x, x, fused(y, y, z * z)));
    }
    w->inflation[k] = 1.05f * sqrtf(largest_lane(way)) + 1e-6f;
    largest = fmaxf(largest, w->inflation[k]);
  }
  return largest;
}

/* As `edge_is_certain`, for a way that is cut into so few intervals at first that they are looked at together. */
static int part_is_certain(const Checker *c, Work *w, const float *a, const float *b, int count, float least,
                           float *where) {
  float middle[MOST_INTERVALS];
  float width = 1.0f / count;
  for (int k = 0; k < count; k++) middle[k] = (k + 0.5f) * width;
  while (count) {
    int hits = 0;
    float grown = 0.0f;
    for (int first = 0; first < count; first += W) {
      if (is_over(&w->watch)) {
        memset(w->inflation, 0, c->links * sizeof(float));
        return 0;
      }
      V t;
      for (int j = 0; j < W; j++) t[j] = middle[first + j < count ? first + j : count - 1];
      interpolate(c, w, a, b, t + splat(0.5f * width));
      evaluate(c, w);
      memcpy(w->before, w->o, 12 * c->poses * sizeof(V));
      interpolate(c, w, a, b, t);
      evaluate(c, w);
      grown = fmaxf(grown, inflate(c, w, w->before));
      unsigned bits = lane_bits(collisions(c, w));
      for (; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        /* Intervals before this one have been read. */
        if (first + lane < count) middle[hits++] = t[lane];
      }
    }
    memset(w->inflation, 0, c->links * sizeof(float));
    if (!hits) return 1;
    *where = middle[0];
    if (grown <= least || hits > MOST_INTERVALS / 4 || width < 1e-6f) return 0;
    width *= 0.25f;
    for (int k = hits - 1; k >= 0; k--)
      for (int j = 3; j >= 0; j--) middle[4 * k + j] = middle[k] + (j - 1.5f) * width;
    count = 4 * hits;
  }
  return 1;
}

/* Return 1 if nothing collides on the way from a to b, not only at samples. The way is cut into intervals. In each,
   no point of a link is further from where it is in the middle than half of the way that it goes, up to second order,
   for which 5 % are added: spheres that are larger by that cover the interval. Where larger spheres collide, the
   interval is cut into four, until spheres grow by less than `least`. On failure the fraction is written. */
static int edge_is_certain(const Checker *c, Work *w, const float *a, const float *b, float resolution, float least,
                           float *where) {
  *where = 0.0f;
  if (!conditions_hold(c, w, a, b)) return 0;
  const long long wanted = (long long)ceilf(fmaxf(intervals(c, a, b, resolution), 1.0f));
  const long long parts = (wanted + MOST_INTERVALS / 4 - 1) / (MOST_INTERVALS / 4);
  const int count = (int)((wanted + parts * W - 1) / (parts * W) * W);
  float from[MOST_COORDINATES], to[MOST_COORDINATES];
  for (long long k = 0; k < parts; k++) {
    const double begin = (double)k / parts, end = (double)(k + 1) / parts;
    for (int i = 0; i < c->coordinates; i++) {
      from[i] = k ? to[i] : a[i];
      to[i] = k + 1 < parts ? (float)(a[i] + end * ((double)b[i] - a[i])) : b[i];
    }
    if (!part_is_certain(c, w, from, to, count, least, where)) {
      *where = (float)(begin + *where / parts);
      return 0;
    }
  }
  return 1;
}

/* Newton's step onto a manifold, in float and in double: inputs are the coordinates and a factor of each, 0 where it may
   not move; outputs are the changes of the coordinates, then the largest residual. */
typedef struct {
  Compute *step;
  const V *kept;
  long long stored;
  double tolerance;
  long long steps;
  void (*exact)(const void *x, const void *kept, void *store, void *o);
  const void *exact_kept;
  long long exact_stored;
  double exact_tolerance;
} Projection;

/* Residual below which a coordinate that meets its limit stays there. */
#define CLOSE 0.05f

/* Project all lanes of w->x; return the lanes that arrive within limits. `o` and `store` are work space. */
static I project(const Checker *c, const Projection *p, Work *w, V *store, V *o) {
  const int n = (int)c->coordinates;
  V *x = w->x, *factor = w->x + n;
  for (int i = 0; i < n; i++) factor[i] = splat(c->lower[i] < c->upper[i] ? 1.0f : 0.0f);
  for (int k = 0;; k++) {
    p->step(x, p->kept, store, o);
    const I done = o[n] <= splat((float)p->tolerance);
    if (k == p->steps || !any(~done)) {
      I good = done;
      for (int i = 0; i < n; i++) good &= (x[i] >= splat(c->lower[i])) & (x[i] <= splat(c->upper[i]));
      return good;
    }
    const I close = o[n] <= splat(CLOSE);
    for (int i = 0; i < n; i++) {
      const V lower = splat(c->lower[i]), upper = splat(c->upper[i]);
      const V to = x[i] + select_(done, splat(0.0f), o[i]);
      /* Steps that end at a limit again and again converge slowly. */
      factor[i] = select_(close & ((to < lower) | (to > upper)), splat(0.0f), factor[i]);
      x[i] = smaller(larger(to, lower), upper);
    }
  }
}

/* Go from a towards b on the manifold as far as possible; write the points reached, (count, n), and return their
   number. `full` is set if nothing stops the way. A way that was gone before, to `known`, is not checked again. */
static int edge_on_manifold(const Checker *c, const Projection *p, Work *w, V *store, V *o, const float *a,
                            const float *b, float resolution, float *points, int *full, const float *known) {
  const int n = (int)c->coordinates;
  const float length = distance(a, b, n);
  const int blocks = (int)ceilf(fmaxf(length * resolution, 1.0f) / W);
  const float step = 1.0f / (blocks * W), gap = 2.5f * length * step + 1e-4f;
  const float *last = a;
  int count = 0;
  *full = 0;
  for (int k = 0; k < blocks; k++) {
    if (is_over(&w->watch)) return count;
    interpolate(c, w, a, b, (ramp() + splat(k * W + 1.0f)) * splat(step));
    I good = project(c, p, w, store, o);
    V gaps = splat(0.0f);
    for (int i = 0; i < n; i++) {
      V before;
      before[0] = last[i];
      for (int j = 1; j < W; j++) before[j] = w->x[i][j - 1];
      gaps = fused(w->x[i] - before, w->x[i] - before, gaps);
    }
    good &= gaps <= splat(gap * gap);
    if (!good[0]) return count;
    if (!known) {
      evaluate(c, w);
      good &= ~collisions(c, w);
    }
    const int before = count;
    int reached = 0;
    for (; reached < W && good[reached]; reached++, count++)
      for (int i = 0; i < n; i++) points[count * n + i] = w->x[i][reached];
    for (int j = before; j < count; j++) {
      if (known ? distance(last, known, n) < 1e-6f : !conditions_hold(c, w, last, points + j * n)) return j;
      last = points + j * n;
    }
    if (reached < W) return count;
  }
  *full = 1;
  return count;
}

/* Read rows (count, n) into lanes; lanes behind the last row repeat it. */
static void read_lanes(const Checker *c, Work *w, const float *rows, long long count) {
  const int n = (int)c->coordinates;
  for (int j = 0; j < W; j++) {
    const float *row = rows + (j < count ? j : count - 1) * n;
    for (int i = 0; i < n; i++) w->x[i][j] = row[i];
  }
}

/* Write 1 for every configuration (count, n) that is within limits, holds all conditions and does not collide. */
EXPORTED int kineverse_valid(const Checker *c, const float *rows, long long count, unsigned char *valid) {
  Work w;
  if (work_begin(&w, c, INFINITY)) return -1;
  for (long long first = 0; first < count && !is_over(&w.watch); first += W) {
    read_lanes(c, &w, rows + first * c->coordinates, count - first);
    I good = splat(0.0f) <= splat(0.0f);
    for (int i = 0; i < c->coordinates; i++)
      good &= (w.x[i] >= splat(c->lower[i])) & (w.x[i] <= splat(c->upper[i]));
    evaluate(c, &w);
    good &= ~collisions(c, &w);
    for (int j = 0; j < W && first + j < count; j++) valid[first + j] = good[j] != 0;
  }
  work_end(&w);
  return 0;
}

/* Write 1 for every edge that is free: sampled if `least` is 0, else certain between the samples too. */
EXPORTED int kineverse_edges(const Checker *c, const float *from, const float *to, long long count, double resolution,
                             double least, unsigned char *valid) {
  Work w;
  if (work_begin(&w, c, INFINITY)) return -1;
  for (long long k = 0; k < count && !is_over(&w.watch); k++) {
    const float *a = from + k * c->coordinates, *b = to + k * c->coordinates;
    float where;
    valid[k] = (unsigned char)(least > 0 ? edge_is_certain(c, &w, a, b, resolution, least, &where)
                                         : edge_is_free(c, &w, a, b, resolution));
  }
  work_end(&w);
  return 0;
}

/* Mark those of up to W edges, which are no longer than the distance of two samples, that are certainly free: the
   middles of all of them are one block. */
static void certify_short_edges(const Checker *c, Work *w, const float *points, long long count, unsigned char *free_) {
  const int n = (int)c->coordinates;
  for (int half = 1; half >= 0; half--) {
    for (int j = 0; j < W; j++) {
      const float *a = points + (j < count ? j : count - 1) * n, *b = a + n;
      for (int i = 0; i < n; i++) w->x[i][j] = 0.5f * (a[i] + b[i]) + 0.5f * half * (b[i] - a[i]);
    }
    evaluate(c, w);
    if (half) memcpy(w->before, w->o, 12 * c->poses * sizeof(V));
  }
  inflate(c, w, w->before);
  const unsigned hits = lane_bits(collisions(c, w));
  memset(w->inflation, 0, c->links * sizeof(float));
  for (int j = 0; j < count; j++) free_[j] = !(hits >> j & 1) && conditions_hold(c, w, points + j * n, points + (j + 1) * n);
}

/* Find the first collision on a polyline (count, n): return the number of its edge and write the fraction of the
   way along it, or return -1; -2 without memory, and -3 if the time is up. */
EXPORTED long long kineverse_certify(const Checker *c, const float *points, long long count, double resolution,
                                     double least, double seconds, double *where) {
  Work w;
  if (work_begin(&w, c, seconds)) return -2;
  const int n = (int)c->coordinates;
  long long found = -1;
  float fraction = 0.0f;
  for (long long k = 0; k + 1 < count && found < 0 && !is_over(&w.watch);) {
    unsigned char certain[W] = {0};
    int edges = 0;
    while (edges < W && k + edges + 1 < count &&
           intervals(c, points + (k + edges) * n, points + (k + edges + 1) * n, (float)resolution) <= 1.0f)
      edges++;
    if (edges > 1)
      certify_short_edges(c, &w, points + k * n, edges, certain);
    else
      edges = 1;
    for (int j = 0; j < edges && found < 0; j++) {
      const float *a = points + (k + j) * n;
      if (!certain[j] && !edge_is_certain(c, &w, a, a + n, resolution, least, &fraction)) found = k + j;
    }
    k += edges;
  }
  *where = fraction;
  work_end(&w);
  return w.watch.over ? -3 : found;
}

/* Write the poses of one configuration (12 each) and the conditions; for messages and tests. */
EXPORTED int kineverse_poses(const Checker *c, const float *row, float *outputs) {
  Work w;
  if (work_begin(&w, c, INFINITY)) return -1;
  read_lanes(c, &w, row, 1);
  evaluate(c, &w);
  for (int k = 0; k < 12 * c->poses + c->conditions; k++) outputs[k] = w.o[k][0];
  work_end(&w);
  return 0;
}
