/* Joint values of each observation, the ranges of their values, and the information of the parameters. */
#pragma once
#include "levenberg_marquardt.h"

/* PerObservation and JointRanges in joint_values.py. */
typedef struct {
  double *values, *covariances, log_likelihood, deviations[6], mean[6], log_density;
} Apart;

/* As solve_per_observation in joint_values.py. */
static void alone(const Problem *p, const double *joint_values, const double *residuals, const double *errors,
                  const double *by_joints, Apart *apart) {
  int m = (int)p->rows, n = (int)p->joints;
  double log_likelihood = 0.0, *values = apart->values, *covariances = apart->covariances;
  memcpy(values, joint_values, p->count * n * sizeof(double));
  for (int64_t k = 0; k < p->count; k++) {
    const double *J = by_joints + m * n * k, *e = residuals + m * k;
    double W[36], weighted[36], curvature[36], slope[6], left[6], *C = covariances + n * n * k;
    double root = invert(errors + m * m * k, m, W);
    for (int i = 0; i < n; i++) {
      slope[i] = 0.0;
      for (int r = 0; r < m; r++) {
        double sum = 0.0;
        for (int s = 0; s < m; s++) sum += W[m * r + s] * J[n * s + i];
        weighted[m * i + r] = sum;
        slope[i] += sum * e[r];
      }
    }
    for (int i = 0; i < n; i++)
      for (int j = 0; j < n; j++) {
        double sum = i == j ? p->little : 0.0;
        for (int r = 0; r < m; r++) sum += weighted[m * i + r] * J[n * r + j];
        curvature[n * i + j] = sum;
      }
    double known = n ? invert(curvature, n, C) : 1.0;
    for (int r = 0; r < m; r++) left[r] = e[r];
    for (int i = 0; i < n; i++) {
      double change = 0.0;
      for (int j = 0; j < n; j++) change += C[n * i + j] * slope[j];
      values[n * k + i] += change;
      for (int r = 0; r < m; r++) left[r] -= J[n * r + i] * change;
    }
    /* |C| is one over the square of the root that is known. */
    log_likelihood -= 0.5 * squared(left, W, m) + log(root * known) + 0.5 * (m - n) * log(TAU);
  }
  apart->log_likelihood = log_likelihood;
}

/* The log of the density of values around 0 at a width, with their mean integrated out. */
static double density(int64_t count, const double *values, const double *variances, double width,
                      double observation_weight) {
  double s0 = 0.0, s1 = 0.0, s2 = 0.0, product = 1.0, logs = 0.0;
  for (int64_t i = 0; i < count; i++) {
    double weight = 1.0 / (variances[i] + width * width), pulled = weight * values[i];
    s0 += weight;
    s1 += pulled;
    s2 += pulled * values[i];
    product *= weight;
    if (i % 8 == 7) { /* so many are far from what a double can hold */
      logs += log(product);
      product = 1.0;
    }
  }
  logs += log(product);
  return 0.5 * (observation_weight * (logs - (s2 - s1 * s1 / s0)) - log(s0));
}

/* The best width of several columns of values, and the logarithm of the mean over all of them relative to the
   best. */
static double widest(const Problem *p, double weight, int64_t columns, const double *values, const double *variances,
                     double *logs, double *deviation) {
  int64_t top = 0, count = p->count;
  double sum = 0.0, best;
  for (int64_t g = 0; g < p->widths; g++) {
    logs[g] = 0.0;
    for (int64_t c = 0; c < columns; c++)
      logs[g] += density(count, values + count * c, variances + count * c, p->grid[g], weight);
    if (logs[g] > logs[top]) top = g;
  }
  best = log(p->grid[top]);
  if (top > 0 && top < p->widths - 1) {
    double before = logs[top - 1], here = logs[top], after = logs[top + 1];
    best += 0.5 * log(p->grid[1] / p->grid[0]) * (after - before) / (2.0 * here - before - after);
  }
  *deviation = exp(best);
  for (int64_t g = 0; g < p->widths; g++) sum += exp(logs[g] - logs[top]);
  return log(sum / p->widths);
}

/* The inverse of C + diag(s^2); returns the root of the determinant. */
INLINE double widened(const double *covariance, int n, const double *deviations, double *inverse) {
  double total[36];
  for (int i = 0; i < n * n; i++) total[i] = covariance[i];
  for (int i = 0; i < n; i++) total[(n + 1) * i] += deviations[i] * deviations[i];
  return invert(total, n, inverse);
}

/* As fit_joint_ranges in joint_values.py. */
static void widths(const Problem *p, double weight, Apart *apart, double *memory) {
  int n = (int)p->joints;
  const double *values = apart->values, *covariances = apart->covariances;
  double *deviations = apart->deviations, *mean = apart->mean;
  int64_t count = p->count;
  double result = 0.0, normal[36] = {0}, right[6] = {0}, inverse[36], W[36];
  double *variances = memory + count * n, *logs = variances + count * n;
  for (int64_t kind = 0; kind < ALL; kind++) {
    int64_t columns = 0;
    double width;
    for (int j = 0; j < n; j++) {
      if (p->kind[j] != kind) continue;
      double *column = memory + count * columns, *variance = variances + count * columns++, middle = 0.0;
      for (int64_t k = 0; k < count; k++) middle += values[n * k + j] / count;
      for (int64_t k = 0; k < count; k++) {
        column[k] = values[n * k + j] - middle;
        variance[k] = covariances[n * n * k + (n + 1) * j];
      }
    }
    if (!columns) continue;
    result += widest(p, weight, columns, memory, variances, logs, &width);
    for (int j = 0; j < n; j++)
      if (p->kind[j] == kind) deviations[j] = width;
  }
  for (int64_t k = 0; k < count; k++) {
    widened(covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++)
      for (int j = 0; j < n; j++) {
        normal[n * i + j] += W[n * i + j];
        right[i] += W[n * i + j] * (values[n * k + j] - values[j]);
      }
  }
  invert(normal, n, inverse);
  for (int i = 0; i < n; i++) {
    mean[i] = values[i];
    for (int j = 0; j < n; j++) mean[i] += inverse[n * i + j] * right[j];
  }
  for (int64_t k = 0; k < count; k++) {
    double off[6], root = widened(covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++) off[i] = values[n * k + i] - mean[i];
    result -= weight * (0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU));
  }
  apart->log_density = result;
}

