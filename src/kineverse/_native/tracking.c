/* Iterated MAP update of tracking.

   The algorithm is that of estimation/tracking/map_update.py, in the same order. On failure it returns an
   error code and leaves the state unchanged. */

#include "tracking/process_model.h"

/* Residuals of measured poses and values. */

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

#define CONVERGED 1e-10  /* the square of a step in standard deviations that is the last */
#define MOST_ROUNDS 50
#define MOST_DAMPING 1e9
#define HALF_TURN 3.141592653589793
#define OUTSIDE 1e-9 /* violation of limits that is rounding */

/* A group on its way, in n directions and m coordinates: posterior matrix and vector, best place with belief,
   curved limits, squares and weights there, trial and its belief. The cost is that of all residuals; the
   excess is what it is beyond that of the posterior, whose squares are weighted. */
typedef struct {
  int n, m, limits, is_done, is_begun;
  double *matrix, *vector, *x, *prior, *information, *trial, *trial_prior, *trial_information, *curved;
  double cost, prior_cost, trial_cost, posterior_cost, excess, outside, damping;
} Work;

static int is_finite(const double *a, int n) {
  for (int i = 0; i < n; i++)
    if (!isfinite(a[i])) return 0;
  return 1;
}

/* Least cost of the prior inside the limits, linearised at x; below 0 if that is not known. */
static double beyond(const Problem *p, int64_t g, const Work *w) {
  const int n = w->n;
  double triangle[MOST * MOST], inverse[MOST * MOST], step[MOST], mean[MOST];
  Bounds b;
  memcpy(triangle, w->information, n * n * sizeof(double));
  memcpy(mean, w->prior, n * sizeof(double));
  if (!factor(triangle, n)) return -1.0;
  solve(triangle, mean, n);
  gather(p, g, w->x, w->curved, &b);
  if (is_within(&b, mean, n)) return 0.0;
  memcpy(step, mean, n * sizeof(double));
  invert(triangle, inverse, n);
  if (!between(&b, inverse, step, n)) return -1.0;
  for (int i = 0; i < n; i++) step[i] -= mean[i];
  return fmax(quadratic(w->information, step, n) / 2, 0.0);
}

/* Make the trial the best place, if it is better; 0 if there is none to begin at. */
static int judge(const Problem *p, int64_t g, Work *w, int loss, double log_inlier) {
  const int n = w->n, row = 3 + n;
  const int64_t *watch = p->watch + p->first_watch[g];
  const int count = (int)(p->first_watch[g + 1] - p->first_watch[g]);
  double matrix[MOST * MOST], vector[MOST], cost = w->trial_cost, half = w->trial_cost;
  double curved[w->limits * row + 1], squares[count + 1], weights[count + 1];
  memcpy(matrix, w->trial_information, n * n * sizeof(double));
  memcpy(vector, w->trial_prior, n * sizeof(double));
  for (int k = 0; k < count; k++) {
    squares[k] = 0.0, weights[k] = 1.0;
    if (!p->mask[watch[k]]) continue;
    cost += add(p, watch[k], n, loss, log_inlier, matrix, vector, squares + k, weights + k);
    half += weights[k] * squares[k] / 2;
  }
  for (int r = 0; r < n; r++)
    for (int c = 0; c < r; c++) matrix[c * n + r] = matrix[r * n + c];
  for (int k = 0; k < w->limits; k++)
    memcpy(curved + k * row, p->output + p->limit[p->first_limit[g] + k], row * sizeof(double));
  const int fine = isfinite(cost) && is_finite(matrix, n * n) && is_finite(vector, n);
  int is_better = fine && (!w->is_begun || cost <= w->cost + 1e-10 * (1 + fabs(w->cost)));
  if (fine && !is_better && w->limits) {
    Bounds here, there;
    gather(p, g, w->x, w->curved, &here);
    gather(p, g, w->trial, curved, &there);
    is_better = violation(&here) > OUTSIDE && violation(&there) < violation(&here) / 2;
  }
  if (!is_better) {
    if (!w->is_begun) return 0;
    w->damping = fmax(10 * w->damping, 1e-3);
    return 1;
  }
  for (int k = 0; k < count; k++) p->squares[watch[k]] = squares[k], p->weights[watch[k]] = weights[k];
  memcpy(w->x, w->trial, w->m * sizeof(double));
  memcpy(w->prior, w->trial_prior, n * sizeof(double));
  memcpy(w->information, w->trial_information, n * n * sizeof(double));
  memcpy(w->matrix, matrix, n * n * sizeof(double));
  memcpy(w->vector, vector, n * sizeof(double));
  memcpy(w->curved, curved, w->limits * row * sizeof(double));
  w->prior_cost = w->trial_cost, w->cost = cost, w->posterior_cost = half, w->excess = cost - half;
  if (!w->is_begun && (w->outside = beyond(p, g, w)) < 0.0) return 0;
  w->is_begun = 1;
  w->damping = w->damping > 1e-6 ? w->damping / 10 : 0.0;
  return 1;
}

