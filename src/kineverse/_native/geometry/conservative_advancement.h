/* Conservative advancement of pairs along sampled motions.

   A pair that is further apart than a limit is not looked at again before the travel of both objects, as in
   the broad phase, has used up the rest. So most pairs are looked at once for many samples. */
#pragma once
#include "gjk.h"

/* Object at one sample. The travel is that since the first sample. */
typedef struct {
  double pose[12], place[3], low[3], high[3], travel;
} Placed;

/* Motion of some objects along samples, among others that stand still. */
typedef struct {
  int64_t moved, still, room; /* room: number of samples */
  const int32_t *moving, *standing;
  const uint8_t *selected; /* pairs of bodies */
  Placed *placed;          /* the samples of one object after those of another */
  double *boxes;           /* corners of the boxes that stand still, and a row of gaps */
  Function compute;
  double *inputs, *outputs;
  const int64_t *columns; /* of the coordinates among the inputs; -1 for none */
  int64_t coordinates, first;
  double limit, least;
} Motion;

/* Computes the poses at configurations. */
EXPORTED int64_t trace(const Motion *m, const double *rows, int64_t n) {
  const double *arguments[1] = {m->inputs};
  double *results[1] = {m->outputs};
  for (int64_t k = 0; k < n; k++) {
    for (int64_t c = 0; c < m->coordinates; c++)
      if (m->columns[c] >= 0) m->inputs[m->columns[c]] = rows[m->coordinates * k + c];
    if (m->compute(arguments, results, NULL, NULL, 0)) return k;
    for (int64_t p = 0; p < m->moved; p++)
      memcpy(m->placed[m->room * p + k].pose, m->outputs + 12 * m->moving[p], 12 * sizeof(double));
  }
  return n;
}

/* Computes boxes and travel from the poses. Returns the number of samples up to one whose poses are not
   finite or whose travel is too long. */
EXPORTED int64_t settle(const Table *t, const Motion *m, int64_t n) {
  for (int64_t p = 0; p < m->moved; p++) {
    const double *c = t->centre + 3 * m->moving[p], *h = t->half + 3 * m->moving[p];
    Placed *s = m->placed + m->room * p;
    for (int64_t k = 0; k < n; k++, s++) {
      double turned = 0.0, shifted = 0.0;
      const Placed *before = k ? s - 1 : s;
      for (int i = 0; i < 12; i++)
        if (!(fabs(s->pose[i]) <= FURTHEST)) n = k; /* also for NaN */
      if (n == k) break;
      for (int r = 0; r < 3; r++) {
        const double *row = s->pose + 4 * r, *old = before->pose + 4 * r;
        const double extent = fabs(row[0]) * h[0] + fabs(row[1]) * h[1] + fabs(row[2]) * h[2];
        s->place[r] = row[0] * c[0] + row[1] * c[1] + row[2] * c[2] + row[3];
        s->low[r] = s->place[r] - extent;
        s->high[r] = s->place[r] + extent;
        shifted += square(s->place[r] - before->place[r]);
        for (int i = 0; i < 3; i++) turned += square(row[i] - old[i]);
      }
      s->travel = k ? before->travel + sqrt(shifted) + t->radius[m->moving[p]] * sqrt(turned / 2) : 0.0;
      if (s->travel > LONGEST_TRAVEL && k) n = k;
    }
  }
  return n;
}

static inline double gap_of(const double *low, const double *high, const double *other_low,
                            const double *other_high) {
  double sum = 0.0;
  for (int r = 0; r < 3; r++)
    sum += square(larger(larger(low[r] - other_high[r], other_low[r] - high[r]), 0.0));
  return sqrt(sum);
}

/* First sample after k at which two objects have come nearer by a distance. */
static int64_t next_sample(const Placed *a, const Placed *b, int64_t k, int64_t end, double free) {
  const double start = a[k].travel + (b ? b[k].travel : 0.0);
  int64_t low = k, step = 1;
#define NEARER(at) (a[at].travel + (b ? b[at].travel : 0.0) - start)
  while (low + step < end && NEARER(low + step) < free) low += step, step *= 2;
  int64_t high = low + step < end ? low + step : end;
  while (low + 1 < high) {
    const int64_t middle = (low + high) / 2;
    if (NEARER(middle) < free) low = middle;
    else high = middle;
  }
  return high;
}

static inline void put(const Table *t, int64_t i, const Placed *s) {
  memcpy(t->poses + 12 * i, s->pose, sizeof s->pose);
  memcpy(t->place + 3 * i, s->place, sizeof s->place);
}

