/* RRT-Connect (Kuffner and LaValle 2000), in the whole space or on a manifold, and shortcuts.

   Both trees grow step by step until something is in the way. Samples lie in a box around the tree that grows: others
   would mostly pull nodes at its rim against the same obstacles, as those that dynamic domains reject (Yershova et al.
   2005). The box grows with the tree. */
#pragma once
#include "edges.h"

/* splitmix64 */
typedef unsigned long long Random;
INLINE Random random_bits(Random *state) {
  Random z = (*state += 0x9e3779b97f4a7c15ULL);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
  return z ^ (z >> 31);
}
INLINE float random_unit(Random *state) { return (random_bits(state) >> 40) * 0x1p-24f; }

/* A tree of configurations, W of them in a chunk of columns. */
typedef struct {
  float *columns;
  float *aims; /* on a manifold, where the edge to each node was aimed at, (room, n) */
  int *parent;
  float low[MOST_COORDINATES], high[MOST_COORDINATES]; /* of all configurations */
  long long count, room;
} Tree;

static int tree_grow(Tree *t, int n) {
  const long long room = t->room ? 2 * t->room : 1024;
  float *columns = aligned_alloc(64, room * n * sizeof(float));
  float *aims = realloc(t->aims, room * n * sizeof(float));
  if (aims) t->aims = aims;
  int *parent = realloc(t->parent, room * sizeof(int));
  if (parent) t->parent = parent;
  if (!columns || !aims || !parent) {
    free(columns);
    return 1;
  }
  if (t->count) memcpy(columns, t->columns, t->room * n * sizeof(float));
  free(t->columns);
  t->columns = columns;
  t->room = room;
  return 0;
}

static int tree_add(Tree *t, int n, const float *q, const float *aim, int parent) {
  if (t->count == t->room && tree_grow(t, n)) return -1;
  const long long k = t->count++;
  for (int i = 0; i < n; i++) {
    t->columns[(k / W * n + i) * W + k % W] = q[i];
    t->low[i] = k ? fminf(t->low[i], q[i]) : q[i];
    t->high[i] = k ? fmaxf(t->high[i], q[i]) : q[i];
  }
  memcpy(t->aims + k * n, aim, n * sizeof(float));
  t->parent[k] = parent;
  return (int)k;
}

static void tree_read(const Tree *t, int n, long long k, float *q) {
  for (int i = 0; i < n; i++) q[i] = t->columns[(k / W * n + i) * W + k % W];
}

static void tree_free(Tree *t) {
  free(t->columns);
  free(t->aims);
  free(t->parent);
}

static int nearest(const Tree *t, int n, const float *q, float *away) {
  const long long chunks = (t->count + W - 1) / W;
  V best = splat(INFINITY);
  I place = (I)splat(0.0f);
  for (long long c = 0; c < chunks; c++) {
    const V *column = (const V *)(t->columns + c * n * W);
    V d = column[0] - splat(q[0]), sum = d * d;
    for (int i = 1; i < n; i++) {
      d = column[i] - splat(q[i]);
      sum = fused(d, d, sum);
    }
    if ((c + 1) * W > t->count)
      for (int j = (int)(t->count - c * W); j < W; j++) sum[j] = INFINITY;
    const I closer = sum < best;
    best = select_(closer, sum, best);
    place = (closer & splat_bits((int)c)) | (~closer & place);
  }
  int found = 0;
  float least = INFINITY;
  for (int j = 0; j < W; j++) {
    const int k = (int)place[j] * W + j;
    if (best[j] < least || (best[j] == least && k < found)) least = best[j], found = k;
  }
  *away = sqrtf(least);
  return found;
}

/* What a search is about, and what it has done. Times in seconds. */
typedef struct {
  const Checker *checker;
  const Projection *projection; /* null: the whole space */
  double range, resolution, seconds;
  long long nodes, most_edges, seed;
  /* results */
  long long iterations, edges, count_start, count_goal, status;
  double elapsed, gap;
} Search;

enum { FOUND, TIME_IS_UP, TOO_MANY_NODES, NO_MEMORY, TOO_LONG };

