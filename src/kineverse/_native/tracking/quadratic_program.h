/* Quadratic program of at most MOST unknowns between at most ROWS bounds.

   It is small, dense and starts at its free minimum, which mostly is the solution. Libraries of quadratic
   programs have no header here, and allocate memory for each. */
#pragma once
#include "../definitions.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define LEAST 1e-12
#define ROWS (2 * MOST)

/* The lower triangle L with L Lᵀ = a, in place; 0 if a is not positive. */
static int factor(double *a, int n) {
  for (int j = 0; j < n; j++) {
    for (int i = j; i < n; i++) {
      double s = a[i * n + j];
      for (int k = 0; k < j; k++) s -= a[i * n + k] * a[j * n + k];
      if (i > j) a[i * n + j] = s / a[j * n + j];
      else if (s > 0.0 && isfinite(s)) a[j * n + j] = sqrt(s);
      else return 0;
    }
  }
  return 1;
}

static void solve(const double *l, double *b, int n) {
  for (int i = 0; i < n; i++) {
    for (int k = 0; k < i; k++) b[i] -= l[i * n + k] * b[k];
    b[i] /= l[i * n + i];
  }
  for (int i = n - 1; i >= 0; i--) {
    for (int k = i + 1; k < n; k++) b[i] -= l[k * n + i] * b[k];
    b[i] /= l[i * n + i];
  }
}

/* The inverse of L Lᵀ. */
static void invert(const double *l, double *inverse, int n) {
  double column[MOST];
  for (int c = 0; c < n; c++) {
    for (int i = 0; i < n; i++) column[i] = i == c;
    solve(l, column, n);
    for (int i = 0; i < n; i++) inverse[i * n + c] = column[i];
  }
  for (int r = 0; r < n; r++)
    for (int c = 0; c < r; c++)
      inverse[r * n + c] = inverse[c * n + r] = (inverse[r * n + c] + inverse[c * n + r]) / 2;
}

static double log_determinant(const double *l, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++) sum += log(l[i * n + i]);
  return 2.0 * sum;
}

static double quadratic(const double *a, const double *v, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) sum += v[i] * a[i * n + j] * v[j];
  return sum;
}

/* low <= rows x <= high. */
typedef struct {
  int count;
  double rows[ROWS * MOST], low[ROWS], high[ROWS];
} Bounds;

static double dot(const double *a, const double *b, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

static int is_within(const Bounds *b, const double *x, int n) {
  for (int k = 0; k < b->count; k++) {
    const double value = dot(b->rows + k * n, x, n);
    if (!(value >= b->low[k] && value <= b->high[k])) return 0;
  }
  return 1;
}

/* Sum of the violations at 0. */
static double violation(const Bounds *b) {
  double sum = 0.0;
  for (int k = 0; k < b->count; k++) sum += fmax(fmax(b->low[k], -b->high[k]), 0.0);
  return sum;
}

/* The minimum between bounds of a quadratic with this inverse and free minimum x; 0 if there is none.

   The dual method adds violated bounds one by one (Goldfarb and Idnani, A numerically stable dual method for
   solving strictly convex quadratic programs, 1983). */
static int between(const Bounds *b, const double *inverse, double *x, int n) {
  int which[MOST], sign[MOST], held = 0;
  double multiplier[MOST], relation[MOST], way[MOST], normal[MOST], pull[MOST * MOST], small[MOST * MOST];
  for (int round = 0; round < 200 * b->count + 100; round++) {
    int worst = -1, side = 1;
    double least = 0.0, size = 0.0;
    for (int s = 1; s >= -1; s -= 2)
      for (int k = 0; k < b->count; k++) {
        const double bound = s > 0 ? b->low[k] : -b->high[k];
        int is_held = 0;
        for (int a = 0; a < held; a++) is_held |= which[a] == k && sign[a] == s;
        if (is_held || !isfinite(bound)) continue;
        const double scale = LEAST * (1.0 + fabs(bound)), slack = s * dot(b->rows + k * n, x, n) - bound;
        if (worst < 0 || slack + scale < least) worst = k, side = s, least = slack + scale, size = scale;
      }
    if (worst < 0 || least - size >= -size) return 1;
    const double bound = side > 0 ? b->low[worst] : -b->high[worst];
    double added = 0.0, free_way[MOST];
    for (int i = 0; i < n; i++) normal[i] = side * b->rows[worst * n + i];
    for (int i = 0; i < n; i++) free_way[i] = dot(inverse + i * n, normal, n);
    for (;;) {
      memcpy(way, free_way, n * sizeof(double));
      for (int a = 0; a < held; a++) {
        relation[a] = sign[a] * dot(b->rows + which[a] * n, free_way, n);
        for (int c = 0; c < held; c++)
          small[a * held + c] = sign[a] * dot(b->rows + which[a] * n, pull + c * n, n);
      }
      if (held) {
        if (!factor(small, held)) return 0;
        solve(small, relation, held);
        for (int a = 0; a < held; a++)
          for (int i = 0; i < n; i++) way[i] -= pull[a * n + i] * relation[a];
      }
      const double along = dot(normal, way, n);
      int leaving = -1;
      double partial = INFINITY;
      for (int a = 0; a < held; a++)
        if (relation[a] > LEAST && multiplier[a] / relation[a] < partial)
          partial = multiplier[a] / relation[a], leaving = a;
      const int is_free = along > LEAST * dot(normal, free_way, n);
      const double full = is_free ? -(dot(normal, x, n) - bound) / along : INFINITY;
      const double step = partial < full ? partial : full;
      if (!isfinite(step)) return 0;
      if (is_free)
        for (int i = 0; i < n; i++) x[i] += step * way[i];
      for (int a = 0; a < held; a++) multiplier[a] -= step * relation[a];
      added += step;
      if (full <= partial) {
        if (held == MOST) return 0;
        memcpy(pull + held * n, free_way, n * sizeof(double));
        which[held] = worst, sign[held] = side, multiplier[held++] = added;
        break;
      }
      for (int a = leaving; a + 1 < held; a++) {
        which[a] = which[a + 1], sign[a] = sign[a + 1], multiplier[a] = multiplier[a + 1];
        memcpy(pull + a * n, pull + (a + 1) * n, n * sizeof(double));
      }
      held--;
    }
  }
  return 0;
}
