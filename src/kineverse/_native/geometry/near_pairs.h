/* Whole queries for near pairs: found, measured, ranked and gathered. */
#pragma once
#include "gjk.h"

typedef struct {
  double distance;
  int64_t bodies;
  int32_t i, j, at;
} Found;

static inline int comes_before(const Found *a, const Found *b) {
  if (a->distance != b->distance) return a->distance < b->distance;
  if (a->bodies != b->bodies) return a->bodies < b->bodies;
  return a->i != b->i ? a->i < b->i : a->j < b->j;
}

/* Length of the runs that are sorted by insertion before they are merged. */
#define RUN 8

/* Merge sort; `spare` is as long as `found`. Returns the one that holds the result. */
static Found *sorted(Found *found, Found *spare, int64_t n) {
  for (int64_t k = 1; k < n; k++) {
    const Found one = found[k];
    int64_t at = k;
    for (; at % RUN && comes_before(&one, found + at - 1); at--) found[at] = found[at - 1];
    found[at] = one;
  }
  for (int64_t width = RUN; width < n; width *= 2) {
    for (int64_t start = 0; start < n; start += 2 * width) {
      const int64_t middle = start + width < n ? start + width : n;
      const int64_t end = middle + width < n ? middle + width : n;
      int64_t a = start, b = middle, k = start;
      while (a < middle && b < end)
        spare[k++] = comes_before(found + b, found + a) ? found[b++] : found[a++];
      while (a < middle) spare[k++] = found[a++];
      while (b < end) spare[k++] = found[b++];
    }
    Found *other = found;
    found = spare;
    spare = other;
  }
  return found;
}

/* Collects the pairs with a distance within a limit, and returns their number. */
static int64_t collect(
    const Table *t, const int32_t *pairs, int64_t n, const double *distances, double limit, Found *found) {
  int64_t count = 0;
  for (int64_t k = 0; k < n; k++)
    if (distances[k] <= limit) {
      const int32_t i = pairs[2 * k], j = pairs[2 * k + 1], a = t->body[i], b = t->body[j];
      const int64_t bodies = a < b ? t->bodies * a + b : t->bodies * b + a;
      found[count++] = (Found){distances[k], bodies, i, j, (int32_t)k};
    }
  return count;
}

/* Slot of a key, which is not 0, in a table with 2^k slots, of which some are empty. */
static inline int64_t slot_of(const int64_t *known, int64_t slots, int64_t key) {
  uint64_t slot = (uint64_t)key * 0x9E3779B97F4A7C15u >> 20 & (slots - 1);
  while (known[slot] && known[slot] != key) slot = (slot + 1) & (slots - 1);
  return (int64_t)slot;
}

/* Writes the indices of the pairs within a radius, nearest first, of each pair of bodies the nearest, or
   `all`; `order` has room for all. Returns their number, -1 without memory. */
EXPORTED int64_t rank(
    const Table *t, const int32_t *pairs, int64_t n, const double *distances, double radius, int64_t all,
    int64_t *order) {
  int64_t kept = 0, slots = 2;
  while (slots < 2 * n) slots *= 2;
  Found *memory = malloc((2 * n + 1) * sizeof(Found)), *found = memory;
  int64_t *known = calloc(slots, sizeof(int64_t)); /* pairs of bodies that were found, plus 1 */
  if (!found || !known) {
    free(memory);
    free(known);
    return -1;
  }
  const int64_t count = collect(t, pairs, n, distances, radius, found);
  found = sorted(found, found + n, count);
  for (int64_t k = 0; k < count; k++) {
    const int64_t bodies = found[k].bodies + 1, slot = slot_of(known, slots, bodies);
    if (all || !known[slot]) order[kept++] = found[k].at;
    known[slot] = bodies;
  }
  free(memory);
  free(known);
  return kept;
}

