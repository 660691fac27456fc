/* Lazy probabilistic roadmap (Kavraki et al. 1996; Bohlin and Kavraki 2000), kept between queries.

   Nodes are W in a chunk of columns, as in a tree. Each node has edges of its own, to the nearest of the nodes that
   were there before it; edges of later nodes to it are in a list. Whether nodes and edges are free is looked at when
   a search comes to them, and remembered. A coordinate with a period is on a circle: its values in nodes are within
   half a turn of 0, and edges go the short way round. */
#pragma once
#include "rrt_connect.h"

/* An edge is free if its samples are, and certain if nothing between them collides either. */
enum { UNKNOWN, FREE, BLOCKED, CERTAIN };

#define MOST_DEGREE 64
#define NONE (-1)

/* A node as one side of the search sees it; rounds and queries are counted, so that nothing has to be cleared. */
typedef struct {
  long long closed; /* last round in which the node was reached */
  long long seen;   /* last query for which `rest` was computed */
  float cost, rest; /* way from the ends of this side; distance to those of the other side */
  int from, edge;
} Visit;

/* All arrays have `room` nodes. */
typedef struct {
  const Checker *checker;
  double resolution, least, greed, seconds; /* least: growth of spheres, see edge_is_certain */
  long long seed, degree, room, least_batch;
  const float *period; /* infinite for a coordinate on a line */
  float *columns, *lengths; /* lengths of edges, (room, degree) */
  int *targets;             /* of edges, (room, degree) */
  int *incoming, *next;     /* the last edge to a node, (room,); the one before it, (room, degree) */
  unsigned char *node, *edge, *passing; /* states; nodes that are ends of queries */
  Visit *visits[2];
  int *reached[2]; /* nodes in the order in which they are reached */
  long long count, ends, drawn, round, query;
  /* results */
  long long samples, nodes_checked, edges_checked, reached_start, reached_goal, status;
  double elapsed, gap;
} Roadmap;

typedef struct {
  float key, cost;
  int node, from;
  long long edge;
} Candidate;

typedef struct {
  Candidate *items;
  long long count, room;
} Queue;

typedef struct {
  Roadmap *r;
  Work w;
  Queue queues[2];
  int *ends[2]; /* nodes of the starts and of the goals */
  long long counts[2];
  long long reached[2];
  Random random;
  double begin;
} Query;

static int queue_push(Queue *q, Candidate c) {
  if (q->count == q->room) {
    const long long room = q->room ? 2 * q->room : 1024;
    Candidate *items = realloc(q->items, room * sizeof(Candidate));
    if (!items) return 1;
    q->items = items, q->room = room;
  }
  long long k = q->count++;
  for (; k && q->items[(k - 1) / 2].key > c.key; k = (k - 1) / 2) q->items[k] = q->items[(k - 1) / 2];
  q->items[k] = c;
  return 0;
}

static Candidate queue_pop(Queue *q) {
  const Candidate first = q->items[0], last = q->items[--q->count];
  long long k = 0;
  for (long long child; (child = 2 * k + 1) < q->count; k = child) {
    if (child + 1 < q->count && q->items[child + 1].key < q->items[child].key) child++;
    if (q->items[child].key >= last.key) break;
    q->items[k] = q->items[child];
  }
  q->items[k] = last;
  return first;
}

static void node_read(const Roadmap *r, long long k, float *q) {
  const int n = (int)r->checker->coordinates;
  for (int i = 0; i < n; i++) q[i] = r->columns[(k / W * n + i) * W + k % W];
}

/* The value nearest to `to` that differs from x by full turns. */
static float unwind(float x, float to, float period) {
  return isinf(period) ? x : x - period * roundf((x - to) / period);
}

static float distance_around(const Roadmap *r, const float *a, const float *b) {
  float sum = 0.0f;
  for (int i = 0; i < r->checker->coordinates; i++) {
    const float d = unwind(b[i], a[i], r->period[i]) - a[i];
    sum += d * d;
  }
  return sqrtf(sum);
}

/* Write the nodes nearest to q that are not known to be blocked, nearest first, and how far away they are; return
   their number. */
