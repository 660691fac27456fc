/* Paths on a manifold: projected in float, shortened, and polished in double. */
#pragma once
#include "rrt_connect.h"

/* Project configurations (count, n) in place; write 1 for those that arrive within limits. */
EXPORTED int kineverse_project(const Checker *c, const Projection *p, float *rows, long long count,
                               unsigned char *arrived) {
  Search s = {.checker = c, .projection = p, .range = 1.0, .resolution = 1.0, .seconds = INFINITY};
  Walk k;
  const int n = (int)c->coordinates;
  if (walk_begin(&k, &s)) {
    walk_end(&k);
    return -1;
  }
  for (long long first = 0; first < count && !is_over(&k.w.watch); first += W) {
    read_lanes(c, &k.w, rows + first * n, count - first);
    const I good = project(c, p, &k.w, k.store, k.o);
    for (int j = 0; j < W && first + j < count; j++) {
      arrived[first + j] = good[j] != 0;
      for (int i = 0; i < n; i++) rows[(first + j) * n + i] = k.w.x[i][j];
    }
  }
  walk_end(&k);
  return 0;
}

static float polyline_length(const float *points, long long count, int n) {
  float sum = 0.0f;
  for (long long k = 1; k < count; k++) sum += distance(points + (k - 1) * n, points + k * n, n);
  return sum;
}

/* Largest number of times that the edges of a relaxed path are halved. */
#define HALVINGS 4
/* Over-relaxation of a sweep, largest number of sweeps, and the gain of one below which it is the last one. */
#define OVER 1.6f
#define SWEEPS 40
#define LEAST_GAIN 0.01f

/* Lanes of w->x that arrive on the manifold and are free. */
static I project_free(Walk *k) {
  const Checker *c = k->s->checker;
  const I good = project(c, k->s->projection, &k->w, k->store, k->o);
  if (!any(good)) return good;
  evaluate(c, &k->w);
  return good & ~collisions(c, &k->w);
}

/* Move every other inner node of a polyline (count, n) from `first` on towards the middle of its neighbours, by a
   factor of the distance, where it stays free and the squares of its edges become smaller. With `careful`, the middles
   of its edges stay free as well. Return by how much the squares of edges became smaller. */
static float relax_nodes(Walk *k, float *path, long long count, long long first, float factor, int careful) {
  const int n = (int)k->s->checker->coordinates;
  V a[MOST_COORDINATES], b[MOST_COORDINATES], q[MOST_COORDINATES], *x = k->w.x;
  float gain = 0.0f;
  for (long long block = first; block < count - 1 && !is_over(&k->w.watch); block += 2 * W) {
    V before = splat(0.0f), after = splat(0.0f);
    for (int i = 0; i < n; i++) {
      for (int j = 0; j < W; j++) {
        const float *row = path + (block + 2 * j < count - 1 ? block + 2 * j : block) * n + i;
        a[i][j] = row[-n], q[i][j] = row[0], b[i][j] = row[n];
      }
      before += (q[i] - a[i]) * (q[i] - a[i]) + (b[i] - q[i]) * (b[i] - q[i]);
      x[i] = q[i] + splat(factor) * (splat(0.5f) * (a[i] + b[i]) - q[i]);
    }
    I good = project_free(k);
    for (int i = 0; i < n; i++) {
      q[i] = x[i];
      after += (q[i] - a[i]) * (q[i] - a[i]) + (b[i] - q[i]) * (b[i] - q[i]);
    }
    good &= after < before;
    for (int side = 0; side < 2 * careful && any(good); side++) {
      for (int i = 0; i < n; i++) x[i] = splat(0.5f) * (q[i] + (side ? b[i] : a[i]));
      good &= project_free(k);
    }
    for (int j = 0; j < W && block + 2 * j < count - 1; j++)
      if (good[j]) {
        gain += before[j] - after[j];
        for (int i = 0; i < n; i++) path[(block + 2 * j) * n + i] = q[i][j];
      }
  }
  return gain;
}

/* Insert a node half way along every edge of a polyline (count, n), which has room for them. Return 1 if all arrive, are
   free, and are near to both neighbours. */
static int insert_middles(Walk *k, float *path, long long count) {
  const int n = (int)k->s->checker->coordinates;
  for (long long e = count - 1; e > 0; e--) memcpy(path + 2 * e * n, path + e * n, n * sizeof(float));
  for (long long block = 1; block < 2 * count - 1; block += 2 * W) {
    for (int j = 0; j < W; j++) {
      const float *row = path + (block + 2 * j < 2 * count - 1 ? block + 2 * j : block) * n;
      for (int i = 0; i < n; i++) k->w.x[i][j] = 0.5f * (row[i - n] + row[i + n]);
    }
    if (is_over(&k->w.watch) || any(~project_free(k))) return 0;
    for (int j = 0; j < W && block + 2 * j < 2 * count - 1; j++) {
      float *row = path + (block + 2 * j) * n;
      for (int i = 0; i < n; i++) row[i] = k->w.x[i][j];
      const float most = 0.75f * distance(row - n, row + n, n) + 1e-4f;
      if (distance(row - n, row, n) > most || distance(row, row + n, n) > most) return 0;
    }
  }
  return 1;
}

