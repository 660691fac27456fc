/* Levenberg-Marquardt iteration of the parameters and joint values of a joint. */
#pragma once
#include "../interruption.h"
#include "newton_step.h"

/* Stages end early if a handler of signals has raised an exception; then nobody looks at the answer. */
static _Thread_local Watch watch;

/* What a solution is, for Python: numbers first, and arrays behind them in the same memory. */
typedef struct {
  Motion motion;
  double cost, converged, marginal, log_evidence;
  Belief belief;
} Head;

typedef struct {
  Head *head;
  double *values, *parents, *residuals, *covariances, *poses, *by_parameters, *by_joints;
} Answer;

#define HEAD ((int64_t)(sizeof(Head) / sizeof(double)))
#define NOISE 144
#define OBSERVATION ((int64_t)(sizeof(Observation) / sizeof(double)))

static int64_t answer_size(const Problem *p) {
  return HEAD + p->count * (p->joints + 32 + p->rows * (1 + p->rows + size_of(p) + p->joints));
}

/* The parts of a solution in some memory; returns what is behind it. */
static double *lay(const Problem *p, double *memory, Answer *a) {
  a->head = (Head *)memory;
  a->values = memory + HEAD;
  a->parents = a->values + p->count * p->joints;
  a->residuals = a->parents + p->count * 16;
  a->covariances = a->residuals + p->count * p->rows;
  a->poses = a->covariances + p->count * p->rows * p->rows;
  a->by_parameters = a->poses + p->count * 16;
  a->by_joints = a->by_parameters + p->count * p->rows * size_of(p);
  return a->by_joints + p->count * p->rows * p->joints;
}

static void copy(const Problem *p, const Answer *from, Answer *to) {
  memcpy(to->head, from->head, answer_size(p) * sizeof(double));
}

static double *noise_of(const double *given, int64_t count, const int rows, double factor, double *memory,
                        Noise *noise) {
  int64_t size = rows * rows, several = 0;
  for (int64_t k = 1; k < count && !several; k++)
    several = memcmp(given + size * k, given, size * sizeof(double)) != 0;
  int64_t each = several ? count : 1;
  double *covariance = memory, *inverse = memory + each * size;
  for (int64_t k = 0; k < each; k++) {
    for (int i = 0; i < rows; i++)
      for (int j = 0; j < rows; j++)
        covariance[size * k + rows * i + j] =
            given[size * k + rows * i + j] * (i < 3 ? factor : 1.0) * (j < 3 ? factor : 1.0);
    invert(covariance + size * k, rows, inverse + size * k);
  }
  noise->covariance = covariance;
  noise->inverse = inverse;
  noise->stride = several ? size : 0;
  noise->round = 1;
  for (int64_t k = 0; k < each * size; k++) {
    int64_t i = k % size / rows, j = k % size % rows, first = k - k % size + (i < 3 ? 0 : 3) * (rows + 1);
    noise->round &= covariance[k] == (i == j ? covariance[first] : 0.0);
  }
  return inverse + each * size;
}

/* Take errors of positions as larger; the last level is as they are. As Observations.softened. */
static void soften(Problem *p, int64_t level, double *memory) {
  double factor = level < p->softer ? p->softness[level] : 1.0;
  memory = noise_of(p->child_covariance, p->count, (int)p->rows, factor, memory, &p->of_child);
  if (!p->known) noise_of(p->parent_covariance, p->count, 6, factor, memory, &p->of_parent);
  /* Softened ones are precise too, but for the first two. */
  p->mirrored = p->softer && p->joints == 1 && size_of(p) && (level == p->softer || level > 1);
}

static void believe_as(Problem *p, const Head *head) {
  p->marginal = head->marginal > 0.0;
  p->belief = head->belief;
}

/* Take steps until they are small; returns whether they became so. What was found is in *here then. */
static int64_t settle(const Problem *p, Motion *now, Observation **here, Observation **there, int64_t steps,
                      double *best) {
  double damping = 0.0, before = 0.0;
  for (int64_t i = 0; i < steps && !look_at_clock(&watch); i++) {
    double gain = 0.0, trial = NAN;
    Motion next;
    if (move(p, now, *here, damping, &next, *there, &gain)) trial = look_at_all(p, &next, *there);
    if (!isfinite(trial)) {
      damping = damping > 1e-7 ? 10.0 * damping : 1e-6;
      if (damping > 1e8) return 0;
    } else if (trial <= *best + 1e-12 * fabs(*best)) {
      Observation *other = *here;
      *here = *there;
      *there = other;
      *now = next;
      *best = trial;
      damping = damping > 1e-6 ? 0.1 * damping : 0.0;
      if (gain < p->close || gain * gain < p->close * before) return 1;
      before = gain;
    } else if (gain < p->close) {
      return 1;
    } else {
      damping = damping > 1e-5 ? 10.0 * damping : 1e-4;
      if (damping > 1e8) return 0;
    }
  }
  return 0;
}