static int nearest_nodes(const Roadmap *r, const float *q, int most, int *found, float *away) {
  const int n = (int)r->checker->coordinates;
  int count = 0;
  float limit = INFINITY;
  for (long long first = 0; first < r->count; first += W) {
    const V *column = (const V *)(r->columns + first * n);
    V sum = splat(0.0f);
    for (int i = 0; i < n; i++) {
      V d = magnitude(column[i] - splat(q[i]));
      d = smaller(d, splat(r->period[i]) - d);
      sum = fused(d, d, sum);
    }
    unsigned near = lane_bits(sum < splat(limit));
    for (; near; near &= near - 1) {
      const int lane = __builtin_ctz(near);
      const long long k = first + lane;
      if (k >= r->count) break;
      if (r->node[k] == BLOCKED || sum[lane] >= limit) continue;
      int place = count < most ? count++ : most - 1;
      for (; place && away[place - 1] > sum[lane]; place--)
        away[place] = away[place - 1], found[place] = found[place - 1];
      away[place] = sum[lane], found[place] = (int)k;
      if (count == most) limit = away[most - 1];
    }
  }
  for (int i = 0; i < count; i++) away[i] = sqrtf(away[i]);
  return count;
}

/* Add a node with edges to its neighbours, and return it. */
static int node_add(Roadmap *r, const float *q, int state, int passing, const int *near, const float *away,
                    int neighbours) {
  const int n = (int)r->checker->coordinates;
  const long long k = r->count++;
  for (int i = 0; i < n; i++) r->columns[(k / W * n + i) * W + k % W] = q[i];
  r->node[k] = (unsigned char)state;
  r->passing[k] = (unsigned char)passing;
  r->ends += passing;
  r->incoming[k] = NONE;
  for (int side = 0; side < 2; side++) r->visits[side][k].closed = r->visits[side][k].seen = 0;
  for (long long i = 0, e = k * r->degree; i < r->degree; i++, e++) {
    r->targets[e] = i < neighbours ? near[i] : NONE;
    if (i >= neighbours) continue;
    r->lengths[e] = away[i];
    r->edge[e] = UNKNOWN;
    r->next[e] = r->incoming[near[i]];
    r->incoming[near[i]] = (int)e;
  }
  return (int)k;
}

static int is_within_limits(const Roadmap *r, const float *q) {
  const Checker *c = r->checker;
  for (int i = 0; i < c->coordinates; i++)
    if (isinf(r->period[i]) && (q[i] < c->lower[i] || q[i] > c->upper[i])) return 0;
  return 1;
}

/* Forget blocked nodes, those beyond the limits, and the ends of other queries. Return the number of the rest, or -1
   without memory. */
static long long compact(Query *s) {
  Roadmap *r = s->r;
  const int n = (int)r->checker->coordinates;
  const long long degree = r->degree, before = r->count;
  float q[MOST_COORDINATES];
  int *place = malloc((before + 1) * sizeof(int));
  if (!place) return -1;
  long long count = 0;
  for (long long k = 0; k < before; k++) {
    node_read(r, k, q);
    place[k] = r->passing[k] || r->node[k] == BLOCKED || !is_within_limits(r, q) ? NONE : 0;
  }
  for (int side = 0; side < 2; side++)
    for (long long i = 0; i < s->counts[side]; i++) place[s->ends[side][i]] = 0;
  for (long long k = 0; k < before; k++)
    if (place[k] != NONE) place[k] = (int)count++;
  r->ends = 0;
  for (long long k = 0; k < before; k++) {
    const long long to = place[k];
    if (to == NONE) continue;
    node_read(r, k, q);
    for (int i = 0; i < n; i++) r->columns[(to / W * n + i) * W + to % W] = q[i];
    r->node[to] = r->node[k], r->passing[to] = r->passing[k];
    r->ends += r->passing[to];
    r->incoming[to] = NONE;
    for (int side = 0; side < 2; side++) r->visits[side][to].closed = r->visits[side][to].seen = 0;
    for (long long i = 0; i < degree; i++) {
      /* Neighbours came before, so their new places are known and their lists begun. */
      const long long from = k * degree + i, e = to * degree + i;
      const int target = r->targets[from] == NONE ? NONE : place[r->targets[from]];
      r->targets[e] = target, r->lengths[e] = r->lengths[from], r->edge[e] = r->edge[from];
      if (target == NONE) continue;
      r->next[e] = r->incoming[target];
      r->incoming[target] = (int)e;
    }
  }
  for (int side = 0; side < 2; side++)
    for (long long i = 0; i < s->counts[side]; i++) s->ends[side][i] = place[s->ends[side][i]];
  free(place);
  return r->count = count;
}

