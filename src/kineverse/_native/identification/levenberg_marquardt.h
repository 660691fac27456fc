/* Levenberg-Marquardt iteration of the parameters and joint values of a joint. */
#pragma once
#include "../interruption.h"
#include "newton_step.h"

/* Stages end early if a handler of signals has raised an exception; then nobody looks at the answer. */
static _Thread_local Watch watch;

/* A solution as Python has it, in one memory: state, arrays of the observations, and its integral. */
typedef struct {
  double *cost, *converged, *x, *values, *parents, *residuals, *covariances, *poses, *by_parameters,
      *by_joints, *integral;
} Answer;

static Answer lay(const Problem *p, double *memory) {
  int64_t rows = p->rows;
  Answer a = {.cost = memory, .converged = memory + 1, .x = memory + 2};
  a.values = a.x + p->states;
  a.parents = a.values + p->count * p->joints;
  a.residuals = a.parents + p->count * 16;
  a.covariances = a.residuals + p->count * rows;
  a.poses = a.covariances + p->count * rows * rows;
  a.by_parameters = a.poses + p->count * 16;
  a.by_joints = a.by_parameters + p->count * rows * p->size;
  a.integral = a.by_joints + p->count * rows * p->joints;
  return a;
}

/* Covariances as the steps use them, with their inverses, in some memory; returns what is behind it. */
static double *prepare(const double *given, int64_t count, int64_t rows, double *memory, Noise *noise) {
  int64_t size = rows * rows, several = 0;
  if (!given) return memory;
  *noise = (Noise){given, memory, 0, 1};
  for (int64_t k = 1; k < count && !several; k++)
    several = memcmp(given + size * k, given, size * sizeof(double)) != 0;
  if (several) noise->stride = size;
  for (int64_t k = 0; k < (several ? count : 1); k++) {
    invert(given + size * k, (int)rows, memory);
    memory += size;
    for (int64_t i = 0; i < size; i++) {
      int64_t row = i / rows, first = row < 3 ? 0 : 3 * (rows + 1);
      noise->round &= given[size * k + i] == (row == i % rows ? given[size * k + first] : 0.0);
    }
  }
  return memory;
}

/* Take steps until they are small; returns whether they became so. What was found is in *here then. */
static int settle(const Problem *p, double *x, Observation **here, Observation **there, int64_t steps,
                  double *best) {
  double damping = 0.0, before = 0.0, next[STATES];
  *best = look_at_all(p, x, *here);
  for (int64_t i = 0; i < steps && !look_at_clock(&watch); i++) {
    double gain = 0.0, trial = NAN;
    if (move(p, x, *here, damping, next, *there, &gain)) trial = look_at_all(p, next, *there);
    if (trial <= *best + 1e-12 * fabs(*best)) {
      Observation *other = *here;
      *here = *there;
      *there = other;
      memcpy(x, next, p->states * sizeof(double));
      *best = trial;
      damping = damping > 1e-6 ? 0.1 * damping : 0.0;
      if (gain < p->close || gain * gain < p->close * before) return 1;
      before = gain;
    } else if (isfinite(trial) && gain < p->close) {
      return 1;
    } else {
      damping = fmax(10.0 * damping, isfinite(trial) ? 1e-4 : 1e-6);
      if (damping > 1e8) return 0;
    }
  }
  return 0;
}
