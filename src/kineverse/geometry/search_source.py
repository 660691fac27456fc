"""C text: all that is near, measured and in order, after :mod:`.narrow_source`."""

SEARCH = r"""
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

/* So many are sorted by insertion, before runs of them are merged. */
#define RUN 8

/* Sorts by merging runs of growing length; `spare` has as much room. Returns where the result is. */
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

/* Writes which pairs are the nearest ones of their bodies and within a radius, nearest first; `order` has
   room for all. Returns how many, -1 if there is no memory. */
EXPORT int64_t rank(
    const Table *t, const int32_t *pairs, int64_t n, const double *distances, double radius, int64_t *order) {
  int64_t count = 0, kept = 0, slots = 2;
  while (slots < 2 * n) slots *= 2;
  Found *memory = malloc((2 * n + 1) * sizeof(Found)), *found = memory;
  int64_t *known = calloc(slots, sizeof(int64_t)); /* bodies that were there, and 1 */
  if (!found || !known) {
    free(memory);
    free(known);
    return -1;
  }
  for (int64_t k = 0; k < n; k++)
    if (distances[k] <= radius) {
      const int32_t i = pairs[2 * k], j = pairs[2 * k + 1], a = t->body[i], b = t->body[j];
      const int64_t bodies = a < b ? t->bodies * a + b : t->bodies * b + a;
      found[count++] = (Found){distances[k], bodies, i, j, (int32_t)k};
    }
  found = sorted(found, found + n, count);
  for (int64_t k = 0; k < count; k++) {
    const int64_t bodies = found[k].bodies + 1;
    uint64_t slot = (uint64_t)bodies * 0x9E3779B97F4A7C15u >> 20 & (slots - 1);
    while (known[slot] && known[slot] != bodies) slot = (slot + 1) & (slots - 1);
    if (!known[slot]) order[kept++] = found[k].at;
    known[slot] = bodies;
  }
  free(memory);
  free(known);
  return kept;
}

/* Writes pairs in an order, that body first which is before the other in the model. */
EXPORT void gather(
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

/* All of it: what may be within `reach`, measured, ranked, and the nearest pairs of their bodies in order.
   Returns how many pairs were measured, and writes how many are `kept`: -1 if some are left to coal, or if
   there is no room. */
EXPORT int64_t search(
    Table *t, double reach, double radius, int64_t room, int32_t *pairs, double *lows, double *distances,
    double *witnesses, int64_t *order, int64_t *kept, int32_t *pieces, int32_t *bodies, double *distance,
    double *witness) {
  const int64_t found = near(t, reach, pairs, lows, room);
  *kept = -1;
  if (found > room) return found;
  measure(t, pairs, found, radius, distances, witnesses);
  for (int64_t k = 0; k < found; k++)
    if (isnan(distances[k])) return found;
  *kept = rank(t, pairs, found, distances, radius, order);
  if (*kept > 0) gather(t, pairs, distances, witnesses, order, *kept, pieces, bodies, distance, witness);
  return found;
}
"""
