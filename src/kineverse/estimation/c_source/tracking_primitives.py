"""C text of the bounded QP, the process model and the residuals of tracking."""

QUADRATIC_PROGRAM = r"""
#include <math.h>
#include <stdint.h>
#include <string.h>

#define MOST 64 /* unknowns */
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
"""

PROCESS_MODEL = r"""
#define API __attribute__((visibility("default")))
#define WIDE 64 /* numbers of an observation */

typedef int (*Compute)(const double **, double **, long long *, double *, int);

typedef struct {
  Compute compute;
  int64_t observations, groups, coordinates, directions, known;
  /* Of each observation: whether it is a pose, its size, and where its numbers are. */
  const int64_t *is_pose, *size, *value, *slope, *seen, *white;
  /* The directions of group g are place[first[g]] to place[first[g + 1]], of the whole tangent, and own says
     which of its coordinates is one of them, or -1; likewise its coordinates, and what is seen of it. */
  const int64_t *first, *place, *own, *first_x, *place_x, *first_watch, *watch;
  /* Rates and steps of the groups that are moved by others' speeds, and which rates change on the way. */
  const Compute *rates, *step;
  const int64_t *first_bend;
  const double *bend;
  const double *period, *lower, *upper;
  double *input, *output, *work, *squares;
} Problem;

#define LONGEST 0.1 /* of a step of Runge and Kutta */
#define MOST_STEPS 100000

static int call(Compute compute, const double *input, double *one, double *two, double *three) {
  const double *arguments[1] = {input};
  double *results[3] = {one, two, three};
  return compute(arguments, results, NULL, NULL, 0);
}

/* The inverse of any matrix, which is lost; 0 if there is none. */
static int invert_any(double *a, double *inverse, int n) {
  for (int i = 0; i < n * n; i++) inverse[i] = i % (n + 1) == 0;
  for (int c = 0; c < n; c++) {
    int best = c;
    for (int r = c + 1; r < n; r++)
      if (fabs(a[r * n + c]) > fabs(a[best * n + c])) best = r;
    if (!(fabs(a[best * n + c]) > 0.0)) return 0;
    for (int k = 0; k < n; k++) {
      const double u = a[c * n + k], v = inverse[c * n + k];
      a[c * n + k] = a[best * n + k], a[best * n + k] = u;
      inverse[c * n + k] = inverse[best * n + k], inverse[best * n + k] = v;
    }
    const double pivot = a[c * n + c];
    for (int k = 0; k < n; k++) a[c * n + k] /= pivot, inverse[c * n + k] /= pivot;
    for (int r = 0; r < n; r++) {
      const double much = a[r * n + c];
      if (r == c || much == 0.0) continue;
      for (int k = 0; k < n; k++) {
        a[r * n + k] -= much * a[c * n + k];
        inverse[r * n + k] -= much * inverse[c * n + k];
      }
    }
  }
  return 1;
}

/* What leads back from how the tangent turns on the way: x becomes where a step along the rates ends, back is
   the inverse of R(x)⁺ ∂x/∂step; 0 if it cannot be followed. */
static int follow(const Problem *p, int64_t g, double *x, const double *step, double *back) {
  const int n = (int)(p->first[g + 1] - p->first[g]), m = (int)(p->first_x[g + 1] - p->first_x[g]);
  const double *known = p->input + p->coordinates, *bend = p->bend + p->first_bend[g];
  double input[2 * MOST + p->known], rates[MOST * MOST], slope[MOST * MOST], gain[MOST * MOST];
  double by_step[MOST * MOST], further[MOST], after[MOST], squares[MOST * MOST], turn[MOST * MOST];
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
  /* R⁺ = (RᵀR)⁻¹Rᵀ, as no direction is lost. */
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++) {
      double sum = 0.0;
      for (int i = 0; i < m; i++) sum += rates[i * n + r] * rates[i * n + c];
      squares[r * n + c] = sum;
    }
  if (!factor(squares, n)) return 0;
  for (int c = 0; c < n; c++) {
    for (int r = 0; r < n; r++) {
      further[r] = 0.0;
      for (int i = 0; i < m; i++) further[r] += rates[i * n + r] * by_step[i * n + c];
    }
    solve(squares, further, n);
    for (int r = 0; r < n; r++) turn[r * n + c] = further[r];
  }
  return invert_any(turn, back, n);
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

/* What a step may be at most. */
static void bounds(const Problem *p, int64_t g, const double *x, double *low, double *high) {
  const int n = (int)(p->first[g + 1] - p->first[g]);
  const int64_t *own = p->own + p->first[g], *place = p->place_x + p->first_x[g];
  for (int i = 0; i < n; i++) {
    low[i] = own[i] < 0 ? -INFINITY : p->lower[place[own[i]]] - x[own[i]];
    high[i] = own[i] < 0 ? INFINITY : p->upper[place[own[i]]] - x[own[i]];
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
"""

RESIDUAL = r"""
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

/* Add one observation to matrix and vector; return half the square of its error. */
static double add(const Problem *p, int64_t i, int n, const double *seen, const double *whitening,
                  double *matrix, double *vector) {
  const int d = (int)p->size[i];
  const double *value = p->output + p->value[i], *slope = p->output + p->slope[i], *z = seen + p->seen[i];
  const double *white = whitening + p->white[i];
  double error[WIDE], turned[3 * MOST], row[MOST + 1];
  if (p->is_pose[i]) {
    double relative[9], v[3];
    for (int a = 0; a < 3; a++)
      for (int b = 0; b < 3; b++)
        relative[3 * a + b] =
            z[4 * a] * value[3 * b] + z[4 * a + 1] * value[3 * b + 1] + z[4 * a + 2] * value[3 * b + 2];
    logarithm(relative, v);
    for (int a = 0; a < 3; a++) error[a] = z[4 * a + 3] - value[9 + a], error[3 + a] = v[a];
    const double squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], angle = sqrt(squared);
    const double half = angle / 2;
    const double factor =
        angle > 0.02 ? (1 - half / tan(half)) / (4 * half * half) : 1.0 / 12 + squared / 720;
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
  double cost = 0.0;
  for (int a = 0; a < d; a++) {
    double e = 0.0;
    for (int c = 0; c < n; c++) row[c] = 0.0;
    for (int b = 0; b <= a; b++) {
      const double weight = white[a * d + b];
      if (weight == 0.0) continue;
      const double *from = p->is_pose[i] && b > 2 ? turned + (b - 3) * n : slope + b * n;
      e += weight * error[b];
      for (int c = 0; c < n; c++) row[c] += weight * from[c];
    }
    cost += e * e;
    for (int r = 0; r < n; r++) {
      vector[r] += row[r] * e;
      for (int c = 0; c < n; c++) matrix[r * n + c] += row[r] * row[c];
    }
  }
  return cost / 2;
}
"""
