/* Mirrored joint values, at which the child has the same distance from the parent: choice of the more probable. */
#pragma once
#include "sliding_point.h"

#define ERRORS 9 /* of the way between both parts and of both orientations */

/* The lower factor of the covariance of these errors; returns the logarithm of its volume. */
static double errors_factor(const Problem *p, int64_t k, double *lower) {
  const double *A = p->of_parent.covariance + p->of_parent.stride * k;
  const double *B = p->of_child.covariance + p->of_child.stride * k;
  int rows = (int)p->rows, n = 3 + rows;
  memset(lower, 0, n * n * sizeof(double));
  for (int i = 0; i < 6; i++)
    for (int j = 0; j < 6; j++) lower[n * i + j] = (i < 3) == (j < 3) ? A[6 * i + j] : -A[6 * i + j];
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < rows; j++) lower[n * (i < 3 ? i : i + 3) + (j < 3 ? j : j + 3)] += B[rows * i + j];
  return log(factorise(lower, n));
}

/* The least turn before R that makes a lever point along a way. */
static void align(double *R, const double *lever, const double *way) {
  double pointing[3], normal[3], turned[9], whole[9], along = 0.0, sine = 0.0;
  apply(R, lever, pointing);
  cross(pointing, way, normal);
  for (int i = 0; i < 3; i++) {
    along += pointing[i] * way[i];
    sine += normal[i] * normal[i];
  }
  sine = sqrt(sine);
  for (int i = 0; i < 3; i++) normal[i] *= sine > 0.0 ? atan2(sine, along) / sine : 0.0;
  exponential(normal, turned);
  times33(turned, R, whole);
  memcpy(R, whole, sizeof whole);
}

/* s I + t [v]x */
static void beside(const double *v, double s, double t, double *to) {
  to[0] = to[4] = to[8] = s;
  to[1] = -t * v[2]; to[2] = t * v[1]; to[5] = -t * v[0];
  to[3] = t * v[2]; to[6] = -t * v[1]; to[7] = t * v[0];
}

/* Errors of an observation at a joint value and an orientation T of the parent, and their derivatives by a
   turn before T and by the joint value: ERRORS rows of 5 columns. */
static void errors_at(const Problem *p, const Motion *m, int64_t k, const double *T, Observation *o,
                      double *errors) {
  double A[9], B[9], way[3], turned[9], child[9], half[9], crossed[9], lever[3], moved[3], e[3];
  for (int i = 0; i < 9; i++) A[i] = p->parent[16 * k + 4 * (i / 3) + i % 3];
  for (int i = 0; i < 9; i++) B[i] = p->child[16 * k + 4 * (i / 3) + i % 3];
  for (int i = 0; i < 3; i++) way[i] = p->child[16 * k + 4 * i + 3] - p->parent[16 * k + 4 * i + 3];
  place_one(p, m, o);
  memset(errors, 0, 5 * ERRORS * sizeof(double));
  apply(T, o->lever, lever);
  apply(T, o->by_joints, moved);
  beside(lever, 0.0, 1.0, crossed);
  times_transposed33(A, T, turned);
  logarithm(turned, e);
  beside(e, 1.0, 0.5, half);
  for (int i = 0; i < 3; i++) {
    errors[5 * i + 4] = way[i] - lever[i];
    errors[5 * i + 3] = -moved[i];
    errors[5 * (3 + i) + 4] = e[i];
    for (int j = 0; j < 3; j++) {
      errors[5 * i + j] = crossed[3 * i + j];
      errors[5 * (3 + i) + j] = -half[3 * i + j];
    }
  }
  if (p->rows == 3) return;
  times_transposed33(B, o->H_R, child);
  times_transposed33(child, T, turned);
  logarithm(turned, e);
  beside(e, 1.0, 0.5, half);
  apply(T, o->by_joints + 3, lever);
  apply(half, lever, moved);
  for (int i = 0; i < 3; i++) {
    errors[5 * (6 + i) + 4] = e[i];
    errors[5 * (6 + i) + 3] = -moved[i];
    for (int j = 0; j < 3; j++) errors[5 * (6 + i) + j] = -half[3 * i + j];
  }
}