static void begin(const Problem *p, const double *values, const double *parents, Observation *all) {
  for (int64_t k = 0; k < p->count; k++) {
    for (int i = 0; i < 9; i++) all[k].parent_R[i] = parents[16 * k + 4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) all[k].parent_p[i] = parents[16 * k + 4 * i + 3];
    memcpy(all[k].values, values + p->joints * k, p->joints * sizeof(double));
  }
}

static void note_unknowns(const Problem *p, const Observation *found, double *values, double *parents) {
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = found + k;
    double *parent = parents + 16 * k;
    memcpy(values + p->joints * k, o->values, p->joints * sizeof(double));
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) parent[4 * i + j] = o->parent_R[3 * i + j];
      parent[4 * i + 3] = o->parent_p[i];
    }
    for (int j = 0; j < 4; j++) parent[12 + j] = j == 3;
  }
}

/* Leave in an answer what was found. */
static void note(const Problem *p, const Motion *m, double cost, int64_t converged, const Observation *found,
                 Answer *a) {
  int64_t joints = p->joints, rows = p->rows, size = size_of(p);
  a->head->motion = *m;
  a->head->cost = cost;
  a->head->converged = (double)converged;
  a->head->marginal = (double)p->marginal;
  a->head->belief = p->belief;
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = found + k;
    memcpy(a->residuals + rows * k, o->residual, rows * sizeof(double));
    memcpy(a->covariances + rows * rows * k, o->covariance, rows * rows * sizeof(double));
    keep(p, o, a->poses + 16 * k, a->by_parameters + rows * size * k, a->by_joints + rows * joints * k);
  }
  note_unknowns(p, found, a->values, a->parents);
}

/* From the best of several starts, after few steps of each, to where steps are small. Parents begin where
   the answer has them. */
static void solve_from(const Problem *p, int64_t starts, const Motion *motions, const double *values,
                       int64_t steps, Answer *a, double *memory) {
  int64_t count = p->count, converged = 0;
  Observation *here = (Observation *)memory, *there = here + count, *kept = there + count;
  Motion now;
  double best = INFINITY;
  for (int64_t i = 0; i < starts; i++) {
    Motion trial = motions[i];
    straighten(trial.left_R);
    straighten(trial.right_R);
    begin(p, values + i * count * p->joints, a->parents, here);
    double reached = look_at_all(p, &trial, here);
    int64_t done = starts > 1 ? settle(p, &trial, &here, &there, p->first_steps, &reached) : 0;
    if (i && !(reached < best)) continue;
    Observation *other = here;
    here = kept;
    kept = other;
    now = trial;
    best = reached;
    converged = done;
  }
  if (!converged) converged = settle(p, &now, &kept, &there, steps, &best);
  note(p, &now, best, converged, kept, a);
}

/* Go on from an answer, as it says what is believed. */
static void go_on(Problem *p, Answer *a, double *memory) {
  Motion from = a->head->motion;
  believe_as(p, a->head);
  solve_from(p, 1, &from, a->values, p->steps, a, memory);
}

/* Move joint values and parents of the last observations, which are new, with the motion as it is. */
static void settle_new(const Problem *p, Answer *a, double *memory) {
  int64_t first = p->count - p->fresh;
  Problem q = *p;
  q.count = p->fresh;
  q.lefts = q.rights = q.pitches = q.reach = 0;
  q.parent += 16 * first;
  q.child += 16 * first;
  q.of_parent.covariance += q.of_parent.stride * first;
  q.of_parent.inverse += q.of_parent.stride * first;
  q.of_child.covariance += q.of_child.stride * first;
  q.of_child.inverse += q.of_child.stride * first;
  Observation *here = (Observation *)memory, *there = here + q.count;
  double *values = a->values + q.joints * first, *parents = a->parents + 16 * first;
  Motion m = a->head->motion;
  begin(&q, values, parents, here);
  double cost = look_at_all(&q, &m, here);
  settle(&q, &m, &here, &there, q.steps, &cost);
  note_unknowns(&q, here, values, parents);
}