/* Check a node that a search has come to, and neighbours of it in the other lanes: it comes to them next. */
static int node_is_usable(Query *s, int k) {
  Roadmap *r = s->r;
  const Checker *c = r->checker;
  float rows[W * MOST_COORDINATES];
  node_read(r, k, rows);
  if (!is_within_limits(r, rows)) return 0;
  if (r->node[k] != UNKNOWN) return r->node[k] == FREE;
  int nodes[W] = {k}, count = 1;
  for (long long i = 0; i < r->degree && count < W; i++) {
    const int target = r->targets[k * r->degree + i];
    if (target != NONE && r->node[target] == UNKNOWN) nodes[count++] = target;
  }
  for (long long e = r->incoming[k]; e != NONE && count < W; e = r->next[e]) {
    const int source = (int)(e / r->degree);
    if (r->node[source] == UNKNOWN) nodes[count++] = source;
  }
  for (int j = 1; j < count; j++) node_read(r, nodes[j], rows + j * c->coordinates);
  read_lanes(c, &s->w, rows, count);
  evaluate(c, &s->w);
  const I hit = collisions(c, &s->w);
  for (int j = 0; j < count; j++) r->node[nodes[j]] = hit[j] ? BLOCKED : FREE;
  r->nodes_checked += count;
  return r->node[k] == FREE;
}

/* The state of the way from a to b, free, blocked, or certain; unknown if the time was up before it was clear. */
static int check_way(Query *s, const float *a, const float *b, int certain) {
  Roadmap *r = s->r;
  float to[MOST_COORDINATES], where;
  for (int i = 0; i < r->checker->coordinates; i++) to[i] = unwind(b[i], a[i], r->period[i]);
  r->edges_checked++;
  const float resolution = (float)r->resolution;
  const int free_ = certain ? edge_is_certain(r->checker, &s->w, a, to, resolution, (float)r->least, &where)
                            : edge_is_free(r->checker, &s->w, a, to, resolution);
  if (free_) return certain ? CERTAIN : FREE;
  return s->w.watch.over ? UNKNOWN : BLOCKED;
}

static int edge_is_usable(Query *s, long long e, int certain) {
  Roadmap *r = s->r;
  if (r->edge[e] == UNKNOWN || (certain && r->edge[e] == FREE)) {
    float a[MOST_COORDINATES], b[MOST_COORDINATES];
    node_read(r, e / r->degree, a);
    node_read(r, r->targets[e], b);
    const int state = check_way(s, a, b, certain);
    if (state == UNKNOWN) return 0;
    r->edge[e] = (unsigned char)state;
  }
  return r->edge[e] != BLOCKED;
}

/* The distance of a node to the ends of the other side. */
static float estimate_rest(Query *s, int side, int k) {
  Roadmap *r = s->r;
  Visit *v = r->visits[side] + k;
  if (v->seen == r->query) return v->rest;
  float q[MOST_COORDINATES], end[MOST_COORDINATES];
  node_read(r, k, q);
  v->seen = r->query;
  v->rest = INFINITY;
  for (long long i = 0; i < s->counts[1 - side]; i++) {
    node_read(r, s->ends[1 - side][i], end);
    v->rest = fminf(v->rest, distance_around(r, q, end));
  }
  return v->rest;
}

static int offer(Query *s, int side, int k, long long e, int from, float cost) {
  Roadmap *r = s->r;
  if (r->visits[side][k].closed == r->round || r->node[k] == BLOCKED || (e != NONE && r->edge[e] == BLOCKED)) return 0;
  const float key = cost + (float)r->greed * estimate_rest(s, side, k);
  return queue_push(&s->queues[side], (Candidate){key, cost, k, from, e});
}

/* Take the best candidate of one side, and reach it if it and its edge are free. Return 1 if the other side has been
   there, -1 without memory. */
