/* Collision check of a block: W configurations, one in each lane, against tables of obstacles.

   Links are covered by spheres in three levels: a ball around all, coarse spheres, fine spheres. Obstacles are
   shapes in sets. The set of the world holds all that stands still; every body that moves may have a set of its
   own, in its own frame. These tests are conservative: spheres stick out of the shapes that they cover, and a hull is
   the intersection of its half spaces, so that near an edge a sphere counts as a hit a little too early. Where they
   hit, the shapes are compared by the narrow phase of the scene, one lane at a time, in double precision. */
#pragma once
#include "../simd_functions.h"
#include "../interruption.h"

enum { BOX, CYLINDER, CAPSULE, SPHERE, HULL };

/* A shape in the frame of its set: p_set = rotation p + translation, rows first. The size of a box is its half
   edges; of a cylinder or capsule the radius and half the length; of a sphere the radius. */
typedef struct {
  float rotation[9], translation[3], size[3];
  int kind, body, first, planes, aligned, object;
} Obstacle;

/* Obstacles with their bounding boxes in columns, W in a chunk, and a bounding box of every chunk. */
typedef struct {
  const Obstacle *items;
  const float *boxes;  /* (6, padded): lowest x y z, highest x y z */
  const float *chunks; /* (6, padded chunks) */
  long long count, padded, padded_chunks, pose, link;
} ObstacleSet;

/* A body that moves. `low` and `high` bound the centres of its spheres and its shapes, in its frame. If `exact`, its
   shapes are its spheres. */
typedef struct {
  float ball[4], low[3], high[3];
  int pose, first, coarse, first_shape, shapes, exact;
} Link;

/* A shape of a body that moves: its pose in the frame of the link, rows of 3×4, and the number of its object. */
typedef struct {
  double pose[12];
  long long object;
} Shape;

/* Return 0 only if two objects are further apart than a limit. */
typedef long long IsWithin(const void *objects, long long i, long long j, double limit, double *direction);

typedef struct {
  float sphere[4];
  int first, count;
} Coarse;

typedef struct {
  int one, other;
} Pair;

typedef void Compute(const V *x, const V *kept, V *store, V *o);

/* Everything that a check reads. Outputs of `compute` are the poses (12 numbers each, rows of 3×4), then the
   conditions, which hold where they are at most 0. */
typedef struct {
  long long coordinates, poses, conditions, stored;
  Compute *compute;
  const V *kept;
  const float *lower, *upper;
  long long links, bodies;
  const Link *link;
  const Coarse *coarse;
  const float *fine;            /* (N, 4) centres and radii */
  const float (*planes)[4];     /* of all hulls: normal and offset */
  const unsigned char *allowed; /* (links, bodies of the world's set) */
  const ObstacleSet *world;
  const ObstacleSet *moving;
  const float *fineness; /* samples for each unit of a coordinate that conditions switch by; 0 for others */
  const float *turns;    /* largest angle by which a unit of a coordinate turns a body [rad] */
  long long pairs, moving_pairs;
  const Pair *pair;        /* two links, spheres against spheres */
  const Pair *moving_pair; /* a link, spheres, against a moving set */
  const Shape *shape;
  const void *objects; /* of the scene, with the poses and positions that follow */
  double *object_poses, *object_positions;
  const double *object_centres;
  IsWithin *is_within;
  double margin;
} Checker;

typedef struct {
  V *x, *store, *o, *centre, *relative, *before;
  float *inflation; /* of every link */
  void *memory;
  Watch watch;
} Work;

/* Work that ends after some seconds. */
static int work_begin(Work *w, const Checker *c, double seconds) {
  watch_begin(&w->watch, seconds);
  const size_t outputs = 12 * c->poses + c->conditions;
  const size_t vectors = 2 * c->coordinates + c->stored + outputs + 12 * c->poses + 3 * c->links + 12 + 8;
  w->memory = malloc(vectors * sizeof(V) + (c->links + 1) * sizeof(float) + 64);
  if (!w->memory) return 1;
  memset(w->memory, 0, vectors * sizeof(V) + (c->links + 1) * sizeof(float) + 64);
  w->x = (V *)(((size_t)w->memory + 63) & ~(size_t)63);
  w->store = w->x + 2 * c->coordinates + 1;
  w->o = w->store + c->stored + 1;
  w->centre = w->o + outputs + 1;
  w->relative = w->centre + 3 * c->links + 1;
  w->before = w->relative + 13;
  w->inflation = (float *)(w->before + 12 * c->poses);
  return 0;
}

