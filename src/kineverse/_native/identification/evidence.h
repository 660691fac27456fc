/* Log evidence of a joint family by Laplace's approximation. */
#pragma once
#include "mirrored_values.h"

/* Unknowns are the parameters, the means of joint values, and a point that slides. */
#define ATOM 1e-10

/* Joint values, their covariances and the information, as observations and widths tell together. */
static void informed(const Problem *p, const Answer *a, const Apart *apart, double *values,
                     double *covariances, double *information) {
  int rows = (int)p->rows, joints = (int)p->joints, slides = (int)p->slides, size = (int)size_of(p);
  int n = size + joints + slides;
  const Motion *m = &a->head->motion;
  double total[UNKNOWNS * UNKNOWNS] = {0};
  Observation o;
  for (int64_t k = 0; k < p->count; k++) {
    const double *C = apart->covariances + joints * joints * k, *S = a->covariances + rows * rows * k;
    double W[36], moved[36], both[6 * UNKNOWNS] = {0}, weighted[6 * UNKNOWNS] = {0};
    if (joints) widened(C, joints, apart->deviations, W);
    for (int i = 0; i < joints; i++) {
      double square = apart->deviations[i] * apart->deviations[i], change = 0.0;
      for (int j = 0; j < joints; j++) {
        double sum = 0.0;
        for (int l = 0; l < joints; l++) sum += W[joints * i + l] * C[joints * l + j];
        covariances[joints * joints * k + joints * i + j] = square * sum;
        change += square * W[joints * i + j] * (apart->values[joints * k + j] - apart->mean[j]);
      }
      values[joints * k + i] = o.values[i] = apart->mean[i] + change;
    }
    place_one(p, m, &o);
    for (int r = 0; r < rows; r++) {
      for (int s = 0; s < rows; s++) {
        moved[rows * r + s] = S[rows * r + s];
        for (int j = 0; j < joints; j++) {
          const double *J = o.by_joints + 6 * j;
          moved[rows * r + s] += apart->deviations[j] * apart->deviations[j] * J[r] * J[s];
        }
      }
      for (int i = 0; i < size; i++) both[UNKNOWNS * r + i] = o.by_parameters[MOST * r + i];
      for (int j = 0; j < joints; j++) both[UNKNOWNS * r + size + j] = o.by_joints[6 * j + r];
    }
    if (slides) {
      double twist[6] = {0}, G[9], turned[9];
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = o.values[j];
      exponential(twist + 3, G);
      times33(m->left_R, G, turned);
      for (int r = 0; r < 3; r++)
        for (int i = 0; i < slides; i++) both[UNKNOWNS * r + size + joints + i] = turned[3 * r + i];
    }
    invert(moved, rows, W);
    for (int r = 0; r < rows; r++)
      for (int s = 0; s < rows; s++)
        for (int i = 0; i < UNKNOWNS; i++)
          weighted[UNKNOWNS * r + i] += W[rows * r + s] * both[UNKNOWNS * s + i];
    for (int i = 0; i < n; i++)
      for (int r = 0; r < rows; r++)
        for (int j = 0; j < UNKNOWNS; j++)
          total[UNKNOWNS * i + j] += both[UNKNOWNS * r + i] * weighted[UNKNOWNS * r + j];
  }
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) information[n * i + j] = p->weight * total[UNKNOWNS * i + j];
}

static int has(const int64_t *components, int64_t count, int64_t component) {
  for (int64_t i = 0; i < count; i++)
    if (components[i] == component) return 1;
  return 0;
}

static double of_lever(const double *lever, int64_t count, double scale) {
  double log_density = -0.5 * count * log(TAU * scale * scale);
  for (int64_t i = 0; i < count; i++) log_density -= 0.5 * lever[i] * lever[i] / (scale * scale);
  return log_density;
}

/* As GroupMotion.log_prior and .prior: the density, and the precision is added to the information. */
static double beforehand(const Problem *p, const Motion *m, const double *mean, double *information) {
  int joints = (int)p->joints, size = (int)size_of(p), rights = (int)p->rights;
  int n = size + joints + (int)p->slides, columns = rights + joints;
  double log_density = 0.0, normal[MOST * MOST] = {0}, right[MOST] = {0}, matrix[36], volume[6];
  if (has(p->left, p->lefts, 3)) log_density -= log(TAU);
  if (has(p->left, p->lefts, 0) && has(p->left, p->lefts, 1))
    log_density += of_lever(m->right_p, p->reach, p->reach_scale);
  log_density += of_lever(m->right_p, p->slides, p->reach_scale);
  if (p->pitches) log_density += of_lever(&m->pitch, 1, p->pitch_scale);
  Observation o;
  memcpy(o.values, mean, joints * sizeof(double));
  place_one(p, m, &o);
  for (int r = 0; r < p->rows; r++)
    for (int i = 0; i < columns; i++)
      matrix[columns * r + i] =
          i < rights ? o.by_parameters[MOST * r + p->lefts + i] : o.by_joints[6 * (i - rights) + r];
  singular_values(matrix, (int)p->rows, columns, volume);
  for (int i = 0; i < columns; i++) log_density += log(fmax(volume[i], ATOM));
  believe(p, m, normal, right);
  for (int i = 0; i < size; i++)
    for (int j = 0; j < size; j++) information[n * i + j] += normal[MOST * i + j];
  for (int i = 0; i < n; i++) {
    double turns = i < p->lefts ? p->left[i] >= 3 : i >= size && i < size + joints && p->joint[i - size] >= 3;
    information[(n + 1) * i] += i < size + joints ? turns : 1.0 / (p->reach_scale * p->reach_scale);
  }
  return log_density;
}

/* As laplace_evidence in marginal_likelihood.py. */
static double evidence(const Problem *p, const Answer *a, const Apart *apart, double *values,
                       double *covariances, double *information) {
  int n = (int)(size_of(p) + p->joints + p->slides);
  double copied[UNKNOWNS * UNKNOWNS], log_density = apart->log_likelihood + apart->log_density;
  informed(p, a, apart, values, covariances, information);
  log_density += beforehand(p, &a->head->motion, apart->mean, information) + 0.5 * n * log(TAU);
  memcpy(copied, information, n * n * sizeof(double));
  return log_density - 0.5 * log_volume(copied, n);
}

/* Its logarithm alone. */
static double log_evidence(const Problem *p, const Answer *a, const Apart *apart, double *memory) {
  double information[UNKNOWNS * UNKNOWNS];
  return evidence(p, a, apart, memory, memory + p->count * p->joints, information);
}

/* As evidence_excess in marginal_likelihood.py. */
static double overrated(const Problem *p, const Answer *a, const Apart *apart) {
  if (a->head->converged > 0.0 || !(a->head->marginal > 0.0)) return 0.0;
  int n = (int)p->joints;
  double deviations[6], W[36], off[6], promised = apart->log_likelihood;
  for (int i = 0; i < n; i++) deviations[i] = 1.0 / sqrt(a->head->belief.precision[i]);
  for (int64_t k = 0; k < p->count; k++) {
    double root = widened(apart->covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++) off[i] = apart->values[n * k + i] - a->head->belief.mean[i];
    promised -= 0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU);
  }
  double reached = a->head->cost - unlikely(p, &a->head->motion) + p->count * p->rows * log(TAU);
  return fmax(0.0, promised + 0.5 * reached);
}

/* Leave the logarithm of the evidence in an answer, with nothing that is not there. */
static void judge(const Problem *p, Answer *a, const Apart *apart, double *memory) {
  a->head->log_evidence = log_evidence(p, a, apart, memory) - overrated(p, a, apart);
}