typedef struct {
  Search *s;
  Work w;
  V *store, *o;
  float *points; /* of one edge on the manifold */
  int room;
  void *memory;
} Walk;

static int walk_begin(Walk *k, Search *s) {
  memset(k, 0, sizeof *k);
  k->s = s;
  const int n = (int)s->checker->coordinates;
  if (work_begin(&k->w, s->checker, s->seconds)) return 1;
  if (s->projection) {
    const size_t vectors = s->projection->stored + n + 4;
    k->room = (int)ceil(s->range * s->resolution) + 4 * W + 2;
    k->memory = malloc(vectors * sizeof(V) + 64 + (size_t)k->room * n * sizeof(float));
    if (!k->memory) return 1;
    k->o = (V *)(((size_t)k->memory + 63) & ~(size_t)63);
    k->store = k->o + n + 2;
    k->points = (float *)(k->store + s->projection->stored + 1);
  }
  return 0;
}

static void walk_end(Walk *k) {
  work_end(&k->w);
  free(k->memory);
}

/* Go from a to b, at most `range` apart; write the configuration that is reached. Return 0 where nothing is, 1 on the
   way, 2 at b. */
static int extend(Walk *k, const float *a, const float *b, float *reached) {
  const Checker *c = k->s->checker;
  const int n = (int)c->coordinates;
  k->s->edges++;
  if (!k->s->projection) {
    if (!edge_is_free(c, &k->w, a, b, (float)k->s->resolution)) return 0;
    memcpy(reached, b, n * sizeof(float));
    return 2;
  }
  int full;
  const int count = edge_on_manifold(c, k->s->projection, &k->w, k->store, k->o, a, b, (float)k->s->resolution,
                                     k->points, &full, 0);
  if (!count || (!full && distance(a, k->points + (count - 1) * n, n) < 1e-3f)) return 0;
  memcpy(reached, k->points + (count - 1) * n, n * sizeof(float));
  return full ? 2 : 1;
}

static void towards(const float *a, const float *b, int n, float range, float *out) {
  const float d = distance(a, b, n), t = d > range ? range / d : 1.0f;
  for (int i = 0; i < n; i++) out[i] = t < 1.0f ? a[i] + t * (b[i] - a[i]) : b[i];
}

/* Grow a tree from a node towards a goal, step by step, until something is in the way or no step brings it nearer.
   Return the last node, or -1 without memory; `met` is set if it is at the goal. */
static int tree_advance(Walk *k, Tree *t, int first, const float *goal, int *met) {
  const int n = (int)k->s->checker->coordinates;
  const float range = (float)k->s->range;
  float from[MOST_COORDINATES], to[MOST_COORDINATES], reached[MOST_COORDINATES];
  int node = first;
  *met = 0;
  for (int outcome = 2; outcome == 2 && !*met && node >= 0;) {
    tree_read(t, n, node, from);
    const float before = distance(from, goal, n);
    *met = before == 0.0f;
    if (*met) break;
    towards(from, goal, n, range, to);
    outcome = extend(k, from, to, reached);
    if (!outcome || k->w.watch.over) break;
    /* Points between two points of a manifold are off it, and their projections are not where they were. */
    const float after = distance(reached, goal, n);
    *met = outcome == 2 && before <= range && after < 1e-3f;
    if (!*met && node != first && after > before - 0.1f * fminf(range, before)) break;
    node = tree_add(t, n, reached, to, node);
  }
  return node;
}

/* Write the configurations from a root to node j, or backwards; return their number, or -1 without room. On a manifold
   the edges are gone again, with all their points, also when the time is up: they are few. */