static void work_end(Work *w) { free(w->memory); }

INLINE V affine(const V *T, int row, float x, float y, float z) {
  const V *r = T + 4 * row;
  return fused(r[0], splat(x), fused(r[1], splat(y), fused(r[2], splat(z), r[3])));
}

INLINE void transform_point(const V *T, const float *p, V *out) {
  UNROLLED for (int i = 0; i < 3; i++) out[i] = affine(T, i, p[0], p[1], p[2]);
}

/* The pose of a link in the frame of a moving set. */
static void relative_pose(const V *set, const V *link, V *out) {
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++)
      out[4 * i + j] = fused(set[i], link[j], fused(set[4 + i], link[4 + j], set[8 + i] * link[8 + j]));
    const V x = link[3] - set[3], y = link[7] - set[7], z = link[11] - set[11];
    out[4 * i + 3] = fused(set[i], x, fused(set[4 + i], y, set[8 + i] * z));
  }
}

/* One bit for each lane. */
INLINE unsigned lane_bits(I mask) {
#if W == 16
  return _mm512_movepi32_mask((__m512i)mask);
#elif W == 8
  return (unsigned)_mm256_movemask_ps((__m256)mask);
#else
  unsigned bits = 0;
  for (int i = 0; i < W; i++) bits |= (unsigned)(mask[i] & 1) << i;
  return bits;
#endif
}

INLINE float least_lane(V x) {
#if W == 16
  return _mm512_reduce_min_ps((__m512)x);
#else
  float m = x[0];
  for (int i = 1; i < W; i++) m = x[i] < m ? x[i] : m;
  return m;
#endif
}

INLINE float largest_lane(V x) {
#if W == 16
  return _mm512_reduce_max_ps((__m512)x);
#else
  float m = x[0];
  for (int i = 1; i < W; i++) m = x[i] > m ? x[i] : m;
  return m;
#endif
}

INLINE V positive(V x) { return larger(x, splat(0.0f)); }

/* The lanes in which a sphere touches an obstacle; p is the centre in the frame of the set. */
INLINE I touches(const Obstacle *b, const float (*planes)[4], const V *p, V reach) {
  V x = p[0] - splat(b->translation[0]), y = p[1] - splat(b->translation[1]), z = p[2] - splat(b->translation[2]);
  if (b->kind == SPHERE) {
    const V far = reach + splat(b->size[0]);
    return fused(x, x, fused(y, y, z * z)) <= far * far;
  }
  if (!b->aligned) {
    const float *R = b->rotation;
    const V u = fused(x, splat(R[0]), fused(y, splat(R[3]), z * splat(R[6])));
    const V v = fused(x, splat(R[1]), fused(y, splat(R[4]), z * splat(R[7])));
    z = fused(x, splat(R[2]), fused(y, splat(R[5]), z * splat(R[8])));
    x = u, y = v;
  }
  if (b->kind == BOX) {
    const V u = positive(magnitude(x) - splat(b->size[0])), v = positive(magnitude(y) - splat(b->size[1]));
    const V w = positive(magnitude(z) - splat(b->size[2]));
    return fused(u, u, fused(v, v, w * w)) <= reach * reach;
  }
  if (b->kind == HULL) {
    I inside = splat(0.0f) <= splat(0.0f);
    for (int k = b->first; k < b->first + b->planes; k++) {
      const float *n = planes[k];
      const V d = fused(x, splat(n[0]), fused(y, splat(n[1]), fused(z, splat(n[2]), -splat(n[3]))));
      inside &= d <= reach;
      if (!any(inside)) break;
    }
    return inside;
  }
  const V along = positive(magnitude(z) - splat(b->size[1]));
  if (b->kind == CAPSULE) {
    const V far = reach + splat(b->size[0]);
    return fused(x, x, fused(y, y, along * along)) <= far * far;
  }
  const V side = positive(root(fused(x, x, y * y)) - splat(b->size[0]));
  return fused(side, side, along * along) <= reach * reach;
}

#define MOST_CANDIDATES 128
#define FEW 6

