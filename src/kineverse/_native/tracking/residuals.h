/* Residuals of measured poses and values. */
#pragma once
#include "process_model.h"

/* Axis times angle of a rotation: of four formulas for its quaternion the one with the largest divisor. */
static void logarithm(const double r[9], double v[3]) {
  const double sine[3] = {r[7] - r[5], r[2] - r[6], r[3] - r[1]}, trace = r[0] + r[4] + r[8];
  const double square[4] = {1 + 2 * r[0] - trace, 1 + 2 * r[4] - trace, 1 + 2 * r[8] - trace, 1 + trace};
  int best = 0;
  for (int i = 1; i < 4; i++)
    if (square[i] > square[best]) best = i;
  double w = best == 3 ? square[3] : sine[best];
  for (int i = 0; i < 3; i++)
    v[i] = best == 3 ? sine[i] : i == best ? square[i] : r[3 * i + best] + r[3 * best + i];
  if (w < 0.0) {
    w = -w;
    for (int i = 0; i < 3; i++) v[i] = -v[i];
  }
  const double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  const double scale = length > 1e-9 * w ? 2.0 * atan2(length, w) / length : 2.0 / (w > 0.0 ? w : 1.0);
  for (int i = 0; i < 3; i++) v[i] *= scale;
}

enum { GAUSSIAN, CAUCHY, MIXTURE };

/* Weight of a residual, and its cost: the negative log density. */
static double weigh(const Problem *p, int64_t i, int loss, double log_inlier, double square, double *cost) {
  const double size = (double)p->size[i];
  *cost = square / 2;
  if (loss == GAUSSIAN || !isfinite(square)) return 1.0;
  if (loss == CAUCHY) {
    *cost = (1 + size) / 2 * log1p(square);
    return (1 + size) / (1 + square);
  }
  const double inlier = log_inlier - square / 2, outlier = p->outlier[i];
  const double total = fmax(inlier, outlier) + log1p(exp(-fabs(inlier - outlier)));
  *cost = -total;
  return exp(inlier - total);
}

/* Add one weighted observation to the lower triangle of a matrix and to a vector; return its cost. */
static double add(const Problem *p, int64_t i, int n, int loss, double log_inlier, double *matrix,
                  double *vector, double *residual, double *weight) {
  const int d = (int)p->size[i];
  const double *value = p->output + p->value[i], *slope = p->output + p->slope[i];
  const double *z = p->numbers + p->seen[i], *white = p->whitening + p->white[i];
  double error[WIDE], whitened[WIDE], turned[3 * MOST], rows[WIDE * MOST];
  if (p->is_pose[i]) {
    double relative[9], v[3];
    for (int a = 0; a < 3; a++)
      for (int b = 0; b < 3; b++)
        relative[3 * a + b] =
            z[4 * a] * value[3 * b] + z[4 * a + 1] * value[3 * b + 1] + z[4 * a + 2] * value[3 * b + 2];
    logarithm(relative, v);
    for (int a = 0; a < 3; a++) error[a] = z[4 * a + 3] - value[9 + a], error[3 + a] = v[a];
    const double squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], angle = sqrt(squared);
    const double factor =
        angle > 0.02 ? (1 - angle / 2 / tan(angle / 2)) / squared : 1.0 / 12 + squared / 720;
    /* Jr⁻¹ a = a + ½ v × a + factor v × (v × a) */
    for (int c = 0; c < n; c++) {
      const double a[3] = {slope[3 * n + c], slope[4 * n + c], slope[5 * n + c]};
      const double once[3] = {v[1] * a[2] - v[2] * a[1], v[2] * a[0] - v[0] * a[2],
                              v[0] * a[1] - v[1] * a[0]};
      const double twice[3] = {v[1] * once[2] - v[2] * once[1], v[2] * once[0] - v[0] * once[2],
                               v[0] * once[1] - v[1] * once[0]};
      for (int k = 0; k < 3; k++) turned[k * n + c] = a[k] + once[k] / 2 + factor * twice[k];
    }
  } else {
    for (int a = 0; a < d; a++) {
      error[a] = z[a] - value[a];
      if (isfinite(p->period[i])) error[a] -= p->period[i] * rint(error[a] / p->period[i]);
    }
  }
  double square = 0.0, cost;
  for (int a = 0; a < d; a++) {
    double e = 0.0, *row = rows + a * n;
    for (int c = 0; c < n; c++) row[c] = 0.0;
    for (int b = 0; b <= a; b++) {
      const double w = white[a * d + b];
      if (w == 0.0) continue;
      const double *from = p->is_pose[i] && b > 2 ? turned + (b - 3) * n : slope + b * n;
      e += w * error[b];
      for (int c = 0; c < n; c++) row[c] += w * from[c];
    }
    whitened[a] = e;
    square += e * e;
  }
  *residual = square, *weight = weigh(p, i, loss, log_inlier, square, &cost);
  for (int a = 0; a < d; a++) {
    const double *row = rows + a * n;
    for (int r = 0; r < n; r++) {
      const double much = *weight * row[r];
      if (much == 0.0) continue; /* most links move with few coordinates */
      vector[r] += much * whitened[a];
      for (int c = 0; c <= r; c++) matrix[r * n + c] += much * row[c];
    }
  }
  return cost;
}
