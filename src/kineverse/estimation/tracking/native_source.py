"""C text: one update of a tracker whose coordinates are their own tangent, with bounds of single ones.

It does what :mod:`.solving`, :mod:`.residuals` and :mod:`.rotations` do, in the same order, after the text of
:mod:`.native_quadratic`. It says so when it cannot, and the belief is as it was then.
"""

UPDATE = r"""
#define API __attribute__((visibility("default")))
#define WIDE 64          /* numbers of an observation */
#define CONVERGED 1e-10  /* the square of a step in standard deviations that is the last */
#define MOST_ROUNDS 50
#define MOST_DAMPING 1e9

typedef int (*Compute)(const double **, double **, long long *, double *, int);

typedef struct {
  Compute compute;
  int64_t observations, groups, coordinates;
  /* Of each observation: whether it is a pose, its size, and where its numbers are. */
  const int64_t *is_pose, *size, *value, *slope, *seen, *white;
  /* The coordinates of group g are place[first[g]] to place[first[g + 1]]; likewise what is seen of it. */
  const int64_t *first, *place, *first_watch, *watch;
  const double *period, *lower, *upper;
  double *input, *output, *work, *squares;
} Problem;

/* A group on its way: posterior matrix and vector, best place and belief, trial and its belief. */
typedef struct {
  int n, is_done, is_begun;
  double *matrix, *vector, *x, *prior, *trial, *trial_prior;
  double cost, prior_cost, trial_cost, posterior_cost, damping;
} Work;

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

static int is_finite(const double *a, int n) {
  for (int i = 0; i < n; i++)
    if (!isfinite(a[i])) return 0;
  return 1;
}

/* Make the trial the best place, if it is better; 0 if there is none to begin at. */
static int judge(const Problem *p, int64_t g, Work *w, const double *information, const double *seen,
                 const uint8_t *mask, const double *whitening) {
  const int n = w->n;
  const int64_t *place = p->place + p->first[g];
  double matrix[MOST * MOST], vector[MOST], cost = w->trial_cost;
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++) matrix[r * n + c] = information[place[r] * p->coordinates + place[c]];
  memcpy(vector, w->trial_prior, n * sizeof(double));
  for (int64_t k = p->first_watch[g]; k < p->first_watch[g + 1]; k++)
    if (mask[p->watch[k]]) {
      const double half = add(p, p->watch[k], n, seen, whitening, matrix, vector);
      p->squares[p->watch[k]] = 2 * half;
      cost += half;
    }
  const int fine = isfinite(cost) && is_finite(matrix, n * n) && is_finite(vector, n);
  if (!fine && !w->is_begun) return 0;
  if (!fine || (w->is_begun && cost > w->cost + 1e-10 * (1 + fabs(w->cost)))) {
    w->damping = 10 * w->damping > 1e-3 ? 10 * w->damping : 1e-3;
    return 1;
  }
  w->is_begun = 1;
  memcpy(w->x, w->trial, n * sizeof(double));
  memcpy(w->prior, w->trial_prior, n * sizeof(double));
  memcpy(w->matrix, matrix, n * n * sizeof(double));
  memcpy(w->vector, vector, n * sizeof(double));
  w->prior_cost = w->trial_cost, w->cost = w->posterior_cost = cost;
  w->damping = w->damping > 1e-6 ? w->damping / 10 : 0.0;
  return 1;
}

/* Find the next trial, or settle; 0 if that is impossible. */
static int go_on(const Problem *p, int64_t g, Work *w, const double *information) {
  const int n = w->n;
  const int64_t *place = p->place + p->first[g];
  double damped[MOST * MOST], inverse[MOST * MOST], step[MOST], low[MOST], high[MOST];
  memcpy(damped, w->matrix, n * n * sizeof(double));
  for (int i = 0; i < n; i++) damped[i * n + i] *= 1 + w->damping;
  double triangle[MOST * MOST];
  memcpy(triangle, damped, n * n * sizeof(double));
  if (!factor(triangle, n)) return 0;
  memcpy(step, w->vector, n * sizeof(double));
  solve(triangle, step, n);
  int is_inside = 1;
  for (int i = 0; i < n; i++) {
    low[i] = p->lower[place[i]] - w->x[i], high[i] = p->upper[place[i]] - w->x[i];
    is_inside &= step[i] >= low[i] && step[i] <= high[i];
  }
  if (!is_inside) {
    invert(triangle, inverse, n);
    if (!between(inverse, step, low, high, n)) return 0;
  }
  for (int i = 0; i < n; i++) {
    const double x = w->x[i] + step[i], lower = p->lower[place[i]], upper = p->upper[place[i]];
    w->trial[i] = x < lower ? lower : x > upper ? upper : x;
  }
  if (quadratic(damped, step, n) <= CONVERGED || w->damping > MOST_DAMPING) {
    double along = 0.0;
    for (int r = 0; r < n; r++) along += w->vector[r] * step[r];
    w->posterior_cost += quadratic(w->matrix, step, n) / 2 - along;
    for (int r = 0; r < n; r++)
      for (int c = 0; c < n; c++) w->vector[r] -= w->matrix[r * n + c] * step[c];
    memcpy(w->x, w->trial, n * sizeof(double));
    w->is_done = 1;
    return 1;
  }
  double along = 0.0, curved = 0.0;
  for (int r = 0; r < n; r++) {
    double m = 0.0;
    for (int c = 0; c < n; c++) m += information[place[r] * p->coordinates + place[c]] * step[c];
    w->trial_prior[r] = w->prior[r] - m;
    along += w->prior[r] * step[r], curved += step[r] * m;
  }
  w->trial_cost = w->prior_cost - along + curved / 2;
  return 1;
}

/* What the bounds cost before anything is seen, for a mean at a step from x; below 0 if that is not known. */
static double beyond(const Problem *p, int64_t g, const Work *w, const double *information,
                     const double *triangle, const double *mean) {
  const int n = w->n;
  const int64_t *place = p->place + p->first[g];
  double inverse[MOST * MOST], step[MOST], low[MOST], high[MOST], cost = 0.0;
  int is_inside = 1;
  for (int i = 0; i < n; i++) {
    low[i] = p->lower[place[i]] - w->x[i], high[i] = p->upper[place[i]] - w->x[i], step[i] = mean[i];
    is_inside &= mean[i] >= low[i] && mean[i] <= high[i];
  }
  if (is_inside) return 0.0;
  invert(triangle, inverse, n);
  if (!between(inverse, step, low, high, n)) return -1.0;
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++)
      cost += (step[r] - mean[r]) * information[place[r] * p->coordinates + place[c]] * (step[c] - mean[c]);
  return cost > 0.0 ? cost / 2 : 0.0;
}

/* Update x, η, log evidence of groups and Λ, which lie one after the other; nis and dof of groups are
   results. Groups of which nothing is seen stay. Returns the number of rounds; below 0, it gave up. */
API int64_t update(const Problem *p, double *belief, const double *seen, const uint8_t *mask,
                   const double *whitening, const double *log_scale, double *nis, double *dof) {
  const int64_t n = p->coordinates, groups = p->groups;
  double *x = belief, *eta = x + n, *evidence = eta + n, *information = evidence + groups;
  Work works[groups];
  double *room = p->work, before[groups], outside[groups], triangle[MOST * MOST];
  int64_t open = 0, rounds = 0;
  for (int64_t g = 0; g < groups; g++) {
    Work *w = works + g;
    const int64_t *place = p->place + p->first[g];
    const int size = (int)(p->first[g + 1] - p->first[g]);
    *w = (Work){.n = size, .is_done = 1};
    w->vector = room, w->x = room + size, w->prior = room + 2 * size, w->trial = room + 3 * size;
    w->trial_prior = room + 4 * size, w->matrix = room + 5 * size;
    room += 5 * size + size * size;
    dof[g] = nis[g] = 0.0;
    for (int64_t k = p->first_watch[g]; k < p->first_watch[g + 1]; k++)
      if (mask[p->watch[k]]) dof[g] += (double)p->size[p->watch[k]], w->is_done = 0;
    if (w->is_done) continue;
    open++;
    for (int r = 0; r < size; r++) {
      w->x[r] = w->trial[r] = x[place[r]];
      w->prior[r] = w->trial_prior[r] = eta[place[r]];
      for (int c = 0; c < size; c++) triangle[r * size + c] = information[place[r] * n + place[c]];
    }
    if (!factor(triangle, size)) return -1;
    before[g] = log_determinant(triangle, size);
    double mean[MOST], along = 0.0;
    memcpy(mean, w->prior, size * sizeof(double));
    solve(triangle, mean, size);
    for (int r = 0; r < size; r++) along += mean[r] * w->prior[r];
    w->trial_cost = along / 2;
    outside[g] = beyond(p, g, w, information, triangle, mean);
    if (outside[g] < 0.0) return -7;
  }
  memcpy(p->input, x, n * sizeof(double));
  while (open) {
    if (++rounds > MOST_ROUNDS) return -2;
    for (int64_t g = 0; g < groups; g++)
      if (!works[g].is_done)
        for (int r = 0; r < works[g].n; r++) p->input[p->place[p->first[g] + r]] = works[g].trial[r];
    const double *arguments[1] = {p->input};
    double *results[1] = {p->output};
    if (p->compute(arguments, results, NULL, NULL, 0)) return -3;
    for (int64_t g = 0; g < groups; g++) {
      Work *w = works + g;
      if (w->is_done) continue;
      if (!judge(p, g, w, information, seen, mask, whitening)) return -4;
      if (!go_on(p, g, w, information)) return -5;
      open -= w->is_done;
    }
  }
  for (int64_t g = 0; g < groups; g++) {
    Work *w = works + g;
    if (!dof[g]) continue;
    const int64_t *place = p->place + p->first[g];
    double mean[MOST], along = 0.0;
    memcpy(triangle, w->matrix, w->n * w->n * sizeof(double));
    memcpy(mean, w->vector, w->n * sizeof(double));
    if (!factor(triangle, w->n)) return -6;
    solve(triangle, mean, w->n);
    for (int r = 0; r < w->n; r++) along += mean[r] * w->vector[r];
    const double least = w->posterior_cost - along / 2;
    nis[g] = least > 0.0 ? 2 * least : 0.0;
    evidence[g] += (before[g] - log_determinant(triangle, w->n)) / 2 - (w->posterior_cost - outside[g]);
    for (int64_t k = p->first_watch[g]; k < p->first_watch[g + 1]; k++)
      if (mask[p->watch[k]]) evidence[g] -= log_scale[p->watch[k]];
    for (int r = 0; r < w->n; r++) {
      x[place[r]] = w->x[r], eta[place[r]] = w->vector[r];
      for (int c = 0; c < w->n; c++) information[place[r] * n + place[c]] = w->matrix[r * w->n + c];
    }
  }
  return rounds;
}

/* Move x on, and add variances to the covariance, of each coordinate; then to the most probable place inside
   the bounds. Returns 0, or less if it gave up. */
API int64_t predict(const Problem *p, double *belief, const double *moved, const double *grown) {
  const int64_t total = p->coordinates;
  double *x = belief, *eta = x + total, *information = eta + total + p->groups;
  for (int64_t g = 0; g < p->groups; g++) {
    const int64_t *place = p->place + p->first[g];
    const int n = (int)(p->first[g + 1] - p->first[g]);
    double triangle[MOST * MOST], covariance[MOST * MOST], after[MOST * MOST];
    double step[MOST], vector[MOST], low[MOST], high[MOST];
    int is_moved = 0, is_inside = 1;
    for (int i = 0; i < n; i++) is_moved |= moved[place[i]] != 0.0 || grown[place[i]] != 0.0;
    if (!is_moved) continue;
    for (int r = 0; r < n; r++)
      for (int c = 0; c < n; c++) triangle[r * n + c] = information[place[r] * total + place[c]];
    if (!factor(triangle, n)) return -1;
    invert(triangle, covariance, n);
    for (int i = 0; i < n; i++) step[i] = eta[place[i]];
    solve(triangle, step, n);
    for (int i = 0; i < n; i++) covariance[i * n + i] += grown[place[i]];
    memcpy(triangle, covariance, n * n * sizeof(double));
    if (!factor(triangle, n)) return -2;
    invert(triangle, after, n);
    for (int i = 0; i < n; i++) {
      vector[i] = step[i];
      x[place[i]] += moved[place[i]];
      low[i] = p->lower[place[i]] - x[place[i]], high[i] = p->upper[place[i]] - x[place[i]];
      is_inside &= step[i] >= low[i] && step[i] <= high[i];
    }
    solve(triangle, vector, n);
    if (!is_inside && !between(covariance, step, low, high, n)) return -3;
    for (int r = 0; r < n; r++) {
      const double to = x[place[r]] + step[r], lower = p->lower[place[r]], upper = p->upper[place[r]];
      x[place[r]] = to < lower ? lower : to > upper ? upper : to;
      eta[place[r]] = vector[r];
      for (int c = 0; c < n; c++) {
        const double entry = (after[r * n + c] + after[c * n + r]) / 2;
        information[place[r] * total + place[c]] = entry;
        eta[place[r]] -= entry * step[c];
      }
    }
  }
  return 0;
}

/* The number of the first pose that is seen and not rigid; -1 if all are. */
API int64_t first_broken(const Problem *p, const double *seen, const uint8_t *mask, double rigid) {
  for (int64_t i = 0; i < p->observations; i++) {
    const double *t = seen + p->seen[i];
    if (!mask[i] || !p->is_pose[i]) continue;
    double worst = fabs(t[15] - 1.0);
    for (int k = 0; k < 3; k++) worst = fmax(worst, fabs(t[12 + k]));
    for (int a = 0; a < 3; a++)
      for (int b = 0; b <= a; b++)
        worst = fmax(worst, fabs(t[a] * t[b] + t[4 + a] * t[4 + b] + t[8 + a] * t[8 + b] - (a == b)));
    const double determinant = t[0] * (t[5] * t[10] - t[6] * t[9]) - t[1] * (t[4] * t[10] - t[6] * t[8]) +
                               t[2] * (t[4] * t[9] - t[5] * t[8]);
    if (!(worst <= rigid && determinant > 0.0) || !is_finite(t, 16)) return i;
  }
  return -1;
}
"""