static int advance(Query *s, int side, int *met) {
  Roadmap *r = s->r;
  const Candidate best = queue_pop(&s->queues[side]);
  const int k = best.node;
  Visit *v = r->visits[side] + k;
  if (v->closed == r->round) return 0;
  /* What the other side has reached is free. */
  const int meets = r->visits[1 - side][k].closed == r->round;
  if (best.edge != NONE && ((!meets && !node_is_usable(s, k)) || !edge_is_usable(s, best.edge, 0))) return 0;
  v->closed = r->round, v->cost = best.cost, v->from = best.from, v->edge = (int)best.edge;
  r->reached[side][s->reached[side]++] = k;
  if (meets) {
    *met = k;
    return 1;
  }
  int failed = 0;
  for (long long e = (long long)k * r->degree; e < (k + 1LL) * r->degree; e++)
    if (r->targets[e] != NONE) failed |= offer(s, side, r->targets[e], e, k, best.cost + r->lengths[e]);
  for (long long e = r->incoming[k]; e != NONE; e = r->next[e])
    failed |= offer(s, side, (int)(e / r->degree), e, k, best.cost + r->lengths[e]);
  return failed ? -1 : 0;
}

/* A* from both sides by turns. An edge is checked when its end is taken from the queue (lazy A*, Cohen, Phillips and
   Likhachev 2014). Return 1 if they meet, 0 if the queue of a side gets empty or the time is up, -1 without memory. */
static int search_round(Query *s, double until, int only_start, int *met) {
  Roadmap *r = s->r;
  r->round++;
  for (int side = 0; side < 2; side++) {
    s->reached[side] = s->queues[side].count = 0;
    for (long long i = 0; i < s->counts[side]; i++)
      if (offer(s, side, s->ends[side][i], NONE, NONE, 0.0f)) return -1;
  }
  for (long long steps = 0;; steps++) {
    if (!s->queues[0].count || (!s->queues[1].count && !only_start)) return 0;
    if (s->w.watch.over || ((steps & 15) == 15 && (look_at_clock(&s->w.watch) || now() - s->begin > until))) return 0;
    const int side = s->queues[1].count && (steps & 1);
    const int outcome = advance(s, side, met);
    if (outcome) return outcome;
  }
}

/* Move q to a step of at most 1 from the node nearest to it that one side has reached, as a tree grows. */
static void step_out(const Query *s, int side, float *q) {
  const Roadmap *r = s->r;
  const int n = (int)r->checker->coordinates;
  float p[MOST_COORDINATES], nearest[MOST_COORDINATES], least = INFINITY;
  for (long long i = 0; i < s->reached[side]; i++) {
    node_read(r, r->reached[side][i], p);
    const float d = distance_around(r, q, p);
    if (d < least) least = d, memcpy(nearest, p, n * sizeof(float));
  }
  if (isinf(least) || least <= 1.0f) return;
  for (int i = 0; i < n; i++) {
    const float to = unwind(q[i], nearest[i], r->period[i]);
    q[i] = unwind(nearest[i] + (to - nearest[i]) / least, 0.0f, r->period[i]);
  }
}

/* Move q into a cube of random size about any node that one side has reached. */
static void stay_near(Query *s, int side, float *q) {
  const Roadmap *r = s->r;
  const Checker *c = r->checker;
  float p[MOST_COORDINATES];
  if (!s->reached[side]) return;
  node_read(r, r->reached[side][random_bits(&s->random) % (unsigned long long)s->reached[side]], p);
  const float spread = 4.0f * random_unit(&s->random);
  for (int i = 0; i < c->coordinates; i++) {
    const float x = p[i] + spread * (random_unit(&s->random) - 0.5f);
    q[i] = isinf(r->period[i]) ? fminf(fmaxf(x, c->lower[i]), c->upper[i]) : unwind(x, 0.0f, r->period[i]);
  }
}

/* Add up to `batch` nodes. Half of them are anywhere; the others are about those that the side with fewer has reached:
   there it is narrow (Kavraki et al. 1996, expansion). Steps leave cages, and cubes find ways shorter than a step.
   Return 0 if there is no room. */
