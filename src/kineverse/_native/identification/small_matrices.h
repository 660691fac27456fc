/* Small matrices. */
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

INLINE void apply(const double *a, const double *v, double *w) {
  for (int i = 0; i < 3; i++) w[i] = a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

INLINE void cross(const double *a, const double *b, double *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
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
