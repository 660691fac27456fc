/* Broad phase, with lists of neighbours for queries that are asked at one state after another. */
#pragma once
#include "../definitions.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Measured pair: the travel of both at that time, and the result. */
typedef struct {
  int64_t pair; /* 0 for none */
  double travel_i, travel_j, distance, witness[9];
} Memory;

typedef struct {
  int64_t count, moving, bodies, axis;
  const int32_t *body;
  const uint8_t *allowed, *active;
  const double *centre, *half, *radius;
  double *poses, *travel, *place, *low, *high, *bounds;
  int32_t *order;
  double *sorted_boxes;
  const double *const *corners;
  const int64_t *corner_count;
  const double *edges, *radii, *round, *tip;
  Memory *memory;
  const double *boxes;
  const int32_t *leaves;
  int64_t node_count, leaf_count, resets;
} Table;

/* Pairs of objects of selected bodies that may be within a reach; see `near_again`. */
typedef struct {
  double reach;
  double *travel; /* of the moving objects when they were found */
  int32_t *pairs;
  int64_t found, room, resets;
  const int32_t *selected;        /* pairs of bodies */
  const int32_t *members, *first; /* objects by body, and where each body begins */
  int64_t count;                  /* of the pairs of bodies */
  double *boxes;                  /* corners of the boxes of bodies; NULL for a sweep */
} Neighbours;


/* Slot of a pair, which another pair may have overwritten. */
static inline Memory *memory_of(const Table *t, int64_t i, int64_t j) {
  return t->memory + ((uint64_t)(t->count * i + j + 1) * 0x9E3779B97F4A7C15u >> (64 - MEMORY_BITS));
}

/* True if the pair is remembered and neither object has moved since. */
static inline int is_known(const Memory *m, const Table *t, int64_t i, int64_t j) {
  return m->pair == t->count * i + j + 1 && m->travel_i == t->travel[i] && m->travel_j == t->travel[j];
}

static inline double square(double x) { return x * x; }

/* Faster than fmax, which handles NaN; there is none here. */
static inline double larger(double x, double y) { return x > y ? x : y; }

/* Difference of the reach of neighbours to that of a query. */
#define SPARE 0.06

EXPORTED int64_t place(Table *t, const double *fresh) {
  int64_t outcome = PLACED;
  for (int64_t k = 0; k < 12 * t->moving; k++)
    if (!(fabs(fresh[k]) <= FURTHEST)) return k / 12; /* also for NaN */
  for (int64_t k = 0; k < t->moving; k++) {
    const double *new = fresh + 12 * k, *c = t->centre + 3 * k, *h = t->half + 3 * k;
    double *old = t->poses + 12 * k, turned = 0.0, shifted = 0.0;
    if (t->travel[k] > LONGEST_TRAVEL) outcome = TRAVEL_EXCEEDED;
    if (!memcmp(new, old, 12 * sizeof(double))) continue;
    for (int r = 0; r < 3; r++) {
      const double *row = new + 4 * r;
      const double at = row[0] * c[0] + row[1] * c[1] + row[2] * c[2] + row[3];
      const double extent = fabs(row[0]) * h[0] + fabs(row[1]) * h[1] + fabs(row[2]) * h[2];
      shifted += square(at - t->place[3 * k + r]);
      t->place[3 * k + r] = at;
      t->low[3 * k + r] = at - extent;
      t->high[3 * k + r] = at + extent;
      for (int i = 0; i < 3; i++) turned += square(row[i] - old[4 * r + i]);
      for (int i = 0; i < 4; i++) old[4 * r + i] = row[i];
    }
    t->travel[k] += sqrt(shifted) + t->radius[k] * sqrt(turned / 2);
    if (t->travel[k] > LONGEST_TRAVEL) outcome = TRAVEL_EXCEEDED;
  }
  return outcome;
}

/* Distance of one object's bounding sphere from another's box; -inf if the centre is inside of it. */
static double box_to_sphere(const Table *t, int64_t box, int64_t sphere, const double *between) {
  const double *pose = t->poses + 12 * box, *half = t->half + 3 * box;
  double outside = 0.0;
  for (int i = 0; i < 3; i++) {
    const double inside = pose[i] * between[0] + pose[4 + i] * between[1] + pose[8 + i] * between[2];
    const double beyond = fabs(inside) - half[i];
    if (beyond > 0.0) outside += beyond * beyond;
  }
  return outside > 0.0 ? sqrt(outside) - t->radius[sphere] : -INFINITY;
}