/* Write nodes of a path (count, n), its ends and others about evenly spaced, and return their number. */
static long long choose_nodes(const float *path, long long count, int n, long long edges, float *nodes) {
  const float spacing = polyline_length(path, count, n) / edges;
  float along = 0.0f;
  long long found = 0;
  for (long long k = 0; k < count; k++) {
    if (k) along += distance(path + (k - 1) * n, path + k * n, n);
    if (k == count - 1 && found > edges) found = edges;
    if (k == count - 1 || along >= found * spacing) memcpy(nodes + found++ * n, path + k * n, n * sizeof(float));
  }
  return found;
}

/* Shorten a path like a band: few nodes of it are relaxed, by sweeps over odd and even ones, and then the edges are
   halved some times. Write the nodes and return their number, or 0 if the way between them is not free. */
static long long relax(Walk *k, const float *path, long long count, int halvings, int careful, float *nodes) {
  const Checker *c = k->s->checker;
  const int n = (int)c->coordinates;
  const float samples = fmaxf((float)(k->s->range * k->s->resolution), 1.0f);
  const long long edges = (long long)ceilf(samples / (1 << halvings));
  long long found = choose_nodes(path, count, n, edges, nodes);
  float squares = 0.0f, gain = INFINITY;
  for (long long e = 1; e < found; e++) {
    const float d = distance(nodes + (e - 1) * n, nodes + e * n, n);
    squares += d * d;
  }
  for (int sweep = 0; sweep < SWEEPS && gain > LEAST_GAIN * squares; sweep++) {
    gain = relax_nodes(k, nodes, found, 1, OVER, careful) + relax_nodes(k, nodes, found, 2, OVER, careful);
    squares -= gain;
  }
  for (int first = 1; first <= 2; first++) relax_nodes(k, nodes, found, first, 1.0f, careful);
  for (; halvings; halvings--) {
    if (!insert_middles(k, nodes, found)) return 0;
    found = 2 * found - 1;
  }
  for (long long e = 1; e < found; e++)
    if (!conditions_hold(c, &k->w, nodes + (e - 1) * n, nodes + e * n)) return 0;
  return found;
}

/* Shorten a path (count, n) on a manifold in place, which has room for more points, and return their number. Few nodes
   are fast to relax; where something lies between them, more are tried. */
EXPORTED long long kineverse_relax(Search *s, float *path, long long count, long long room) {
  const int n = (int)s->checker->coordinates;
  Walk k;
  s->range = polyline_length(path, count, n);
  int most = HALVINGS;
  while (most && (1 << most) > s->range * s->resolution) most--;
  long long found = 0;
  if (!walk_begin(&k, s))
    for (int halvings = most, careful = 0; halvings >= 0 && !found && !look_at_clock(&k.w.watch); careful = 1) {
      found = relax(&k, path, count, halvings, careful, k.points);
      halvings -= careful;
    }
  if (found && found <= room) {
    memcpy(path, k.points, found * n * sizeof(float));
    count = found;
  }
  walk_end(&k);
  return count;
}

/* Vectors of D doubles, as the step in double has them. */
enum { D = REGISTER / 8 };
typedef double Doubles __attribute__((vector_size(REGISTER)));
typedef long long Mask __attribute__((vector_size(REGISTER)));

INLINE Doubles choose(Mask mask, Doubles a, Doubles b) { return (Doubles)((mask & (Mask)a) | (~mask & (Mask)b)); }

/* Work space of steps in double. */
typedef struct {
  const Checker *c;
  const Projection *p;
  Doubles *x, *o, *store;
  void *memory;
  Watch watch;
} Polish;

static int polish_begin(Polish *w, const Checker *c, const Projection *p) {
  const size_t n = c->coordinates;
  w->c = c, w->p = p;
  watch_begin(&w->watch, INFINITY);
  w->memory = malloc((3 * n + 2 + p->exact_stored) * REGISTER + 64);
  if (!w->memory) return 1;
  w->x = (Doubles *)(((size_t)w->memory + 63) & ~(size_t)63);
  w->o = w->x + 2 * n;
  w->store = w->o + n + 1;
  return 0;
}

