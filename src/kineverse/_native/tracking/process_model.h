/* Process model: prediction of means and covariances. */
#pragma once
#include "quadratic_program.h"

/* An observation has WIDE numbers at most. */
typedef struct {
  Function compute;
  int64_t observations, groups, coordinates, directions, known;
  /* Of each observation: whether it is a pose, its size, and where its numbers are. */
  const int64_t *is_pose, *size, *value, *slope, *seen, *white;
  /* The directions of group g are place[first[g]] to place[first[g + 1]], of the whole tangent, and own says
     which of its coordinates is one of them, or -1; likewise its coordinates, what is seen of it, and where
     in the output its curved limits are: value, bounds and slopes. */
  const int64_t *first, *place, *own, *first_x, *place_x, *first_watch, *watch, *first_limit, *limit;
  /* Rates and steps of the groups that are moved by others' speeds, and which rates change on the way. */
  const Function *rates, *step;
  const int64_t *first_bend;
  const double *bend, *period, *lower, *upper;
  double *input, *output, *work;
  /* A reading: numbers, which are measured, whitening, logarithms of their scales, and of the densities of
     outliers relative to the peak of the noise. */
  const double *numbers;
  const uint8_t *mask;
  const double *whitening, *log_scale, *outlier;
  /* Groups to update, the belief (x, η, log evidence of groups and Λ, one after the other), the prior about
     the same state, and of groups: normalised innovation squared, degrees of freedom. */
  const uint8_t *selected;
  double *belief, *prior, *nis, *dof;
  double *squares, *weights; /* of the residuals of each observation */
} Problem;

#define LONGEST 0.1 /* of a step of Runge and Kutta */
#define MOST_STEPS 100000

static int call(Function compute, const double *input, double *one, double *two, double *three) {
  const double *arguments[1] = {input};
  double *results[3] = {one, two, three};
  return compute(arguments, results, NULL, NULL, 0);
}

/* What leads back from how the tangent turns on the way: x becomes where a step along the rates ends, back is
   the inverse of R(x)⁺ ∂x/∂step; 0 if it cannot be followed. */
static int follow(const Problem *p, int64_t g, double *x, const double *step, double *back) {
  const int n = (int)(p->first[g + 1] - p->first[g]), m = (int)(p->first_x[g + 1] - p->first_x[g]);
  const double *known = p->input + p->coordinates, *bend = p->bend + p->first_bend[g];
  double input[2 * MOST + p->known], rates[MOST * MOST], slope[MOST * MOST], gain[MOST * MOST];
  double by_step[MOST * MOST], further[MOST], after[MOST], squares[MOST * MOST], turn[MOST * MOST];
  double normal[MOST * MOST];
  memcpy(input, x, m * sizeof(double));
  memcpy(input + m, known, p->known * sizeof(double));
  if (call(p->rates[g], input, rates, NULL, NULL)) return 0;
  double longest = 0.0;
  for (int r = 0; r < m; r++)
    for (int c = 0; c < n; c++) longest += bend[r * n + c] * fabs(rates[r * n + c] * step[c]);
  if (!(longest <= MOST_STEPS * LONGEST)) return 0;
  const int count = longest > LONGEST ? (int)ceil(longest / LONGEST) : 1;
  memset(by_step, 0, m * n * sizeof(double));
  for (int c = 0; c < n; c++) input[m + c] = step[c] / count;
  memcpy(input + m + n, known, p->known * sizeof(double));
  for (int k = 0; k < count; k++) {
    if (call(p->step[g], input, after, slope, gain)) return 0;
    memcpy(input, after, m * sizeof(double));
    for (int c = 0; c < n; c++) {
      for (int r = 0; r < m; r++) {
        further[r] = gain[r * n + c] / count;
        for (int i = 0; i < m; i++) further[r] += slope[r * m + i] * by_step[i * n + c];
      }
      for (int r = 0; r < m; r++) by_step[r * n + c] = further[r];
    }
  }
  memcpy(x, input, m * sizeof(double));
  memcpy(input + m, known, p->known * sizeof(double));
  if (call(p->rates[g], input, rates, NULL, NULL)) return 0;
  /* back = (RᵀB)⁻¹ RᵀR for B = ∂x/∂step, by normal equations, as no direction is lost. */
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++) {
      turn[r * n + c] = squares[r * n + c] = 0.0;
      for (int i = 0; i < m; i++) {
        turn[r * n + c] += rates[i * n + r] * by_step[i * n + c];
        squares[r * n + c] += rates[i * n + r] * rates[i * n + c];
      }
    }
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++) {
      normal[r * n + c] = back[r * n + c] = 0.0;
      for (int i = 0; i < n; i++) {
        normal[r * n + c] += turn[i * n + r] * turn[i * n + c];
        back[r * n + c] += turn[i * n + r] * squares[i * n + c];
      }
    }
  if (!factor(normal, n)) return 0;
  for (int c = 0; c < n; c++) {
    for (int r = 0; r < n; r++) further[r] = back[r * n + c];
    solve(normal, further, n);
    for (int r = 0; r < n; r++) back[r * n + c] = further[r];
  }
  return 1;
}