static double lower_bound(const Table *t, int64_t i, int64_t j) {
  const double *a = t->place + 3 * i, *b = t->place + 3 * j;
  const double between[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
  const double back[3] = {-between[0], -between[1], -between[2]};
  double bound = sqrt(square(between[0]) + square(between[1]) + square(between[2]));
  bound = bound - t->radius[i] - t->radius[j];
  bound = larger(bound, box_to_sphere(t, i, j, between));
  return larger(bound, box_to_sphere(t, j, i, back));
}

/* Sorts objects by their lower ends; insertion, as the order changes little between two queries. */
static void sort(const Table *t, int32_t *order, int64_t n) {
  for (int64_t k = 1; k < n; k++) {
    const int32_t piece = order[k];
    const double low = t->low[3 * piece + t->axis];
    int64_t at = k;
    for (; at > 0 && t->low[3 * order[at - 1] + t->axis] > low; at--) order[at] = order[at - 1];
    order[at] = piece;
  }
}

typedef struct {
  double reach;
  int32_t *pairs;
  double *lows;
  int64_t room, found;
} Answer;

/* Adds a pair whose boxes are near each other. */
static void consider(const Table *t, int64_t one, int64_t other, Answer *answer) {
  if (!t->allowed[t->bodies * t->body[one] + t->body[other]] || !t->active[other]) return;
  const double reach = answer->reach;
  const int64_t i = one < other ? one : other, j = one < other ? other : one;
  double known = -INFINITY;
  if (t->bounds && t->bounds[t->count * i + j] != 0.0) {
    known = t->bounds[t->count * i + j] - (t->travel[i] + t->travel[j]);
    if (known > reach) return;
  }
  const Memory *memory = memory_of(t, i, j);
  const double low = is_known(memory, t, i, j) ? memory->distance : larger(lower_bound(t, i, j), known);
  if (low > reach) return;
  if (answer->found < answer->room) {
    answer->pairs[2 * answer->found] = (int32_t)i;
    answer->pairs[2 * answer->found + 1] = (int32_t)j;
    if (answer->lows) answer->lows[answer->found] = low;
  }
  answer->found++;
}

/* Squared gaps between a box and W others, whose corners are in rows. */
static inline void square_gaps_of_node(
    const double *low, const double *high, const double *boxes, double *gap) {
  for (int k = 0; k < TREE_WIDTH; k++) {
    const double *box = boxes + k;
    gap[k] = square(larger(larger(low[0] - box[3 * TREE_WIDTH], box[0] - high[0]), 0.0)) +
             square(larger(larger(low[1] - box[4 * TREE_WIDTH], box[TREE_WIDTH] - high[1]), 0.0)) +
             square(larger(larger(low[2] - box[5 * TREE_WIDTH], box[2 * TREE_WIDTH] - high[2]), 0.0));
  }
}

/* Adds the pairs of an object with static ones, down the AABB tree of build_static_tree. */
static void consider_static(const Table *t, int64_t one, Answer *answer) {
  const double *low = t->low + 3 * one, *high = t->high + 3 * one, square_reach = square(answer->reach);
  const int64_t first_leaf = t->node_count - t->leaf_count;
  int64_t waiting[128] = {0};
  int depth = 1;
  while (depth) {
    const int64_t node = waiting[--depth];
    double gap[TREE_WIDTH];
    square_gaps_of_node(low, high, t->boxes + 6 * TREE_WIDTH * node, gap);
    if (node < first_leaf) {
      for (int k = 0; k < TREE_WIDTH; k++)
        if (gap[k] <= square_reach) waiting[depth++] = TREE_WIDTH * node + 1 + k;
      continue;
    }
    const int32_t *leaf = t->leaves + TREE_WIDTH * (node - first_leaf);
    for (int k = 0; k < TREE_WIDTH && leaf[k] >= 0; k++)
      if (gap[k] <= square_reach) consider(t, one, leaf[k], answer);
  }
}

/* Writes the squared gaps between the box of one moving object, in their order, and those of others. */
static void square_gaps(const Table *t, int64_t one, int64_t first, int64_t end) {
  const int64_t n = t->moving;
  const double *low = t->sorted_boxes, *high = low + 3 * n;
  double *gap = t->sorted_boxes + 6 * n;
  const double a[3] = {low[one], low[n + one], low[2 * n + one]};
  const double b[3] = {high[one], high[n + one], high[2 * n + one]};
  for (int64_t k = first; k < end; k++)
    gap[k] = square(larger(larger(a[0] - high[k], low[k] - b[0]), 0.0)) +
             square(larger(larger(a[1] - high[n + k], low[n + k] - b[1]), 0.0)) +
             square(larger(larger(a[2] - high[2 * n + k], low[2 * n + k] - b[2]), 0.0));
}

/* Returns the number of pairs; only the first `room` of them are written. Of two moving objects, the one with
   the smaller lower end finds the other. Pairs of static objects are skipped. */
EXPORTED int64_t near(Table *t, double reach, int32_t *pairs, double *lows, int64_t room) {
  sort(t, t->order, t->moving);
  Answer answer = {reach, pairs, lows, room, 0};
  const int64_t n = t->moving;
  double *low = t->sorted_boxes, *high = low + 3 * n, *gap = low + 6 * n;
  for (int64_t k = 0; k < n; k++)
    for (int r = 0; r < 3; r++) {
      low[r * n + k] = t->low[3 * t->order[k] + r];
      high[r * n + k] = t->high[3 * t->order[k] + r];
    }
  for (int64_t k = 0; k < n; k++) {
    const int32_t one = t->order[k];
    if (!t->active[one]) continue;
    int64_t end = k + 1;
    while (end < n && low[t->axis * n + end] <= high[t->axis * n + k] + reach) end++;
    square_gaps(t, k, k + 1, end);
    for (int64_t m = k + 1; m < end; m++)
      if (gap[m] <= reach * reach) consider(t, one, t->order[m], &answer);
    if (n < t->count) consider_static(t, one, &answer);
  }
  return answer.found;
}

static inline double square_gap(const double *a, const double *b, const double *c, const double *d) {
  double gap = 0.0;
  for (int r = 0; r < 3; r++) gap += square(larger(larger(a[r] - d[r], c[r] - b[r]), 0.0));
  return gap;
}

/* Finds the pairs that `near` finds, by the boxes of selected pairs of bodies. The bodies of a robot in a
   kitchen have many objects, most of which are far from all others. */
static int64_t near_selected(const Table *t, const Neighbours *known, double reach) {
  Answer answer = {reach, known->pairs, NULL, known->room, 0};
  for (int64_t b = 0; b < t->bodies; b++) {
    double *low = known->boxes + 6 * b, *high = low + 3;
    for (int r = 0; r < 3; r++) low[r] = INFINITY, high[r] = -INFINITY;
    for (int32_t m = known->first[b]; m < known->first[b + 1]; m++) {
      const int32_t i = known->members[m];
      for (int r = 0; r < 3 && t->active[i]; r++) {
        low[r] = t->low[3 * i + r] < low[r] ? t->low[3 * i + r] : low[r];
        high[r] = larger(t->high[3 * i + r], high[r]);
      }
    }
  }
  for (int64_t k = 0; k < known->count; k++) {
    const int32_t a = known->selected[2 * k], b = known->selected[2 * k + 1];
    const double *one = known->boxes + 6 * a, *other = known->boxes + 6 * b;
    if (!(square_gap(one, one + 3, other, other + 3) <= reach * reach)) continue;
    for (int32_t m = known->first[a]; m < known->first[a + 1]; m++) {
      const int32_t i = known->members[m];
      if (!t->active[i] || !(square_gap(t->low + 3 * i, t->high + 3 * i, other, other + 3) <= reach * reach))
        continue;
      for (int32_t p = known->first[b]; p < known->first[b + 1]; p++) {
        const int32_t j = known->members[p];
        if ((i < t->moving || j < t->moving) &&
            square_gap(t->low + 3 * i, t->high + 3 * i, t->low + 3 * j, t->high + 3 * j) <= reach * reach)
          consider(t, i, j, &answer);
      }
    }
  }
  return answer.found;
}

/* Distance by which two objects may have come nearer since pairs were found. */
static double approached(const Table *t, const Neighbours *known) {
  double first = 0.0, second = 0.0;
  for (int64_t k = 0; k < t->moving; k++) {
    const double travel = t->active[k] ? t->travel[k] - known->travel[k] : 0.0;
    if (travel > first) second = first, first = travel;
    else if (travel > second) second = travel;
  }
  return first + second;
}

/* Does what `near` does, by a list of neighbours (Verlet, Physical Review 159, 1967): pairs within a larger
   reach. All others stay beyond the reach until two objects have come nearer by the difference. Returns minus
   the number of neighbours if there are more than the list has room for. */
static int64_t near_again(
    Table *t, Neighbours *known, double reach, int32_t *pairs, double *lows, int64_t room) {
  if (known->resets != t->resets || !(reach + approached(t, known) <= known->reach)) {
    known->resets = -1;
    const int64_t found = known->boxes ? near_selected(t, known, reach + SPARE)
                                       : near(t, reach + SPARE, known->pairs, NULL, known->room);
    if (found > known->room) return -found;
    known->found = found;
    known->reach = reach + SPARE;
    known->resets = t->resets;
    memcpy(known->travel, t->travel, t->moving * sizeof(double));
  }
  Answer answer = {reach, pairs, lows, room, 0};
  for (int64_t k = 0; k < known->found; k++) {
    const int32_t i = known->pairs[2 * k], j = known->pairs[2 * k + 1];
    if (square_gap(t->low + 3 * i, t->high + 3 * i, t->low + 3 * j, t->high + 3 * j) <= reach * reach)
      consider(t, i, j, &answer);
  }
  return answer.found;
}