static int grow(Query *s, long long batch, double until) {
  Roadmap *r = s->r;
  const Checker *c = r->checker;
  const int n = (int)c->coordinates, narrow = s->reached[1] < s->reached[0];
  /* An eighth of the room is for the ends of queries. */
  const long long most = r->room - r->room / 8;
  int near[MOST_DEGREE];
  float rows[W * MOST_COORDINATES], away[MOST_DEGREE];
  for (long long tries = 0; batch > 0 && tries < 64 && !look_at_clock(&s->w.watch) && now() - s->begin < until; tries++) {
    for (int j = 0; j < W; j++) {
      float *q = rows + j * n;
      for (int i = 0; i < n; i++) {
        const float u = random_unit(&s->random), p = r->period[i];
        q[i] = isinf(p) ? c->lower[i] + u * (c->upper[i] - c->lower[i]) : (u - 0.5f) * p;
      }
      if ((j & 3) == 1) step_out(s, narrow, q);
      if ((j & 3) == 3) stay_near(s, narrow, q);
    }
    read_lanes(c, &s->w, rows, W);
    evaluate(c, &s->w);
    const I hit = collisions(c, &s->w);
    r->samples += W, r->drawn += W, r->nodes_checked += W;
    for (int j = 0; j < W && batch > 0; j++) {
      if (hit[j]) continue;
      if (r->count - r->ends >= most || r->count >= r->room) return 0;
      const int count = nearest_nodes(r, rows + j * n, (int)r->degree, near, away);
      if (count && away[0] < 1e-6f) continue;
      node_add(r, rows + j * n, FREE, 0, near, away, count);
      batch--, tries = 0;
    }
  }
  return 1;
}

/* Make nodes of starts or goals, or find them. Return 1 if there is no room. */
static int add_ends(Query *s, int side, const float *rows, long long count) {
  Roadmap *r = s->r;
  const int n = (int)r->checker->coordinates;
  for (long long k = 0; k < count; k++) {
    float q[MOST_COORDINATES], away[MOST_DEGREE];
    int near[MOST_DEGREE];
    for (int i = 0; i < n; i++) q[i] = unwind(rows[k * n + i], 0.0f, r->period[i]);
    if (r->count == r->room && (compact(s) < 0 || r->count == r->room)) return 1;
    const int neighbours = nearest_nodes(r, q, (int)r->degree, near, away);
    const int known = neighbours && away[0] < 1e-6f;
    s->ends[side][s->counts[side]++] = known ? near[0] : node_add(r, q, FREE, 1, near, away, neighbours);
  }
  return 0;
}

/* Write the nodes from an end of one side to node k, or backwards; return their number, or -1 without room. */
static long long trace(const Query *s, int side, int k, int backwards, float *out, long long room) {
  const Visit *visits = s->r->visits[side];
  const int n = (int)s->r->checker->coordinates;
  long long depth = 0;
  for (int i = k; i != NONE; i = visits[i].from) depth++;
  if (depth > room) return -1;
  for (long long i = 0; i < depth; i++, k = visits[k].from)
    node_read(s->r, k, out + (backwards ? i : depth - 1 - i) * n);
  return depth;
}

/* The node reached from the start that is nearest to one of the first that are reached from the goals. */
static int nearest_pair(const Query *s, float *gap) {
  const Roadmap *r = s->r;
  float q[MOST_COORDINATES], p[MOST_COORDINATES];
  int best = NONE;
  *gap = INFINITY;
  for (long long j = 0; j < s->reached[1] && j < 64; j++) {
    node_read(r, r->reached[1][j], p);
    for (long long i = 0; i < s->reached[0]; i++) {
      node_read(r, r->reached[0][i], q);
      const float d = distance_around(r, q, p);
      if (d < *gap) *gap = d, best = r->reached[0][i];
    }
  }
  return best;
}

/* The straight way from a start to the goal nearest to it, if it is free. */
static long long straight_way(Query *s, const float *starts, long long start_count, const float *goals,
                              long long goal_count, float *path) {
  const int n = (int)s->r->checker->coordinates;
  for (long long i = 0; i < start_count; i++) {
    const float *goal = goals;
    for (long long j = 1; j < goal_count; j++)
      if (distance_around(s->r, starts + i * n, goals + j * n) < distance_around(s->r, starts + i * n, goal))
        goal = goals + j * n;
    const int state = check_way(s, starts + i * n, goal, 0);
    if (state == BLOCKED || state == UNKNOWN) continue;
    memcpy(path, starts + i * n, n * sizeof(float));
    memcpy(path + n, goal, n * sizeof(float));
    return 2;
  }
  return 0;
}

/* Whether the path by way of a node is free between samples too. Edges of paths are used again, so that an edge that is
   not certain has to be found out once. */
static int path_is_certain(Query *s, int met) {
  int certain = 1;
  for (int side = 0; side < 2; side++)
    for (const Visit *v = s->r->visits[side] + met; v->from != NONE; v = s->r->visits[side] + v->from)
      certain &= edge_is_usable(s, v->edge, 1);
  return certain;
}

