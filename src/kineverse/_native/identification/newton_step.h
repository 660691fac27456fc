/* Levenberg-Marquardt step of the parameters, with the joint values eliminated. */
#pragma once
#include "log_determinant_gradient.h"

static void advance(const Problem *p, const Motion *m, const double *step, Motion *to) {
  double l[6] = {0}, r[6] = {0}, turned[9], moved[3];
  for (int i = 0; i < p->lefts; i++) l[p->left[i]] = step[i];
  for (int i = 0; i < p->rights; i++) r[p->right[i]] = step[p->lefts + i];
  to->pitch = m->pitch + (p->pitches ? step[p->lefts + p->rights] : 0.0);
  exponential(l + 3, turned);
  times33(m->left_R, turned, to->left_R);
  apply(m->left_R, l, moved);
  for (int i = 0; i < 3; i++) to->left_p[i] = m->left_p[i] + moved[i];
  exponential(r + 3, turned);
  times33(turned, m->right_R, to->right_R);
  apply(turned, m->right_p, moved);
  for (int i = 0; i < 3; i++) to->right_p[i] = moved[i] + r[i];
}

/* Eliminate the joint values of an observation: W - W J_a (J_a' W J_a + P)^-1 J_a' W is what is left. */
INLINE int eliminate(const Problem *p, Observation *o, double damping, double *left, const int rows) {
  int joints = (int)p->joints;
  for (int i = 0; i < rows * rows; i++) left[i] = o->weights[i];
  if (!joints) return 1;
  double curvature[36];
  for (int i = 0; i < joints * joints; i++) curvature[i] = o->curvature[i];
  for (int i = 0; i < joints; i++)
    curvature[(joints + 1) * i] += p->belief.precision[i] + damping * curvature[(joints + 1) * i];
  if (joints == 1) {
    if (!(curvature[0] > 0.0)) return 0;
    o->inverse[0] = 1.0 / curvature[0];
  } else if (invert(curvature, joints, o->inverse) == 0.0) return 0;
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

/* Add what one observation says about the parameters. */
INLINE void gather(const Problem *p, Observation *o, const double *left, double *normal, double *right,
                   const int rows) {
  int joints = (int)p->joints, n = (int)size_of(p);
  double pushed[6], rotated[6 * MOST];
  for (int r = 0; r < rows; r++) {
    pushed[r] = 0.0;
    for (int s = 0; s < rows; s++) pushed[r] += o->weights[rows * r + s] * o->residual[s];
  }
  for (int i = 0; i < joints; i++) {
    o->slope[i] = -p->belief.precision[i] * (o->values[i] - p->belief.mean[i]);
    for (int r = 0; r < rows; r++) o->slope[i] += o->weighted[6 * i + r] * o->residual[r];
  }
  for (int i = 0; i < joints; i++)
    for (int r = 0; r < rows; r++) pushed[r] -= o->gains[6 * i + r] * o->slope[i];
  for (int r = 0; r < rows; r++)
    for (int i = 0; i < MOST; i++) {
      double sum = 0.0;
      for (int s = 0; s < rows; s++) sum += left[rows * r + s] * o->by_parameters[s * MOST + i];
      rotated[r * MOST + i] = sum;
    }
  for (int r = 0; r < rows; r++)
    for (int i = 0; i < MOST; i++) right[i] += o->by_parameters[r * MOST + i] * pushed[r];
  for (int i = 0; i < n; i++)
    for (int r = 0; r < rows; r++) {
      double by = o->by_parameters[r * MOST + i];
      for (int j = 0; j < MOST; j++) normal[MOST * i + j] += by * rotated[r * MOST + j];
    }
}

/* Beforehand levers are within reach, and pitches ordinary. */
static void believe(const Problem *p, const Motion *m, double *normal, double *right) {
  int n = (int)size_of(p);
  double scale = 1.0 / (p->reach_scale * p->reach_scale);
  for (int i = 0; i < p->reach; i++) {
    double row[MOST] = {0};
    for (int j = 0; j < p->rights; j++) {
      int64_t c = p->right[j];
      double unit[3] = {0}, moved[3];
      if (c >= 3) {
        unit[c - 3] = 1.0;
        cross(unit, m->right_p, moved);
        row[p->lefts + j] = moved[i];
      } else row[p->lefts + j] = c == i;
    }
    for (int j = 0; j < n; j++) {
      right[j] -= scale * row[j] * m->right_p[i];
      for (int l = 0; l < n; l++) normal[MOST * j + l] += scale * row[j] * row[l];
    }
  }
  if (!p->pitches) return;
  scale = 1.0 / (p->pitch_scale * p->pitch_scale);
  right[n - 1] -= scale * m->pitch;
  normal[(MOST + 1) * (n - 1)] += scale;
}

/* Move joint value and parent of an observation as a step of the parameters tells; returns the gain. */
INLINE double follow(const Problem *p, const Observation *o, const double *step, Observation *q,
                     const int rows) {
  int joints = (int)p->joints, n = (int)size_of(p);
  double left[6], gain = 0.0;
  for (int r = 0; r < rows; r++) {
    left[r] = o->residual[r];
    for (int i = 0; i < n; i++) left[r] -= o->by_parameters[r * MOST + i] * step[i];
  }
  double change[6] = {0}, back[6];
  for (int i = 0; i < joints; i++) {
    back[i] = -p->belief.precision[i] * (o->values[i] - p->belief.mean[i]);
    for (int r = 0; r < rows; r++) back[i] += o->weighted[6 * i + r] * left[r];
  }
  for (int i = 0; i < joints; i++)
    for (int j = 0; j < joints; j++) {
      change[i] += o->inverse[joints * i + j] * back[j];
      gain += o->slope[i] * o->inverse[joints * i + j] * o->slope[j];
    }
  for (int i = 0; i < joints; i++) {
    double d = change[i];
    for (int r = 0; r < rows; r++) left[r] -= o->by_joints[6 * i + r] * d;
    if (p->joint[i] >= 3) d = d > 0.5 ? 0.5 : d < -0.5 ? -0.5 : d;
    q->values[i] = o->values[i] + d;
  }
  memcpy(q->parent_R, o->parent_R, sizeof o->parent_R);
  memcpy(q->parent_p, o->parent_p, sizeof o->parent_p);
  if (p->known) return gain;
  /* ε = e_A + Σ_A Mᵀ W rest */
  double rest[6] = {0}, carried[6], moved[3], error[6], R[9];
  for (int r = 0; r < rows; r++)
    for (int s = 0; s < rows; s++) rest[r] += o->weights[rows * r + s] * left[s];
  cross(o->lever, rest, moved);
  for (int i = 0; i < 3; i++) {
    carried[i] = rest[i];
    carried[3 + i] = moved[i] + rest[3 + i];
  }
  for (int i = 0; i < 6; i++) {
    error[i] = o->own[i];
    for (int j = 0; j < 6; j++) error[i] += o->of_parent[6 * i + j] * carried[j];
    gain += error[i] * error[i] / o->of_parent[7 * i];
  }
  exponential(error + 3, R);
  times33(o->parent_R, R, q->parent_R);
  apply(o->parent_R, error, moved);
  for (int i = 0; i < 3; i++) q->parent_p[i] = o->parent_p[i] + moved[i];
  return gain;
}

INLINE int move_rows(const Problem *p, const Motion *m, Observation *all, double damping, Motion *to,
                     Observation *next, double *gain, const int rows) {
  int n = (int)size_of(p);
  double normal[MOST * MOST] = {0}, right[MOST] = {0}, step[MOST] = {0}, packed[MOST * MOST], left[36];
  for (int64_t k = 0; k < p->count; k++) {
    Observation *o = all + k;
    if (p->marginal) {
      if (!eliminate(p, o, 0.0, left, rows)) return 0;
      widen(p, m, o, left, right, rows);
    }
    if (!p->marginal || damping > 0.0)
      if (!eliminate(p, o, damping, left, rows)) return 0;
    gather(p, o, left, normal, right, rows);
  }
  believe(p, m, normal, right);
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) packed[n * i + j] = normal[MOST * i + j] * (i == j ? 1.0 + damping : 1.0);
  memcpy(step, right, n * sizeof(double));
  if (factorise(packed, n) == 0.0) return 0;
  resolve(packed, n, step);
  *gain = 0.0;
  for (int i = 0; i < n; i++) *gain += step[i] * right[i];
  for (int64_t k = 0; k < p->count; k++) *gain += follow(p, all + k, step, next + k, rows);
  advance(p, m, step, to);
  return 1;
}

/* Where a step leads; 0 if there is none. */
static int move(const Problem *p, const Motion *m, Observation *all, double damping, Motion *to,
                Observation *next, double *gain) {
  return p->rows == 6 ? move_rows(p, m, all, damping, to, next, gain, 6)
                      : move_rows(p, m, all, damping, to, next, gain, 3);
}
