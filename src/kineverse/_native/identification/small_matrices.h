/* Rotations and small matrices. */
#pragma once
#include "../definitions.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define TAU 6.283185307179586

INLINE void times33(const double *a, const double *b, double *c) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

INLINE void transposed_times33(const double *a, const double *b, double *c) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) c[3 * i + j] = a[i] * b[j] + a[3 + i] * b[3 + j] + a[6 + i] * b[6 + j];
}

INLINE void times_transposed33(const double *a, const double *b, double *c) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      c[3 * i + j] = a[3 * i] * b[3 * j] + a[3 * i + 1] * b[3 * j + 1] + a[3 * i + 2] * b[3 * j + 2];
}

INLINE void apply(const double *a, const double *v, double *w) {
  for (int i = 0; i < 3; i++) w[i] = a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

INLINE void apply_transposed(const double *a, const double *v, double *w) {
  for (int i = 0; i < 3; i++) w[i] = a[i] * v[0] + a[3 + i] * v[1] + a[6 + i] * v[2];
}

INLINE void cross(const double *a, const double *b, double *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

/* I + s [v]x + c [v]x^2 */
INLINE void series(const double *v, double s, double c, double *r) {
  double square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) r[3 * i + j] = c * v[i] * v[j] + (i == j ? 1.0 - c * square : 0.0);
  r[1] -= s * v[2]; r[2] += s * v[1]; r[5] -= s * v[0];
  r[3] += s * v[2]; r[6] -= s * v[1]; r[7] += s * v[0];
}

INLINE void exponential(const double *v, double *r) {
  double square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], angle = sqrt(square);
  if (square < 1e-10) series(v, 1.0 - square / 6.0, 0.5 - square / 24.0, r);
  else series(v, sin(angle) / angle, (1.0 - cos(angle)) / square, r);
}

static void right_jacobian(const double *v, double *r) {
  double square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], angle = sqrt(square);
  if (square < 1e-6) series(v, square / 24.0 - 0.5, 1.0 / 6.0 - square / 120.0, r);
  else series(v, (cos(angle) - 1.0) / square, (angle - sin(angle)) / (square * angle), r);
}

static void logarithm(const double *r, double *v) {
  v[0] = 0.5 * (r[7] - r[5]);
  v[1] = 0.5 * (r[2] - r[6]);
  v[2] = 0.5 * (r[3] - r[1]);
  double sine = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), cosine = 0.5 * (r[0] + r[4] + r[8] - 1.0);
  double angle = atan2(sine, cosine), factor = sine < 1e-9 ? 1.0 : angle / sine;
  if (cosine >= -0.99) {
    for (int i = 0; i < 3; i++) v[i] *= factor;
    return;
  }
  /* Near half a turn R + R^T carries the direction. */
  double c = cos(angle), axis[3], sign = 0.0, length = 0.0;
  int most = 0;
  for (int i = 1; i < 3; i++)
    if (r[4 * i] > r[4 * most]) most = i;
  for (int i = 0; i < 3; i++) {
    axis[i] = 0.5 * (r[3 * i + most] + r[3 * most + i]) - (i == most ? c : 0.0);
    length += axis[i] * axis[i];
    sign += axis[i] * v[i];
  }
  factor = (sign < 0.0 ? -angle : angle) / sqrt(length);
  for (int i = 0; i < 3; i++) v[i] = factor * axis[i];
}

/* The rotation that is nearest to what is nearly one: R (3 - R'R) / 2 squares the error. */
static void straighten(double *R) {
  double square[9], nearer[9];
  transposed_times33(R, R, square);
  for (int i = 0; i < 9; i++) square[i] = (i % 4 ? 0.0 : 1.5) - 0.5 * square[i];
  times33(R, square, nearer);
  memcpy(R, nearer, sizeof nearer);
}

/* The lower factor of a positive definite matrix in its place, with the reciprocals of its diagonal; returns
   the product of the diagonal, or 0 if it is none. */
INLINE double factorise(double *a, const int n) {
  double product = 1.0;
  for (int j = 0; j < n; j++) {
    for (int k = 0; k < j; k++)
      for (int i = j; i < n; i++) a[n * i + j] -= a[n * i + k] * a[n * j + k];
    if (!(a[n * j + j] > 0.0)) return 0.0;
    double d = sqrt(a[n * j + j]), reciprocal = 1.0 / d;
    product *= d;
    a[n * j + j] = reciprocal;
    for (int i = j + 1; i < n; i++) a[n * i + j] *= reciprocal;
  }
  return product;
}