static long long branch(Walk *k, const Tree *t, int j, int backwards, float *out, long long room) {
  const Checker *c = k->s->checker;
  const int n = (int)c->coordinates;
  long long depth = 0, count = 0;
  if (k->w.watch.over != INTERRUPTED) watch_begin(&k->w.watch, INFINITY);
  for (int i = j; i >= 0; i = t->parent[i]) depth++;
  int *nodes = malloc(depth * sizeof(int));
  if (!nodes) return -1;
  for (long long i = depth - 1; i >= 0; i--, j = t->parent[j]) nodes[i] = j;
  for (long long i = 0; i < depth; i++) {
    int points = 1, full;
    float from[MOST_COORDINATES], to[MOST_COORDINATES];
    if (k->s->projection && i) {
      tree_read(t, n, nodes[i - 1], from);
      tree_read(t, n, nodes[i], to);
      points = edge_on_manifold(c, k->s->projection, &k->w, k->store, k->o, from, t->aims + (long long)nodes[i] * n,
                                (float)k->s->resolution, k->points, &full, to);
    }
    if (k->w.watch.over || count + points > room) {
      count = -1;
      break;
    }
    if (k->s->projection && i)
      memcpy(out + count * n, k->points, points * n * sizeof(float));
    else
      tree_read(t, n, nodes[i], out + count * n);
    count += points;
  }
  free(nodes);
  for (long long a = 0, b = count - 1; backwards && a < b; a++, b--)
    for (int i = 0; i < n; i++) {
      const float swap = out[a * n + i];
      out[a * n + i] = out[b * n + i], out[b * n + i] = swap;
    }
  return count;
}

/* Edges of the straight way to a goal that is so far away that edges are longer than usual. */
#define FAR_EDGES 2000

/* Search a path from any start to any goal; write its configurations (room, n) and return their number. Without a
   path those from a start to the node nearest to a goal are written, and the status says why. */
EXPORTED long long kineverse_rrt_connect(Search *s, const float *starts, long long start_count, const float *goals,
                                         long long goal_count, float *path, long long room) {
  const Checker *c = s->checker;
  const int n = (int)c->coordinates;
  const double begin = now();
  Tree trees[2] = {{0}, {0}};
  Random random = (Random)s->seed * 0x2545f4914f6cdd1dULL + 0x9e3779b97f4a7c15ULL;
  Walk k;
  float sample[MOST_COORDINATES];
  long long count = -1, best = 0;
  float best_gap = INFINITY;
  s->iterations = s->edges = 0;
  s->status = NO_MEMORY;
  if (walk_begin(&k, s)) return -1;
  for (long long i = 0; i < start_count; i++)
    if (tree_add(&trees[0], n, starts + i * n, starts + i * n, -1) < 0) goto end;
  for (long long i = 0; i < goal_count; i++)
    if (tree_add(&trees[1], n, goals + i * n, goals + i * n, -1) < 0) goto end;
  for (long long i = 0; i < start_count; i++) {
    float away;
    nearest(&trees[1], n, starts + i * n, &away);
    if (away < best_gap) best_gap = away, best = i;
  }
  if (!s->projection) s->range = fmax(s->range, best_gap / FAR_EDGES);
  const float range = (float)s->range;
  /* The straight way first. */
  int grown = 0;
  s->status = TIME_IS_UP;
  for (;; s->iterations++) {
    if (k.w.watch.over || ((s->iterations & 15) == 0 && look_at_clock(&k.w.watch))) break;
    if (trees[0].count + trees[1].count > s->nodes || s->edges > s->most_edges) {
      s->status = TOO_MANY_NODES;
      break;
    }
    /* The smaller tree grows. */
    if (s->iterations >= start_count) grown = trees[0].count > trees[1].count;
    Tree *own = &trees[grown], *other = &trees[1 - grown];
    float away;
    if (s->iterations < start_count) {
      tree_read(own, n, s->iterations, sample);
      tree_read(other, n, nearest(other, n, sample, &away), sample);
    } else {
      for (int i = 0; i < n; i++) {
        const float low = fmaxf(c->lower[i], own->low[i] - range), high = fminf(c->upper[i], own->high[i] + range);
        sample[i] = low + random_unit(&random) * (high - low);
      }
    }
    int met, last = -1;
    const int parent = nearest(own, n, sample, &away), fresh = tree_advance(&k, own, parent, sample, &met);
    if (fresh == parent) continue;
    if (fresh >= 0) {
      tree_read(own, n, fresh, sample);
      const int near = nearest(other, n, sample, &away);
      if (grown == 0 && away < best_gap) best_gap = away, best = fresh;
      last = tree_advance(&k, other, near, sample, &met);
    }
    if (last < 0) {
      s->status = NO_MEMORY;
      break;
    }
    if (k.w.watch.over) break;
    if (met) {
      const int a = grown ? last : fresh, b = grown ? fresh : last;
      const long long first = branch(&k, &trees[0], a, 0, path, room);
      /* In the whole space both trees have the same configuration where they meet. */
      const long long joint = s->projection ? first : first - 1;
      const long long rest = first < 0 ? -1 : branch(&k, &trees[1], b, 1, path + joint * n, room - joint);
      s->status = rest < 0 ? TOO_LONG : FOUND;
      if (rest >= 0) count = joint + rest;
      best_gap = 0.0f;
      break;
    }
  }
  if (s->status != FOUND && trees[0].count) count = branch(&k, &trees[0], (int)best, 0, path, room);
end:
  s->gap = best_gap;
  s->count_start = trees[0].count;
  s->count_goal = trees[1].count;
  tree_free(&trees[0]);
  tree_free(&trees[1]);
  walk_end(&k);
  s->elapsed = now() - begin;
  return count;
}