/* Looks at one pair; the second object stands still if it has no samples. Returns the first sample with a
   contact, or one that is left to coal, and `end` without any. */
static int64_t advance_pair(const Table *t, Motion *m, int64_t i, const Placed *a, int64_t j, const Placed *b,
                            int64_t from, int64_t end) {
  for (int64_t k = from; k < end;) {
    const double reach = m->limit + ACCURACY;
    const double *low = b ? b[k].low : t->low + 3 * j, *high = b ? b[k].high : t->high + 3 * j;
    double apart = gap_of(a[k].low, a[k].high, low, high);
    if (apart <= reach) {
      put(t, i, a + k);
      if (b) put(t, j, b + k);
      const int64_t one = i < j ? i : j, other = i < j ? j : i;
      apart = larger(apart, lower_bound(t, one, other));
      if (apart <= reach) {
        double witness[9];
        const double distance = measured(t, one, other, m->limit, witness, &apart);
        if (isnan(distance)) return k;
        if (distance <= m->limit) {
          if (m->first) return k;
          m->least = distance < m->least ? distance : m->least;
          m->limit = larger(m->least, 0.0);
        }
      }
    }
    k = next_sample(a, b, k, end, apart - m->limit - ACCURACY);
  }
  return end;
}

static inline int is_selected(const Table *t, const Motion *m, int64_t i, int64_t j) {
  return m->selected[t->bodies * t->body[i] + t->body[j]];
}

/* Corners of the box that contains an object at some samples. */
static void swept_box(const Placed *s, int64_t from, int64_t end, double *low, double *high) {
  for (int r = 0; r < 3; r++) low[r] = INFINITY, high[r] = -INFINITY;
  for (int64_t k = from; k < end; k++)
    for (int r = 0; r < 3; r++) {
      low[r] = s[k].low[r] < low[r] ? s[k].low[r] : low[r];
      high[r] = larger(s[k].high[r], high[r]);
    }
}

/* Returns the first of some samples, from one on, with a pair within the limit or one that is left to coal;
   -1 without any. If the least distance is asked for, `limit` and `least` shrink to it instead. The table is
   as before afterwards. */
EXPORTED int64_t advance(const Table *t, Motion *m, int64_t from, int64_t count) {
  int64_t end = count;
  const int64_t s = m->still;
  double *gap = m->boxes + 6 * s;
  for (int64_t k = 0; k < s; k++)
    for (int r = 0; r < 3; r++) {
      m->boxes[r * s + k] = t->low[3 * m->standing[k] + r];
      m->boxes[(3 + r) * s + k] = t->high[3 * m->standing[k] + r];
    }
  for (int64_t p = 0; p < m->moved && from < end; p++) {
    const int64_t i = m->moving[p];
    const Placed *a = m->placed + m->room * p;
    double poses[12], place[3], low[3], high[3];
    memcpy(poses, t->poses + 12 * i, sizeof poses);
    memcpy(place, t->place + 3 * i, sizeof place);
    swept_box(a, from, end, low, high);
    for (int64_t k = 0; k < s; k++) {
      const double *box = m->boxes + k;
      gap[k] = square(larger(larger(low[0] - box[3 * s], box[0] - high[0]), 0.0)) +
               square(larger(larger(low[1] - box[4 * s], box[s] - high[1]), 0.0)) +
               square(larger(larger(low[2] - box[5 * s], box[2 * s] - high[2]), 0.0));
    }
    for (int64_t k = 0; k < s; k++)
      if (gap[k] <= square(m->limit + ACCURACY) && is_selected(t, m, i, m->standing[k]))
        end = advance_pair(t, m, i, a, m->standing[k], NULL, from, end);
    for (int64_t q = p + 1; q < m->moved; q++) {
      const int64_t j = m->moving[q];
      if (!is_selected(t, m, i, j)) continue;
      double other_poses[12], other_place[3];
      memcpy(other_poses, t->poses + 12 * j, sizeof other_poses);
      memcpy(other_place, t->place + 3 * j, sizeof other_place);
      end = advance_pair(t, m, i, a, j, m->placed + m->room * q, from, end);
      memcpy(t->poses + 12 * j, other_poses, sizeof other_poses);
      memcpy(t->place + 3 * j, other_place, sizeof other_place);
    }
    memcpy(t->poses + 12 * i, poses, sizeof poses);
    memcpy(t->place + 3 * i, place, sizeof place);
  }
  return end < count ? end : -1;
}