/* Move x by a step, and into the bounds; returns 2 if the tangent turns, 1 if not, 0 if it cannot be done. */
static int move(const Problem *p, int64_t g, double *x, const double *step, double *back) {
  const int n = (int)(p->first[g + 1] - p->first[g]);
  const int64_t *own = p->own + p->first[g], *place = p->place_x + p->first_x[g];
  const int turns = p->rates[g] != NULL;
  if (turns && !follow(p, g, x, step, back)) return 0;
  for (int i = 0; i < n; i++) {
    if (own[i] < 0) continue;
    const double to = turns ? x[own[i]] : x[own[i]] + step[i];
    const double lower = p->lower[place[own[i]]], upper = p->upper[place[own[i]]];
    x[own[i]] = to < lower ? lower : to > upper ? upper : to;
  }
  return turns ? 2 : 1;
}

#define FAR 1e300

/* The bounds on a step from x, where the curved limits are these; without them, if NULL. */
static void gather(const Problem *p, int64_t g, const double *x, const double *curved, Bounds *b) {
  const int n = (int)(p->first[g + 1] - p->first[g]);
  const int limits = curved ? (int)(p->first_limit[g + 1] - p->first_limit[g]) : 0;
  const int64_t *own = p->own + p->first[g], *place = p->place_x + p->first_x[g];
  b->count = 0;
  for (int i = 0; i < n; i++) {
    if (own[i] < 0) continue;
    const int k = b->count++;
    for (int c = 0; c < n; c++) b->rows[k * n + c] = c == i;
    b->low[k] = p->lower[place[own[i]]] - x[own[i]], b->high[k] = p->upper[place[own[i]]] - x[own[i]];
  }
  for (int i = 0; i < limits; i++, curved += 3 + n) {
    const int k = b->count++;
    /* Conditional bounds are infinite while inactive, and so may be the value that they bound. */
    const double value = fmax(-FAR, fmin(FAR, curved[0]));
    b->low[k] = curved[1] - value, b->high[k] = curved[2] - value;
    memcpy(b->rows + k * n, curved + 3, n * sizeof(double));
  }
}

/* The quadratic ½ξᵀmξ - vᵀξ at the end of a step, in the tangent there if back is not NULL. */
static void carry(double *m, double *v, const double *step, const double *back, int n) {
  double turned[MOST * MOST], moved[MOST];
  for (int r = 0; r < n; r++) {
    moved[r] = v[r];
    for (int c = 0; c < n; c++) moved[r] -= m[r * n + c] * step[c];
  }
  memcpy(v, moved, n * sizeof(double));
  if (!back) return;
  for (int r = 0; r < n; r++) {
    v[r] = 0.0;
    for (int i = 0; i < n; i++) v[r] += back[i * n + r] * moved[i];
    for (int c = 0; c < n; c++) {
      double sum = 0.0;
      for (int i = 0; i < n; i++) sum += m[r * n + i] * back[i * n + c];
      turned[r * n + c] = sum;
    }
  }
  for (int r = 0; r < n; r++)
    for (int c = 0; c <= r; c++) {
      double one = 0.0, other = 0.0;
      for (int i = 0; i < n; i++)
        one += back[i * n + r] * turned[i * n + c], other += back[i * n + c] * turned[i * n + r];
      m[r * n + c] = m[c * n + r] = (one + other) / 2;
    }
}