/* Find the next trial, or settle; 0 if that is impossible. */
static int go_on(const Problem *p, int64_t g, Work *w) {
  const int n = w->n;
  const int64_t *own = p->own + p->first[g];
  double damped[MOST * MOST], triangle[MOST * MOST], inverse[MOST * MOST], back[MOST * MOST], step[MOST];
  Bounds b;
  memcpy(damped, w->matrix, n * n * sizeof(double));
  for (int i = 0; i < n; i++) damped[i * n + i] *= 1 + w->damping;
  memcpy(triangle, damped, n * n * sizeof(double));
  if (!factor(triangle, n)) return 0;
  memcpy(step, w->vector, n * sizeof(double));
  solve(triangle, step, n);
  gather(p, g, w->x, w->curved, &b);
  if (!is_within(&b, step, n)) {
    invert(triangle, inverse, n);
    if (!between(&b, inverse, step, n)) return 0;
  }
  double turned = 0.0;
  for (int i = 0; i < n; i++)
    if (own[i] < 0) turned = fmax(turned, fabs(step[i]));
  if (turned > HALF_TURN)
    for (int i = 0; i < n; i++) step[i] *= HALF_TURN / turned;
  memcpy(w->trial, w->x, w->m * sizeof(double));
  const int moved = move(p, g, w->trial, step, back);
  if (!moved) return 0;
  w->trial_cost = w->prior_cost - dot(w->prior, step, n) + quadratic(w->information, step, n) / 2;
  memcpy(w->trial_prior, w->prior, n * sizeof(double));
  memcpy(w->trial_information, w->information, n * n * sizeof(double));
  carry(w->trial_information, w->trial_prior, step, moved == 2 ? back : NULL, n);
  if (quadratic(damped, step, n) <= CONVERGED || w->damping > MOST_DAMPING) {
    w->posterior_cost += quadratic(w->matrix, step, n) / 2 - dot(w->vector, step, n);
    carry(w->matrix, w->vector, step, moved == 2 ? back : NULL, n);
    memcpy(w->x, w->trial, w->m * sizeof(double));
    memcpy(w->prior, w->trial_prior, n * sizeof(double));
    memcpy(w->information, w->trial_information, n * n * sizeof(double));
    w->is_done = 1;
  }
  return 1;
}

/* Write vector and matrix of a group into those of the whole tangent, of n directions. */
static void put(const Problem *p, int64_t g, const double *vector, const double *matrix, double *eta,
                double *information, int64_t n) {
  const int64_t *place = p->place + p->first[g], size = p->first[g + 1] - p->first[g];
  for (int64_t r = 0; r < size; r++) {
    eta[place[r]] = vector[r];
    for (int64_t c = 0; c < size; c++) information[place[r] * n + place[c]] = matrix[r * size + c];
  }
}