static long long search_roadmap(Query *s, float *path, long long room) {
  Roadmap *r = s->r;
  /* A tenth of the time is for the best partial path. */
  const double until = 0.9 * r->seconds;
  int met = NONE, outcome = 0, compacted = 0;
  for (;;) {
    outcome = search_round(s, until, 0, &met);
    r->status = FOUND;
    if (outcome < 0 || (outcome && path_is_certain(s, met))) break;
    r->status = TIME_IS_UP;
    if (s->w.watch.over || now() - s->begin > until) break;
    if (outcome) continue;
    /* A round costs as much as the smaller side is large, and so may nodes. */
    const long long smaller_side = s->reached[0] < s->reached[1] ? s->reached[0] : s->reached[1];
    const long long batch = smaller_side / 2 > r->least_batch ? smaller_side / 2 : r->least_batch;
    if (grow(s, batch, until)) continue;
    /* Blocked nodes and ends of other queries give way to new nodes, once. */
    const long long before = r->count;
    if (compacted++ || compact(s) < 0 || r->count > before - r->room / 16) {
      r->status = TOO_MANY_NODES;
      break;
    }
    s->reached[0] = s->reached[1] = 0;
  }
  if (r->status != FOUND && s->w.watch.over == LATE) watch_begin(&s->w.watch, 0.1 * r->seconds);
  if (r->status != FOUND)
    do outcome = search_round(s, r->seconds, 1, &met);
    while (outcome > 0 && !path_is_certain(s, met) && !s->w.watch.over);
  if (outcome < 0) {
    r->status = NO_MEMORY;
    return -1;
  }
  if (outcome == 0 || s->w.watch.over) {
    float gap;
    const int best = nearest_pair(s, &gap);
    r->gap = gap;
    return best == NONE ? 0 : trace(s, 0, best, 0, path, room);
  }
  r->status = FOUND;
  const long long first = trace(s, 0, met, 0, path, room);
  const int n = (int)r->checker->coordinates;
  /* Both sides have the node at which they meet. */
  const long long rest = first < 0 ? -1 : trace(s, 1, met, 1, path + (first - 1) * n, room - first + 1);
  if (rest < 0) r->status = TOO_LONG;
  return rest < 0 ? -1 : first + rest - 1;
}

/* Search a path from any start to any goal; write its configurations (room, n) and return their number. Without a
   path those from a start to the node nearest to a goal are written, and the status says why. Coordinates with a
   period go on from where the start has them, so that they may end full turns away from a goal. */
EXPORTED long long kineverse_roadmap(Roadmap *r, const float *starts, long long start_count, const float *goals,
                                     long long goal_count, float *path, long long room) {
  const int n = (int)r->checker->coordinates;
  Query s = {.r = r, .begin = now()};
  Random seed = (Random)r->seed * 0x2545f4914f6cdd1dULL + (Random)r->drawn;
  s.random = random_bits(&seed);
  r->query++;
  r->samples = r->nodes_checked = r->edges_checked = r->reached_start = r->reached_goal = 0;
  r->status = NO_MEMORY;
  r->gap = INFINITY;
  s.ends[0] = malloc((start_count + goal_count + 1) * sizeof(int));
  s.ends[1] = s.ends[0] + start_count;
  long long count = -1;
  if (!s.ends[0] || work_begin(&s.w, r->checker, r->seconds)) goto end;
  count = straight_way(&s, starts, start_count, goals, goal_count, path);
  if (count) {
    r->status = FOUND;
  } else if (add_ends(&s, 0, starts, start_count) || (add_ends(&s, 1, goals, goal_count) && !s.counts[1])) {
    r->status = TOO_MANY_NODES;
  } else {
    count = search_roadmap(&s, path, room);
  }
  if (r->status == FOUND) r->gap = 0.0;
  /* The first point is a start as it is given, the others follow from it. */
  for (long long k = 0; s.counts[0] && count > 0 && k < start_count; k++)
    if (distance_around(r, starts + k * n, path) < 1e-5f) {
      memcpy(path, starts + k * n, n * sizeof(float));
      break;
    }
  for (long long k = 1; k < count; k++)
    for (int i = 0; i < n; i++) path[k * n + i] = unwind(path[k * n + i], path[(k - 1) * n + i], r->period[i]);
  r->reached_start = s.reached[0];
  r->reached_goal = s.reached[1];
  work_end(&s.w);
end:
  free(s.queues[0].items);
  free(s.queues[1].items);
  free(s.ends[0]);
  r->elapsed = now() - s.begin;
  return count;
}