/* As evaluate_each_observation in joint_values.py, for one: joint value and orientation become the likeliest
   ones. Returns the logarithm of the density. */
static double single(const Problem *p, const Motion *m, int64_t k, const double *lower, double volume,
                     double *value, double *orientation) {
  int n = 3 + (int)p->rows;
  double best = -INFINITY, T[9], way[3], a = *value;
  Observation o;
  memcpy(T, orientation, sizeof T);
  for (int i = 0; i < 3; i++) way[i] = p->child[16 * k + 4 * i + 3] - p->parent[16 * k + 4 * i + 3];
  o.values[0] = a;
  place_one(p, m, &o);
  align(T, o.lever, way);
  memcpy(orientation, T, sizeof T);
  for (int64_t turn = 0; turn < p->mirrored_steps; turn++) {
    double by[5 * ERRORS], normal[16] = {0}, step[4] = {0}, squares = 0.0, turned[9], whole[9];
    o.values[0] = a;
    errors_at(p, m, k, T, &o, by);
    for (int i = 0; i < n; i++)
      for (int c = 0; c < 5; c++) {
        for (int j = 0; j < i; j++) by[5 * i + c] -= lower[n * i + j] * by[5 * j + c];
        by[5 * i + c] *= lower[(n + 1) * i];
      }
    for (int r = 0; r < n; r++) {
      const double *row = by + 5 * r;
      squares += row[4] * row[4];
      for (int i = 0; i < 4; i++) {
        step[i] -= row[i] * row[4];
        for (int j = 0; j < 4; j++) normal[4 * i + j] += row[i] * row[j];
      }
    }
    double precision = p->belief.precision[0], off = a - p->belief.mean[0];
    normal[15] += precision;
    step[3] -= precision * off;
    double root = factorise(normal, 4);
    double log_density =
        -0.5 * (squares + precision * off * off) - volume - log(root) - 0.5 * log(precision);
    if (log_density > best) {
      best = log_density;
      *value = a;
      memcpy(orientation, T, sizeof T);
    }
    resolve(normal, 4, step);
    exponential(step, turned);
    times33(turned, T, whole);
    memcpy(T, whole, sizeof T);
    double d = step[3];
    if (p->joint[0] >= 3) d = d > 0.5 ? 0.5 : d < -0.5 ? -0.5 : d;
    a += d;
  }
  return best;
}

/* The other joint value at which the child is as far from the parent. */
static double other_value(const Problem *p, const Motion *m, double value) {
  double parent[3];
  apply_transposed(m->left_R, m->left_p, parent);
  if (p->joint[0] < 5) return 2.0 * (-parent[2] - m->right_p[2]) - value;
  double towards = atan2(-parent[1], -parent[0]) - atan2(m->right_p[1], m->right_p[0]);
  double other = 2.0 * towards - value;
  return other - TAU * rint((other - p->belief.mean[0]) / TAU);
}

/* As choose_mirrored_values in joint_values.py. */
static void exchange(Problem *p, Answer *a, double *memory) {
  if (!p->mirrored) return;
  Answer trial;
  memory = lay(p, memory, &trial);
  for (int64_t turn = 0; turn < p->mirrored_turns; turn++) {
    const Motion *m = &a->head->motion;
    double lower[ERRORS * ERRORS], volume = 0.0;
    int exchanged = 0;
    copy(p, a, &trial);
    for (int64_t k = 0; k < p->count; k++) {
      if (!k || p->of_parent.stride || p->of_child.stride) volume = errors_factor(p, k, lower);
      double here = a->values[k], there = other_value(p, m, here), one[9], other[9];
      for (int i = 0; i < 9; i++) one[i] = other[i] = a->parents[16 * k + 4 * (i / 3) + i % 3];
      double log_here = single(p, m, k, lower, volume, &here, one);
      if (!(single(p, m, k, lower, volume, &there, other) > log_here + p->better)) continue;
      exchanged = 1;
      trial.values[k] = there;
      for (int i = 0; i < 9; i++) trial.parents[16 * k + 4 * (i / 3) + i % 3] = other[i];
    }
    if (!exchanged) return;
    go_on(p, &trial, memory);
    if (!(trial.head->cost < a->head->cost)) return;
    copy(p, &trial, a);
  }
}