/* Solve L L' x = b in the place of b. */
static void resolve(const double *l, int n, double *x) {
  for (int i = 0; i < n; i++) {
    for (int k = 0; k < i; k++) x[i] -= l[n * i + k] * x[k];
    x[i] *= l[n * i + i];
  }
  for (int i = n - 1; i >= 0; i--) {
    for (int k = i + 1; k < n; k++) x[i] -= l[n * k + i] * x[k];
    x[i] *= l[n * i + i];
  }
}

/* The logarithm of the determinant of a matrix, by rows that are exchanged; a is lost. */
static double log_volume(double *a, int n) {
  double sum = 0.0;
  for (int j = 0; j < n; j++) {
    int most = j;
    for (int i = j + 1; i < n; i++)
      if (fabs(a[n * i + j]) > fabs(a[n * most + j])) most = i;
    for (int c = j; c < n; c++) {
      double other = a[n * j + c];
      a[n * j + c] = a[n * most + c];
      a[n * most + c] = other;
    }
    sum += log(fabs(a[n * j + j]));
    for (int i = j + 1; i < n; i++) {
      double factor = a[n * i + j] / a[n * j + j];
      for (int c = j + 1; c < n; c++) a[n * i + c] -= factor * a[n * j + c];
    }
  }
  return sum;
}

/* The singular values of the first rows of a matrix of six rows, by turning pairs of its columns until all
   are at right angles (Hestenes 1958); a is lost. */
static void singular_values(double *a, int rows, int n, double *values) {
  for (int sweep = 0; sweep < 30; sweep++) {
    int turned = 0;
    for (int i = 0; i < n; i++)
      for (int j = i + 1; j < n; j++) {
        double ii = 0.0, jj = 0.0, ij = 0.0;
        for (int r = 0; r < rows; r++) {
          ii += a[n * r + i] * a[n * r + i];
          jj += a[n * r + j] * a[n * r + j];
          ij += a[n * r + i] * a[n * r + j];
        }
        if (ij * ij <= 1e-30 * ii * jj) continue;
        turned = 1;
        double zeta = (jj - ii) / (2.0 * ij);
        double t = (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
        double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
        for (int r = 0; r < rows; r++) {
          double x = a[n * r + i], y = a[n * r + j];
          a[n * r + i] = c * x - s * y;
          a[n * r + j] = s * x + c * y;
        }
      }
    if (!turned) break;
  }
  for (int i = 0; i < n; i++) {
    values[i] = 0.0;
    for (int r = 0; r < rows; r++) values[i] += a[n * r + i] * a[n * r + i];
    values[i] = sqrt(values[i]);
  }
}

INLINE double invert_size(const double *a, const int n, double *inverse) {
  double l[36], root;
  for (int i = 0; i < n * n; i++) l[i] = a[i];
  root = factorise(l, n);
  if (root == 0.0) return 0.0;
  for (int j = 0; j < n; j++)
    for (int i = j + 1; i < n; i++) {
      double sum = 0.0;
      for (int k = j; k < i; k++) sum -= l[n * i + k] * l[n * k + j];
      l[n * i + j] = sum * l[n * i + i];
    }
  for (int i = 0; i < n; i++)
    for (int j = 0; j <= i; j++) {
      double sum = 0.0;
      for (int k = i; k < n; k++) sum += l[n * k + i] * l[n * k + j];
      inverse[n * i + j] = inverse[n * j + i] = sum;
    }
  return root;
}

/* The inverse of a positive definite matrix of at most six rows; returns the root of its determinant, or 0 if
   it is none. */
static double invert(const double *a, int n, double *inverse) {
  switch (n) {
    case 1: return invert_size(a, 1, inverse);
    case 2: return invert_size(a, 2, inverse);
    case 3: return invert_size(a, 3, inverse);
    case 6: return invert_size(a, 6, inverse);
    default: return invert_size(a, n, inverse);
  }
}

/* e' W e */
INLINE double squared(const double *e, const double *W, const int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) sum += e[i] * W[n * i + j] * e[j];
  return sum;
}

/* A covariance in the axes whose columns are R's. */
INLINE void turn(const double *covariance, const double *R, const int n, double *turned) {
  for (int i = 0; i < n; i += 3)
    for (int j = 0; j <= i; j += 3) {
      double block[9], half[9], whole[9];
      for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) block[3 * r + c] = covariance[n * (i + r) + j + c];
      transposed_times33(R, block, half);
      times33(half, R, whole);
      for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
          turned[n * (i + r) + j + c] = turned[n * (j + c) + i + r] = whole[3 * r + c];
    }
}

/* An error in other axes. */
INLINE void turn_back(const double *R, const double *error, const int n, double *turned) {
  for (int i = 0; i < n; i += 3) apply(R, error + i, turned + i);
}