/* Writes pairs in an order; the first body of each precedes the second in the model. */
EXPORTED void gather(
    const Table *t, const int32_t *pairs, const double *distances, const double *witnesses,
    const int64_t *order, int64_t n, int32_t *pieces, int32_t *bodies, double *distance, double *witness) {
  for (int64_t k = 0; k < n; k++) {
    const int32_t *pair = pairs + 2 * order[k];
    const double *points = witnesses + 9 * order[k];
    const int turn = t->body[pair[0]] > t->body[pair[1]];
    distance[k] = distances[order[k]];
    for (int r = 0; r < 2; r++) {
      pieces[2 * k + r] = pair[r ^ turn];
      bodies[2 * k + r] = t->body[pair[r ^ turn]];
    }
    for (int r = 0; r < 3; r++) {
      witness[9 * k + r] = points[3 * turn + r];
      witness[9 * k + 3 + r] = points[3 * !turn + r];
      witness[9 * k + 6 + r] = turn ? -points[6 + r] : points[6 + r];
    }
  }
}

/* Measures pairs by their lower bounds, except those that cannot be the nearest of their bodies: their
   distance is infinite. Returns 0 without memory. */
static int measure_nearest(Table *t, const int32_t *pairs, int64_t n, const double *lows, double limit,
                           double *distances, double *witnesses) {
  int64_t slots = 2;
  while (slots < 2 * n) slots *= 2;
  Found *memory = malloc((2 * n + 1) * sizeof(Found)), *found = memory;
  double *least = malloc(slots * sizeof(double));
  int64_t *known = calloc(slots, sizeof(int64_t));
  const int enough = found && least && known;
  if (enough) {
    const int64_t count = collect(t, pairs, n, lows, INFINITY, found);
    found = sorted(found, found + n, count);
    for (int64_t m = 0; m < count; m++) {
      const int64_t k = found[m].at, key = found[m].bodies + 1, slot = slot_of(known, slots, key);
      if (!known[slot]) least[slot] = INFINITY;
      known[slot] = key;
      if (lows[k] > least[slot] + ACCURACY) {
        distances[k] = INFINITY;
        continue;
      }
      measure(t, pairs + 2 * k, 1, limit, distances + k, witnesses + 9 * k);
      if (distances[k] < least[slot]) least[slot] = distances[k];
    }
  }
  free(memory);
  free(least);
  free(known);
  return enough;
}

/* Whole query. `allowed` and `active` take the place of the table's, unless they are NULL; `known` has the
   neighbours among them, or is NULL. */
typedef struct {
  double reach, radius;
  int64_t all, room;
  const uint8_t *allowed, *active;
  Neighbours *known;
  int32_t *pairs;
  double *lows, *distances, *witnesses;
  int64_t *order;
  int64_t kept;
  int32_t *pieces, *bodies;
  double *distance, *witness;
} Query;

static int64_t answer_query(Table *t, Query *q) {
  const int64_t found = q->known ? near_again(t, q->known, q->reach, q->pairs, q->lows, q->room)
                                 : near(t, q->reach, q->pairs, q->lows, q->room);
  q->kept = -1;
  if (found < 0 || found > q->room) return found;
  if (q->all || t->bodies == t->count ||
      !measure_nearest(t, q->pairs, found, q->lows, q->radius, q->distances, q->witnesses))
    measure(t, q->pairs, found, q->radius, q->distances, q->witnesses);
  for (int64_t k = 0; k < found; k++)
    if (isnan(q->distances[k])) return found;
  q->kept = rank(t, q->pairs, found, q->distances, q->radius, q->all, q->order);
  if (q->kept > 0)
    gather(t, q->pairs, q->distances, q->witnesses, q->order, q->kept, q->pieces, q->bodies, q->distance,
           q->witness);
  return found;
}

/* Measures, ranks and gathers the pairs that may be within `reach`. Returns the number of measured pairs, and
   writes the number `kept`: -1 if some pairs are left to coal, or the buffers are too short. Minus the number
   of neighbours is returned if that is more than there is room for. */
EXPORTED int64_t search(Table *t, Query *q) {
  const uint8_t *allowed = t->allowed, *active = t->active;
  if (q->allowed) t->allowed = q->allowed, t->active = q->active;
  const int64_t found = answer_query(t, q);
  t->allowed = allowed;
  t->active = active;
  return found;
}