/* Columns of boxes: the lowest and the highest corners. */
INLINE I meets(const float *columns, long long padded, long long k, const V *low, const V *high) {
  const V *x = (const V *)(columns + k);
#define COLUMN(i) (*(const V *)((const float *)x + (i) * padded))
  return (COLUMN(0) <= high[0]) & (COLUMN(1) <= high[1]) & (COLUMN(2) <= high[2]) & (COLUMN(3) >= low[0]) &
         (COLUMN(4) >= low[1]) & (COLUMN(5) >= low[2]);
#undef COLUMN
}

/* A search for the obstacles of a set whose boxes meet the box around a ball in all lanes. */
typedef struct {
  V low[3], high[3];
  long long next;   /* first of the chunks that were not looked at */
  unsigned waiting; /* chunks before it that were not opened */
} BoxSearch;

/* Lanes without a pose, whose loops do not close, are NaN and must not hide the others. */
INLINE void box_search_begin(BoxSearch *b, const V *centre, float reach) {
  for (int i = 0; i < 3; i++) {
    b->low[i] = splat(least_lane(smaller(centre[i], splat(INFINITY))) - reach);
    b->high[i] = splat(largest_lane(larger(centre[i], splat(-INFINITY))) + reach);
  }
  b->next = 0;
  b->waiting = 0;
}

/* Write the next candidates; return their number, which is 0 only at the end. */
static int box_search_next(BoxSearch *b, const ObstacleSet *s, const unsigned char *allowed, const Obstacle **found) {
  int count = 0;
  for (;;) {
    while (b->waiting) {
      if (count + W > MOST_CANDIDATES) return count;
      const long long chunk = b->next - W + __builtin_ctz(b->waiting);
      b->waiting &= b->waiting - 1;
      unsigned close = lane_bits(meets(s->boxes, s->padded, chunk * W, b->low, b->high));
      for (; close; close &= close - 1) {
        const Obstacle *o = s->items + chunk * W + __builtin_ctz(close);
        if (!allowed || allowed[o->body]) found[count++] = o;
      }
    }
    if (b->next >= s->padded_chunks) return count;
    b->waiting = lane_bits(meets(s->chunks, s->padded_chunks, b->next, b->low, b->high));
    b->next += W;
  }
}

#define MOST_DIRECTIONS 32

static void place_shape(const Checker *c, const Shape *s, const V *T, int lane) {
  double *pose = c->object_poses + 12 * s->object, *position = c->object_positions + 3 * s->object;
  const double *own = s->pose, *p = c->object_centres + 3 * s->object;
  for (int i = 0; i < 3; i++) {
    const double x = T[4 * i][lane], y = T[4 * i + 1][lane], z = T[4 * i + 2][lane];
    double *row = pose + 4 * i;
    for (int j = 0; j < 4; j++) row[j] = x * own[j] + y * own[4 + j] + z * own[8 + j];
    row[3] += T[4 * i + 3][lane];
    position[i] = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
  }
}

/* Those of some lanes in which a link touches another one, or an obstacle of the world, by their shapes. Neighbouring
   lanes are similar: a direction that separates two shapes in one of them is tried first in the next. */
static I shapes_touch(const Checker *c, const Work *w, const Link *a, const Link *b, const Obstacle *o, float grown,
                      int early, I lanes) {
  double directions[MOST_DIRECTIONS][3];
  memset(directions, 0, sizeof directions);
  const int others = b ? b->shapes : 1;
  I hit = splat(0.0f) < splat(0.0f);
  for (unsigned bits = lane_bits(lanes); bits; bits &= bits - 1) {
    const int lane = __builtin_ctz(bits);
    for (int i = 0; i < a->shapes; i++) place_shape(c, c->shape + a->first_shape + i, w->o + 12 * a->pose, lane);
    for (int j = 0; b && j < others; j++) place_shape(c, c->shape + b->first_shape + j, w->o + 12 * b->pose, lane);
    for (int k = 0; k < a->shapes * others && !hit[lane]; k++) {
      const long long one = c->shape[a->first_shape + k / others].object;
      const long long other = b ? c->shape[b->first_shape + k % others].object : o->object;
      double none[3] = {0.0, 0.0, 0.0};
      if (c->is_within(c->objects, one, other, grown, k < MOST_DIRECTIONS ? directions[k] : none)) hit[lane] = -1;
    }
    if (early && hit[lane]) break;
  }
  return hit;
}

#define MOST_NEAR 64

/* The lanes, beside those that were hit, in which some of the coarse spheres of a link, or the spheres in them, touch
   an obstacle. */
