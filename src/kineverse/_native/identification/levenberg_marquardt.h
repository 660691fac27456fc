/* Levenberg-Marquardt iteration of the parameters and joint values of a joint. */
#pragma once
#include "../interruption.h"
#include "linearisation.h"

/* Levenberg-Marquardt step of the parameters, with the joint values eliminated. */

/* Eliminate the joint values of an observation: W - W J_a (J_a' W J_a + P)^-1 J_a' W is what is left. */
INLINE int eliminate(const Problem *p, Observation *o, double damping, double *left, const int rows) {
  int joints = (int)p->joints;
  for (int i = 0; i < rows * rows; i++) left[i] = o->weights[i];
  if (!joints) return 1;
  double curvature[36];
  for (int i = 0; i < joints * joints; i++) curvature[i] = o->curvature[i];
  for (int i = 0; i < joints; i++)
    curvature[(joints + 1) * i] += p->precision[i] + damping * curvature[(joints + 1) * i];
  if (invert(curvature, joints, o->inverse) == 0.0) return 0;
  for (int i = 0; i < joints; i++) {
    double *gains = o->gains + 6 * i;
    for (int r = 0; r < rows; r++) gains[r] = 0.0;
    for (int j = 0; j < joints; j++)
      for (int r = 0; r < rows; r++) gains[r] += o->inverse[joints * i + j] * o->weighted[6 * j + r];
    for (int r = 0; r < rows; r++)
      for (int s = 0; s < rows; s++) left[rows * r + s] -= o->weighted[6 * i + r] * gains[s];
  }
  return 1;
}

/* Take half the slope of log |T| of one observation off the right side, T = S + J_a P^-1 J_a'.

   With Π = T^-1 and the gains G = P^-1 J_a' Π, d log |T| = tr(Π dS) + 2 tr(G dJ_a). S depends on the lever h of
   the parent alone, tr(Π dS) = 2 q·dh. Joint values follow the parameters by the gains. */
INLINE void widen(const Problem *p, const double *x, const Observation *o, const double *left, double *right,
                  const int rows) {
  double input[STATES + ALL + 6 * ALL + 3], output[STEPS + ALL], *V = fill(p, x, o->values, input);
  double *q = V + 6 * p->all_joints;
  memset(V, 0, (6 * p->all_joints + 3) * sizeof(double));
  for (int64_t j = 0; j < p->joints; j++)
    memcpy(V + 6 * p->joint[j], o->gains + 6 * j, rows * sizeof(double));
  if (p->parent_covariance) {
    /* The lower left of Σ_A Mᵀ Π, where Mᵀ Π is Π with [h]x times its upper rows added to the lower. */
    const double h[3] = {o->H[3], o->H[7], o->H[11]};
    double Q[9];
    for (int s = 0; s < 3; s++) {
      double above[3] = {left[s], left[rows + s], left[2 * rows + s]}, below[3];
      cross(h, above, below);
      for (int i = 0; i < 3; i++) {
        Q[3 * i + s] = 0.0;
        for (int r = 0; r < rows; r++) Q[3 * i + s] += o->of_parent[6 * (3 + i) + r] * left[rows * r + s];
        for (int r = 0; r < 3; r++) Q[3 * i + s] += o->of_parent[6 * (3 + i) + 3 + r] * below[r];
      }
    }
    q[0] = Q[7] - Q[5];
    q[1] = Q[2] - Q[6];
    q[2] = Q[3] - Q[1];
  }
  call(p->slope, input, output);
  for (int64_t i = 0; i < p->size; i++) {
    right[i] -= output[p->parameter[i]];
    for (int64_t j = 0; j < p->joints; j++)
      for (int r = 0; r < rows; r++)
        right[i] += output[p->steps + p->joint[j]] * o->gains[6 * j + r] * o->by_parameters[MOST * r + i];
  }
}

/* Add what one observation says about the parameters. */
INLINE void gather(const Problem *p, Observation *o, const double *left, double *normal, double *right,
                   const int rows) {
  int joints = (int)p->joints, n = (int)p->size;
  double pushed[6], rotated[6 * MOST];
  for (int r = 0; r < rows; r++) {
    pushed[r] = 0.0;
    for (int s = 0; s < rows; s++) pushed[r] += o->weights[rows * r + s] * o->residual[s];
  }
  for (int i = 0; i < joints; i++) {
    o->slope[i] = -p->precision[i] * (o->values[i] - p->mean[i]);
    for (int r = 0; r < rows; r++) o->slope[i] += o->weighted[6 * i + r] * o->residual[r];
    for (int r = 0; r < rows; r++) pushed[r] -= o->gains[6 * i + r] * o->slope[i];
  }
  for (int r = 0; r < rows; r++)
    for (int i = 0; i < MOST; i++) {
      double sum = 0.0;
      for (int s = 0; s < rows; s++) sum += left[rows * r + s] * o->by_parameters[s * MOST + i];
      rotated[r * MOST + i] = sum;
      right[i] += o->by_parameters[r * MOST + i] * pushed[r];
    }
  for (int i = 0; i < n; i++)
    for (int r = 0; r < rows; r++) {
      double by = o->by_parameters[r * MOST + i];
      for (int j = 0; j < MOST; j++) normal[MOST * i + j] += by * rotated[r * MOST + j];
    }
}

