/* Paths on a manifold: projected in float, shortened, and polished in double. */

/* Project configurations (count, n) in place; write 1 for those that arrive within limits. */
EXPORTED int kineverse_project(const Checker *c, const Projection *p, float *rows, long long count,
                             unsigned char *arrived) {
  Search s = {.checker = c, .projection = p, .range = 1.0, .resolution = 1.0};
  Walk k;
  const int n = (int)c->coordinates;
  if (walk_begin(&k, &s)) {
    walk_end(&k);
    return -1;
  }
  for (long long first = 0; first < count; first += W) {
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

/* Return 1 if no configuration of a polyline (count, n) collides, the first one excepted, and if conditions hold
   between them. Every block sees the whole polyline. */
static int points_are_free(const Checker *c, Work *w, const float *points, long long count) {
  const int n = (int)c->coordinates;
  const long long blocks = (count - 2 + W) / W;
  for (long long k = 0; k < blocks; k++) {
    for (int j = 0; j < W; j++) {
      const long long at = 1 + k + j * blocks;
      const float *row = points + (at < count ? at : count - 1) * n;
      for (int i = 0; i < n; i++) w->x[i][j] = row[i];
    }
    evaluate(c, w);
    if (collides(c, w)) return 0;
  }
  for (long long k = 1; k < count; k++)
    if (!conditions_hold(c, w, points + (k - 1) * n, points + k * n)) return 0;
  return 1;
}

/* Project the straight way from a to b, at most as long as k->s->range: write a and the points after it, and return
   their number; 0 if a point does not arrive, or is far from the one before. */
static long long project_way(Walk *k, const float *a, const float *b, float *points) {
  const Checker *c = k->s->checker;
  const int n = (int)c->coordinates;
  const float length = distance(a, b, n);
  const int blocks = (int)ceilf(fmaxf(length * (float)k->s->resolution, 1.0f) / W);
  const float step = 1.0f / (blocks * W), gap = 2.5f * length * step + 1e-4f;
  memcpy(points, a, n * sizeof(float));
  for (int e = 0; e < blocks; e++) {
    interpolate(c, &k->w, a, b, (ramp() + splat(e * W + 1.0f)) * splat(step));
    const I good = project(c, k->s->projection, &k->w, k->store, k->o);
    if (any(~good)) return 0;
    for (int j = 0; j < W; j++) {
      float *row = points + (1 + e * W + j) * n;
      for (int i = 0; i < n; i++) row[i] = k->w.x[i][j];
      if (!(distance(row - n, row, n) <= gap)) return 0;
    }
  }
  return distance(points + blocks * W * n, b, n) < 1e-3f ? 1 + blocks * W : 0;
}

/* A way that is shorter than this fraction of another one is worth it. */
#define SHORTER 0.98f
/* Number of tries in a row that may bring nothing. */
#define PATIENCE 12

/* Shorten a polyline (count, n) on a manifold in place, in which there is room for more points: points of it are joined
   by projections of the straight way between them, until `rounds` tries are over or the time is up. Return the new
   number of points. */
EXPORTED long long kineverse_shorten_on_manifold(Search *s, float *path, long long count, long long room,
                                               long long rounds) {
  const Checker *c = s->checker;
  const int n = (int)c->coordinates;
  const double begin = now();
  Random random = (Random)s->seed * 0x2545f4914f6cdd1dULL + 0x9e3779b97f4a7c15ULL;
  Walk k;
  s->range = polyline_length(path, count, n);
  if (walk_begin(&k, s)) {
    walk_end(&k);
    return count;
  }
  int failures = 0;
  for (long long round = 0; round < rounds && count >= 4 && failures <= PATIENCE; round++) {
    if (now() - begin > s->seconds) break;
    /* The whole way first: a path that a straight way replaces needs no other tries. */
    long long i = 0, j = count - 1;
    if (round) {
      i = (long long)(random_unit(&random) * count), j = (long long)(random_unit(&random) * count);
      if (i > j) {
        const long long swap = i;
        i = j, j = swap;
      }
    }
    if (j < i + 3) continue;
    const float length = polyline_length(path + i * n, j - i + 1, n);
    if (distance(path + i * n, path + j * n, n) > SHORTER * length) continue;
    failures++;
    const long long found = project_way(&k, path + i * n, path + j * n, k.points);
    if (!found || count - (j - i + 1) + found > room || polyline_length(k.points, found, n) > SHORTER * length ||
        !points_are_free(c, &k.w, k.points, found))
      continue;
    memmove(path + (i + found) * n, path + (j + 1) * n, (count - j - 1) * n * sizeof(float));
    memcpy(path + i * n, k.points, found * n * sizeof(float));
    count += found - (j - i + 1);
    failures = 0;
  }
  walk_end(&k);
  s->elapsed = now() - begin;
  return count;
}

/* Vectors of D doubles, as the step in double has them. */
enum { D = REGISTER / 8 };
typedef double Doubles __attribute__((vector_size(REGISTER)));

typedef struct {
  const Checker *c;
  const Projection *p;
  Doubles *x, *o, *store;
  void *memory;
} Polish;

static int polish_begin(Polish *w, const Checker *c, const Projection *p) {
  const size_t n = c->coordinates;
  w->c = c, w->p = p;
  w->memory = malloc((3 * n + 2 + p->exact_stored) * sizeof(Doubles) + 64);
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
  Doubles *x = w->x, *factor = x + n, *o = w->o;
  for (int i = 0; i < n; i++)
    for (int j = 0; j < D; j++) {
      x[i][j] = rows[(j < lanes ? j : lanes - 1) * n + i];
      factor[i][j] = lower[i] < upper[i];
    }
  for (long long k = 0;; k++) {
    w->p->exact(x, w->p->exact_kept, w->store, o);
    int left = 0;
    for (int j = 0; j < lanes; j++) left += !(o[n][j] <= w->p->exact_tolerance);
    if (k == steps || !left) break;
    for (int i = 0; i < n; i++)
      for (int j = 0; j < D; j++) {
        const double to = x[i][j] + (o[n][j] > w->p->exact_tolerance ? o[i][j] : 0.0);
        const double in = to < lower[i] ? lower[i] : to > upper[i] ? upper[i] : to;
        if (in != to) factor[i][j] = 0.0;
        x[i][j] = in;
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
  for (long long k = 0; k < count; k += D)
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
  for (long long first = 0; first + 1 < count; first += D) {
    for (int j = 0; j < D; j++) {
      const double *a = points + (first + j + 2 < count ? first + j : count - 2) * n;
      for (int i = 0; i < n; i++) {
        w->x[i][j] = 0.5 * (a[i] + a[n + i]);
        w->x[n + i][j] = w->c->lower[i] < w->c->upper[i];
      }
    }
    w->p->exact(w->x, w->p->exact_kept, w->store, w->o);
    for (long long k = first; k < first + D && k + 1 < count; k++) {
      const double residual = w->o[n][k - first];
      const double wanted = residual > deviation ? ceil(sqrt(RESERVE * residual / deviation)) : 1.0;
      parts[k] = wanted < MOST_PARTS ? (int)wanted : MOST_PARTS;
      for (int i = 0; i < n; i++) step[k * n + i] = w->o[i][k - first];
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
      polish_block(&w, points + k * n, count - k, steps, residuals);
      for (int j = 0; j < D && k + j < count; j++)
        if (!(residuals[j] <= p->exact_tolerance)) before = -1;
    }
    count = before < 0 || count < 2 ? before : subdivide(&w, points, count, room, deviation);
  }
  free(w.memory);
  return count;
}