INLINE I spheres_against(const Checker *c, const Coarse *spheres, int count, const V (*centres)[3], const V *T,
                         const Obstacle *o, float grown, int early, I hit) {
  I lanes = splat(0.0f) < splat(0.0f);
  for (int a = 0; a < count; a++) {
    const Coarse *q = spheres + a;
    const I coarse = touches(o, c->planes, centres[a], splat(q->sphere[3] + grown));
    if (!any(coarse & ~(hit | lanes))) continue;
    if (q->count == 1) {
      lanes |= coarse;
    } else {
      for (int f = q->first; f < q->first + q->count; f++) {
        V r[3];
        transform_point(T, c->fine + 4 * f, r);
        lanes |= touches(o, c->planes, r, splat(c->fine[4 * f + 3] + grown));
        if (early && any(lanes)) return lanes & ~hit;
      }
    }
    if (early ? any(lanes) : !any(~(hit | lanes))) break;
  }
  return lanes & ~hit;
}

/* A link against a set; T is the pose of the link in the set's frame. If `shapes`, they decide where spheres touch. */
INLINE I link_against_set(const Checker *c, const Work *w, const Link *l, const V *T, const V *centre, const ObstacleSet *s,
                          const unsigned char *allowed, float inflation, int shapes, int early, I hit) {
  const float grown = inflation + (float)c->margin;
  const Obstacle *found[MOST_CANDIDATES];
  BoxSearch search;
  /* For a few obstacles a search takes longer than asking them all. */
  const int few = s->count <= FEW;
  if (!few) box_search_begin(&search, centre, l->ball[3] + grown);
  for (int more = 1; more;) {
    int count = 0, near = 0;
    if (few) {
      for (int k = 0; k < s->count; k++)
        if (!allowed || allowed[s->items[k].body]) found[count++] = s->items + k;
      more = 0;
    } else {
      count = box_search_next(&search, s, allowed, found);
      more = count > 0;
    }
    const V reach = splat(l->ball[3] + grown);
    for (int k = 0; k < count; k++)
      if (any(touches(found[k], c->planes, centre, reach) & ~hit)) found[near++] = found[k];
    if (!near) continue;
    for (int first = 0; first < l->coarse; first += MOST_NEAR) {
      const Coarse *spheres = c->coarse + l->first + first;
      const int some = l->coarse - first < MOST_NEAR ? l->coarse - first : MOST_NEAR;
      V centres[MOST_NEAR][3];
      for (int a = 0; a < some; a++) transform_point(T, spheres[a].sphere, centres[a]);
      for (int k = 0; k < near; k++) {
        const Obstacle *o = found[k];
        const int decided = !shapes || (l->exact && o->kind != HULL);
        const I lanes = spheres_against(c, spheres, some, centres, T, o, grown, early && decided, hit);
        if (!any(lanes)) continue;
        hit |= decided ? lanes : shapes_touch(c, w, l, 0, o, grown, early, lanes);
        if (early ? any(hit) : !any(~hit)) return hit;
      }
    }
  }
  return hit;
}

INLINE I spheres_touch(const V *p, const V *q, float reach) {
  const V x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
  return fused(x, x, fused(y, y, z * z)) <= splat(reach * reach);
}

/* The coarse spheres of a link that touch a ball: their numbers and centres. */
INLINE int spheres_near_ball(const Checker *c, const Link *l, const V *T, const V *centre, float reach, I hit, int *first,
                             int *near, V (*centres)[3]) {
  int count = 0;
  for (; *first < l->first + l->coarse && count < MOST_NEAR; ++*first) {
    const Coarse *s = c->coarse + *first;
    transform_point(T, s->sphere, centres[count]);
    if (any(spheres_touch(centres[count], centre, s->sphere[3] + reach) & ~hit)) near[count++] = *first;
  }
  return count;
}