/* Move joint values and parent of an observation as a step of the parameters tells; returns the gain. */
INLINE double follow(const Problem *p, const Observation *o, const double *step, Observation *q,
                     const int rows) {
  int joints = (int)p->joints, n = (int)p->size;
  double left[6], gain = 0.0, back[6];
  for (int r = 0; r < rows; r++) {
    left[r] = o->residual[r];
    for (int i = 0; i < n; i++) left[r] -= o->by_parameters[r * MOST + i] * step[i];
  }
  for (int i = 0; i < joints; i++) {
    back[i] = -p->precision[i] * (o->values[i] - p->mean[i]);
    for (int r = 0; r < rows; r++) back[i] += o->weighted[6 * i + r] * left[r];
  }
  for (int i = 0; i < joints; i++) {
    double change = 0.0;
    for (int j = 0; j < joints; j++) {
      change += o->inverse[joints * i + j] * back[j];
      gain += o->slope[i] * o->inverse[joints * i + j] * o->slope[j];
    }
    for (int r = 0; r < rows; r++) left[r] -= o->by_joints[6 * i + r] * change;
    change = fmin(fmax(change, -p->largest[i]), p->largest[i]);
    q->values[i] = fmin(fmax(o->values[i] + change, p->lower[i]), p->upper[i]);
  }
  memcpy(q->parent, o->parent, sizeof o->parent);
  if (!p->parent_covariance) return gain;
  /* ε = e_A + Σ_A Mᵀ W rest */
  double rest[6] = {0}, carried[6], input[18];
  for (int r = 0; r < rows; r++)
    for (int s = 0; s < rows; s++) rest[r] += o->weights[rows * r + s] * left[s];
  const double h[3] = {o->H[3], o->H[7], o->H[11]};
  cross(h, rest, carried + 3);
  for (int i = 0; i < 3; i++) {
    carried[i] = rest[i];
    carried[3 + i] += rest[3 + i];
  }
  memcpy(input, o->parent, 12 * sizeof(double));
  for (int i = 0; i < 6; i++) {
    double error = o->own[i];
    for (int j = 0; j < 6; j++) error += o->of_parent[6 * i + j] * carried[j];
    gain += error * error / o->of_parent[7 * i];
    input[12 + i] = error;
  }
  call(p->turn_parent, input, q->parent);
  return gain;
}

INLINE int move_rows(const Problem *p, const double *x, Observation *all, double damping, double *to,
                     Observation *next, double *gain, const int rows) {
  int n = (int)p->size;
  double normal[MOST * MOST] = {0}, right[MOST] = {0}, step[MOST], packed[MOST * MOST], left[36];
  for (int64_t k = 0; k < p->count; k++) {
    Observation *o = all + k;
    if (p->marginal && n) {
      if (!eliminate(p, o, 0.0, left, rows)) return 0;
      widen(p, x, o, left, right, rows);
    }
    if (!(p->marginal && n) || damping > 0.0)
      if (!eliminate(p, o, damping, left, rows)) return 0;
    gather(p, o, left, normal, right, rows);
  }
  believe(p, x, normal, right);
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) packed[n * i + j] = normal[MOST * i + j] * (i == j ? 1.0 + damping : 1.0);
  memcpy(step, right, sizeof step);
  if (factorise(packed, n) == 0.0) return 0;
  resolve(packed, n, step);
  *gain = 0.0;
  for (int i = 0; i < n; i++) *gain += step[i] * right[i];
  for (int64_t k = 0; k < p->count; k++) *gain += follow(p, all + k, step, next + k, rows);
  double input[STATES + STEPS] = {0};
  memcpy(input, x, p->states * sizeof(double));
  memcpy(to, x, p->states * sizeof(double));
  for (int i = 0; i < n; i++) input[p->states + p->parameter[i]] = step[i];
  if (n) call(p->retract, input, to);
  return 1;
}

/* Where a step leads; 0 if there is none. */
static int move(const Problem *p, const double *x, Observation *all, double damping, double *to,
                Observation *next, double *gain) {
  return p->rows == 6 ? move_rows(p, x, all, damping, to, next, gain, 6)
                      : move_rows(p, x, all, damping, to, next, gain, 3);
}

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