/* Shorten a polyline (count, n) in place: random points on it are joined where the way between them is certain, until
   `patience` tries in a row have brought less than a hundredth each, or the time is up. Return the new number of
   points. */
EXPORTED long long kineverse_shortcut(Search *s, float *path, long long count, long long room, long long patience,
                                      double least) {
  const Checker *c = s->checker;
  const int n = (int)c->coordinates;
  const double begin = now();
  Random random = (Random)s->seed * 0x2545f4914f6cdd1dULL + 0x9e3779b97f4a7c15ULL;
  Work w;
  if (work_begin(&w, c, s->seconds)) return count;
  float *along = malloc(room * sizeof(float));
  for (long long tries = 0, failures = 0; along && failures < patience && count > 2; tries++, failures++) {
    if (w.watch.over || ((tries & 7) == 0 && look_at_clock(&w.watch))) break;
    along[0] = 0.0f;
    for (long long k = 1; k < count; k++) along[k] = along[k - 1] + distance(path + (k - 1) * n, path + k * n, n);
    float one = random_unit(&random) * along[count - 1], other = random_unit(&random) * along[count - 1];
    if (one > other) {
      const float swap = one;
      one = other, other = swap;
    }
    long long i = 0, j = 0;
    while (i + 2 < count && along[i + 1] <= one) i++;
    while (j + 2 < count && along[j + 1] <= other) j++;
    if (i == j) continue;
    /* Half of the ends are moved to nodes, so that the nodes between them vanish and no others come. */
    const Random bits = random_bits(&random);
    if (bits >> 63) one = along[i];
    if (bits >> 62 & 1) other = along[j + 1];
    float a[MOST_COORDINATES], b[MOST_COORDINATES], where;
    const float u = (one - along[i]) / fmaxf(along[i + 1] - along[i], 1e-9f);
    const float v = (along[j + 1] - other) / fmaxf(along[j + 1] - along[j], 1e-9f);
    for (int e = 0; e < n; e++) {
      a[e] = path[i * n + e] + u * (path[(i + 1) * n + e] - path[i * n + e]);
      b[e] = path[(j + 1) * n + e] + v * (path[j * n + e] - path[(j + 1) * n + e]);
    }
    const float gain = other - one - distance(a, b, n);
    const long long rest = count - j - 1, kept = i + 1 + (u > 0.0f) + (v > 0.0f);
    if (gain < 1e-3f * (other - one) || kept + rest > room) continue;
    if (!edge_is_free(c, &w, a, b, (float)s->resolution) ||
        !edge_is_certain(c, &w, a, b, (float)s->resolution, (float)least, &where))
      continue;
    memmove(path + kept * n, path + (j + 1) * n, rest * n * sizeof(float));
    if (u > 0.0f) memcpy(path + (i + 1) * n, a, n * sizeof(float));
    if (v > 0.0f) memcpy(path + (kept - 1) * n, b, n * sizeof(float));
    if (gain > 1e-2f * along[count - 1]) failures = -1;
    count = kept + rest;
  }
  free(along);
  work_end(&w);
  s->elapsed = now() - begin;
  return count;
}