/* Bring up to D configurations onto the manifold, within limits, by at most some steps; write their residuals. */
static void polish_block(Polish *w, double *rows, long long count, long long steps, double *residuals) {
  const int n = (int)w->c->coordinates, lanes = count < D ? (int)count : D;
  const float *lower = w->c->lower, *upper = w->c->upper;
  const Doubles zero = {0.0};
  Doubles *x = w->x, *factor = x + n, *o = w->o;
  for (int i = 0; i < n; i++) {
    factor[i] = zero + (lower[i] < upper[i] ? 1.0 : 0.0);
    for (int j = 0; j < D; j++) x[i][j] = rows[(j < lanes ? j : lanes - 1) * n + i];
  }
  for (long long k = 0;; k++) {
    w->p->exact(x, w->p->exact_kept, w->store, o);
    const Mask done = o[n] <= zero + w->p->exact_tolerance;
    int left = 0;
    for (int j = 0; j < D; j++) left |= !done[j];
    if (k == steps || !left) break;
    for (int i = 0; i < n; i++) {
      const Doubles low = zero + lower[i], high = zero + upper[i], to = x[i] + choose(done, zero, o[i]);
      x[i] = choose(to < low, low, choose(to > high, high, to));
      factor[i] = choose(x[i] == to, factor[i], zero);
    }
  }
  for (int j = 0; j < lanes; j++) {
    residuals[j] = o[n][j];
    for (int i = 0; i < n; i++) rows[j * n + i] = x[i][j];
  }
}

/* Bring configurations (count, n) in place onto the manifold, within limits, by at most some steps; write the residuals
   that are left. */
EXPORTED int kineverse_polish(const Checker *c, const Projection *p, double *rows, long long count, long long steps,
                              double *residuals) {
  Polish w;
  if (polish_begin(&w, c, p)) return -1;
  for (long long k = 0; k < count && !is_over(&w.watch); k += D)
    polish_block(&w, rows + k * c->coordinates, count - k, steps, residuals + k);
  free(w.memory);
  return 0;
}

/* Largest number of parts of an edge, for which its residual half way is made this much larger. */
#define MOST_PARTS 64
#define RESERVE 1.1

/* Insert configurations into a polyline (count, n), which has room for more, where the residual half way along an edge
   is larger than `deviation`: so many that a parabola through the middle on the manifold keeps to it. Return the new
   number, or -1 without room or memory. */
static long long subdivide(Polish *w, double *points, long long count, long long room, double deviation) {
  const int n = (int)w->c->coordinates;
  const size_t edges = (size_t)count - 1;
  double *step = malloc(edges * (n * sizeof(double) + sizeof(int)) + 1);
  if (!step) return -1;
  int *parts = (int *)(step + edges * n);
  long long total = 1;
  const Doubles zero = {0.0};
  Doubles *x = w->x, *o = w->o;
  for (int i = 0; i < n; i++) x[n + i] = zero + (w->c->lower[i] < w->c->upper[i] ? 1.0 : 0.0);
  for (long long first = 0; first + 1 < count; first += D) {
    for (int j = 0; j < D; j++) {
      const double *a = points + (first + j + 2 < count ? first + j : count - 2) * n;
      for (int i = 0; i < n; i++) x[i][j] = 0.5 * (a[i] + a[n + i]);
    }
    w->p->exact(x, w->p->exact_kept, w->store, o);
    for (long long k = first; k < first + D && k + 1 < count; k++) {
      const double residual = o[n][k - first];
      const double wanted = residual > deviation ? ceil(sqrt(RESERVE * residual / deviation)) : 1.0;
      parts[k] = wanted < MOST_PARTS ? (int)wanted : MOST_PARTS;
      for (int i = 0; i < n; i++) step[k * n + i] = o[i][k - first];
      total += parts[k];
    }
  }
  if (total <= room) memmove(points + (total - 1) * n, points + (count - 1) * n, n * sizeof(double));
  for (long long k = count - 2, at = total - 1; k >= 0 && total <= room; k--) {
    const double *a = points + k * n, *b = points + at * n;
    for (int e = parts[k] - 1; e > 0; e--) {
      const double t = (double)e / parts[k];
      double *q = points + (at - parts[k] + e) * n;
      for (int i = 0; i < n; i++) {
        const double to = a[i] + t * (b[i] - a[i]) + 4.0 * t * (1.0 - t) * step[k * n + i];
        q[i] = to < w->c->lower[i] ? w->c->lower[i] : to > w->c->upper[i] ? w->c->upper[i] : to;
      }
    }
    at -= parts[k];
    memmove(points + at * n, points + k * n, n * sizeof(double));
  }
  free(step);
  return total <= room ? total : -1;
}

/* Bring a polyline (count, n) in place onto the manifold, so dense that the residual half way between two points is at
   most `deviation`. Return the new number of points, at most `room`, or -1 if one of them does not arrive within some
   steps, or there is no room. */
EXPORTED long long kineverse_refine(const Checker *c, const Projection *p, double *points, long long count,
                                    long long room, long long steps, double deviation) {
  const int n = (int)c->coordinates;
  Polish w;
  if (polish_begin(&w, c, p)) return -1;
  for (long long before = 0; count > before;) {
    before = count;
    for (long long k = 0; k < count && before > 0; k += D) {
      double residuals[D];
      if (is_over(&w.watch)) {
        before = -1;
        break;
      }
      polish_block(&w, points + k * n, count - k, steps, residuals);
      for (int j = 0; j < D && k + j < count; j++)
        if (!(residuals[j] <= p->exact_tolerance)) before = -1;
    }
    count = before < 0 || count < 2 ? before : subdivide(&w, points, count, room, deviation);
  }
  free(w.memory);
  return count;
}