INLINE I link_against_link(const Checker *c, const Link *a, const Link *b, const V *A, const V *B, const V *at, const V *bt,
                           float grown, int early, I hit) {
  int near[MOST_NEAR], others[MOST_NEAR];
  V p[MOST_NEAR][3], q[MOST_NEAR][3];
  for (int from = b->first; from < b->first + b->coarse;) {
    const int other_count = spheres_near_ball(c, b, B, at, a->ball[3] + grown, hit, &from, others, q);
    for (int start = a->first; other_count && start < a->first + a->coarse;) {
      const int count = spheres_near_ball(c, a, A, bt, b->ball[3] + grown, hit, &start, near, p);
      for (int i = 0; i < count; i++) {
        const Coarse *s = c->coarse + near[i];
        for (int j = 0; j < other_count; j++) {
          const Coarse *t = c->coarse + others[j];
          const I close = spheres_touch(p[i], q[j], s->sphere[3] + t->sphere[3] + grown);
          if (!any(close & ~hit)) continue;
          if (s->count == 1 && t->count == 1) {
            hit |= close;
          } else {
            for (int f = s->first; f < s->first + s->count; f++) {
              V u[3];
              transform_point(A, c->fine + 4 * f, u);
              if (!any(spheres_touch(u, q[j], c->fine[4 * f + 3] + t->sphere[3] + grown) & ~hit)) continue;
              for (int g = t->first; g < t->first + t->count; g++) {
                V v[3];
                transform_point(B, c->fine + 4 * g, v);
                hit |= spheres_touch(u, v, c->fine[4 * f + 3] + c->fine[4 * g + 3] + grown);
              }
              if (early && any(hit)) return hit;
            }
          }
          if (early && any(hit)) return hit;
        }
      }
    }
  }
  return hit;
}

/* The lanes in which two links touch, and those that were hit before: their spheres, or the spheres of the first one
   and a set with the shapes of the second one, then the shapes of both. */
INLINE I links_touch(const Checker *c, Work *w, const Link *a, const Link *b, const ObstacleSet *s, int early, I hit) {
  const long long i = a - c->link, j = b - c->link;
  const int decided = a->exact && b->exact;
  const V *p = w->centre + 3 * i, *q = w->centre + 3 * j, *A = w->o + 12 * a->pose, *B = w->o + 12 * b->pose;
  const float inflation = w->inflation[i] + w->inflation[j], grown = inflation + (float)c->margin;
  if (!any(spheres_touch(p, q, a->ball[3] + b->ball[3] + grown) & ~hit)) return hit;
  I lanes;
  if (s) {
    V centre[3];
    relative_pose(B, A, w->relative);
    transform_point(w->relative, a->ball, centre);
    lanes = link_against_set(c, w, a, w->relative, centre, s, 0, inflation, 0, early && decided, hit);
  } else {
    lanes = link_against_link(c, a, b, A, B, p, q, grown, early && decided, hit);
  }
  lanes &= ~hit;
  return any(lanes) ? hit | (decided ? lanes : shapes_touch(c, w, a, b, 0, grown, early, lanes)) : hit;
}

/* The lanes of w->x that are not free. With `early` all that matters is whether there is any. The outputs of
   `compute` are there already. */
INLINE I find_collisions(const Checker *c, Work *w, int early) {
  I hit = splat(0.0f) < splat(0.0f);
#define RETURN_IF_KNOWN \
  if (early ? any(hit) : !any(~hit)) return hit
  const V *conditions = w->o + 12 * c->poses;
  for (int k = 0; k < c->conditions; k++) hit |= ~(conditions[k] <= splat(0.0f));
  RETURN_IF_KNOWN;
  /* The last links of an arm meet most. */
  for (int k = (int)c->links - 1; k >= 0; k--) {
    const Link *l = c->link + k;
    const V *T = w->o + 12 * l->pose;
    transform_point(T, l->ball, w->centre + 3 * k);
    hit = link_against_set(c, w, l, T, w->centre + 3 * k, c->world, c->allowed + k * c->bodies, w->inflation[k], 1, early,
                           hit);
    RETURN_IF_KNOWN;
  }
  for (int k = 0; k < c->pairs; k++) {
    const Pair *p = c->pair + k;
    hit = links_touch(c, w, c->link + p->one, c->link + p->other, 0, early, hit);
    RETURN_IF_KNOWN;
  }
  for (int k = 0; k < c->moving_pairs; k++) {
    const Pair *p = c->moving_pair + k;
    hit = links_touch(c, w, c->link + p->one, c->link + p->other, c->moving + p->other, early, hit);
    RETURN_IF_KNOWN;
  }
#undef RETURN_IF_KNOWN
  return hit;
}

static I collisions(const Checker *c, Work *w) { return find_collisions(c, w, 0); }
static int collides(const Checker *c, Work *w) { return any(find_collisions(c, w, 1)); }