/* Update the selected groups; returns the number of rounds; below 0, it gave up. */
EXPORTED int64_t update(const Problem *p, int64_t loss, double log_inlier) {
  const int64_t n = p->directions, groups = p->groups, total = p->coordinates;
  double *x = p->belief, *eta = x + total, *evidence = eta + n, *information = evidence + groups;
  double *eta_before = p->prior + total, *information_before = eta_before + n + groups;
  Work works[groups];
  double *room = p->work;
  int64_t open = 0, rounds = 0;
  for (int64_t g = 0; g < groups; g++) {
    Work *w = works + g;
    const int64_t *place = p->place + p->first[g], *place_x = p->place_x + p->first_x[g];
    const int size = (int)(p->first[g + 1] - p->first[g]), many = (int)(p->first_x[g + 1] - p->first_x[g]);
    *w = (Work){.n = size, .m = many, .limits = (int)(p->first_limit[g + 1] - p->first_limit[g])};
    w->vector = room, w->prior = room + size, w->trial_prior = room + 2 * size, w->matrix = room + 3 * size;
    w->information = w->matrix + size * size, w->trial_information = w->information + size * size;
    w->x = w->trial_information + size * size, w->trial = w->x + many, w->curved = w->trial + many;
    room = w->curved + w->limits * (3 + size);
    p->dof[g] = p->nis[g] = 0.0;
    w->is_done = !p->selected[g];
    if (w->is_done) continue;
    open++;
    for (int r = 0; r < many; r++) w->trial[r] = x[place_x[r]];
    for (int r = 0; r < size; r++) {
      w->trial_prior[r] = eta[place[r]];
      for (int c = 0; c < size; c++)
        w->trial_information[r * size + c] = information[place[r] * n + place[c]];
    }
    double triangle[MOST * MOST], mean[MOST];
    memcpy(triangle, w->trial_information, size * size * sizeof(double));
    if (!factor(triangle, size)) return -1;
    memcpy(mean, w->trial_prior, size * sizeof(double));
    solve(triangle, mean, size);
    w->trial_cost = dot(mean, w->trial_prior, size) / 2;
  }
  memcpy(p->input, x, total * sizeof(double));
  for (int64_t i = 0; i < p->observations; i++) p->squares[i] = 0.0, p->weights[i] = 1.0;
  while (open && rounds < MOST_ROUNDS) {
    rounds++;
    for (int64_t g = 0; g < groups; g++)
      if (!works[g].is_done)
        for (int r = 0; r < works[g].m; r++) p->input[p->place_x[p->first_x[g] + r]] = works[g].trial[r];
    if (call(p->compute, p->input, p->output, NULL, NULL)) return -2;
    for (int64_t g = 0; g < groups; g++) {
      Work *w = works + g;
      if (w->is_done) continue;
      if (!judge(p, g, w, (int)loss, log_inlier)) return -3;
      if (!go_on(p, g, w)) return -4;
      open -= w->is_done;
    }
  }
  for (int64_t g = 0; g < groups; g++) {
    const Work *w = works + g;
    if (!p->selected[g]) continue;
    double triangle[MOST * MOST], mean[MOST];
    memcpy(triangle, w->information, w->n * w->n * sizeof(double));
    if (!factor(triangle, w->n)) return -5;
    const double before = log_determinant(triangle, w->n);
    memcpy(triangle, w->matrix, w->n * w->n * sizeof(double));
    if (!factor(triangle, w->n)) return -6;
    memcpy(mean, w->vector, w->n * sizeof(double));
    solve(triangle, mean, w->n);
    /* The least cost without limits: in the linear case this is the innovation squared in S⁻¹. */
    p->nis[g] = fmax(2 * w->posterior_cost - dot(mean, w->vector, w->n), 0.0);
    evidence[g] += (before - log_determinant(triangle, w->n)) / 2;
    evidence[g] -= w->posterior_cost + w->excess - w->outside;
    for (int64_t k = p->first_watch[g]; k < p->first_watch[g + 1]; k++) {
      const int64_t i = p->watch[k];
      if (!p->mask[i]) continue;
      evidence[g] -= p->log_scale[i];
      if (p->weights[i] >= 0.5) p->dof[g] += (double)p->size[i];
    }
    for (int r = 0; r < w->m; r++) x[p->place_x[p->first_x[g] + r]] = w->x[r];
    put(p, g, w->vector, w->matrix, eta, information, n);
    put(p, g, w->prior, w->information, eta_before, information_before, n);
  }
  return rounds;
}

/* Move x on, and add variances to the covariance, of each coordinate, where these are the tangent; then to
   the most probable place inside the bounds. Returns 0, or less if it gave up. */
EXPORTED int64_t predict(const Problem *p, const double *moved, const double *grown) {
  const int64_t total = p->coordinates;
  double *x = p->belief, *eta = x + total, *information = eta + total + p->groups;
  for (int64_t g = 0; g < p->groups; g++) {
    const int64_t *place = p->place + p->first[g];
    const int n = (int)(p->first[g + 1] - p->first[g]);
    double triangle[MOST * MOST], covariance[MOST * MOST], after[MOST * MOST];
    double step[MOST], vector[MOST], there[MOST], back[1];
    Bounds b;
    int is_moved = 0;
    for (int i = 0; i < n; i++) is_moved |= moved[place[i]] != 0.0 || grown[place[i]] != 0.0;
    if (!is_moved) continue;
    for (int r = 0; r < n; r++)
      for (int c = 0; c < n; c++) triangle[r * n + c] = information[place[r] * total + place[c]];
    if (!factor(triangle, n)) return -1;
    invert(triangle, covariance, n);
    for (int i = 0; i < n; i++) step[i] = eta[place[i]], there[i] = x[place[i]] + moved[place[i]];
    solve(triangle, step, n);
    for (int i = 0; i < n; i++) covariance[i * n + i] += grown[place[i]];
    memcpy(triangle, covariance, n * n * sizeof(double));
    if (!factor(triangle, n)) return -2;
    invert(triangle, after, n);
    memcpy(vector, step, n * sizeof(double));
    solve(triangle, vector, n);
    gather(p, g, there, NULL, &b);
    if (!is_within(&b, step, n) && !between(&b, covariance, step, n)) return -3;
    carry(after, vector, step, NULL, n);
    move(p, g, there, step, back);
    for (int i = 0; i < n; i++) x[place[i]] = there[i];
    put(p, g, vector, after, eta, information, total);
  }
  return 0;
}

/* The number of the first pose that is seen and not rigid; -1 if all are. */
EXPORTED int64_t first_broken(const Problem *p, double rigid) {
  for (int64_t i = 0; i < p->observations; i++) {
    const double *t = p->numbers + p->seen[i];
    if (!p->mask[i] || !p->is_pose[i]) continue;
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
