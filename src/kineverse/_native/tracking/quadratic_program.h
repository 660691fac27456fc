/* Quadratic program with bounds on single unknowns, of which there are MOST at most. */
#pragma once
#include "../definitions.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define LEAST 1e-12

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

/* The minimum between bounds of a quadratic with this inverse and free minimum x; 0 if something is wrong. */
static int between(const double *inverse, double *x, const double *low, const double *high, int n) {
  int which[2 * MOST], sign[2 * MOST], held = 0;
  double multiplier[2 * MOST], relation[2 * MOST], way[MOST], small[MOST * MOST];
  for (int round = 0; round < 200 * n + 100; round++) {
    int worst = -1, side = 1;
    double least = 0.0, size = 0.0;
    for (int s = 1; s >= -1; s -= 2)
      for (int i = 0; i < n; i++) {
        const double bound = s > 0 ? low[i] : -high[i];
        int is_held = 0;
        for (int k = 0; k < held; k++) is_held |= which[k] == i && sign[k] == s;
        if (is_held || !isfinite(bound)) continue;
        const double scale = LEAST * (1.0 + fabs(bound)), slack = s * x[i] - bound;
        if (worst < 0 || slack + scale < least) worst = i, side = s, least = slack + scale, size = scale;
      }
    if (worst < 0 || least - size >= -size) return 1;
    const double bound = side > 0 ? low[worst] : -high[worst];
    double added = 0.0;
    for (;;) {
      if (held >= MOST) return 0;
      for (int i = 0; i < n; i++) way[i] = side * inverse[i * n + worst];
      for (int a = 0; a < held; a++) {
        relation[a] = sign[a] * way[which[a]];
        for (int b = 0; b < held; b++)
          small[a * held + b] = sign[a] * sign[b] * inverse[which[a] * n + which[b]];
      }
      if (held) {
        if (!factor(small, held)) return 0;
        solve(small, relation, held);
        for (int a = 0; a < held; a++)
          for (int i = 0; i < n; i++) way[i] -= inverse[i * n + which[a]] * sign[a] * relation[a];
      }
      const double along = side * way[worst];
      int leaving = -1;
      double partial = INFINITY;
      for (int a = 0; a < held; a++)
        if (relation[a] > LEAST && multiplier[a] / relation[a] < partial)
          partial = multiplier[a] / relation[a], leaving = a;
      const int is_free = along > LEAST * inverse[worst * n + worst];
      const double full = is_free ? -(side * x[worst] - bound) / along : INFINITY;
      const double step = partial < full ? partial : full;
      if (!isfinite(step)) return 0;
      if (is_free)
        for (int i = 0; i < n; i++) x[i] += step * way[i];
      for (int a = 0; a < held; a++) multiplier[a] -= step * relation[a];
      added += step;
      if (full <= partial) {
        which[held] = worst, sign[held] = side, multiplier[held++] = added;
        break;
      }
      for (int a = leaving; a + 1 < held; a++)
        which[a] = which[a + 1], sign[a] = sign[a + 1], multiplier[a] = multiplier[a + 1];
      held--;
    }
  }
  return 0;
}
