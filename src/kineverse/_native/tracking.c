/* Iterated MAP update of tracking.

   The algorithm is that of estimation/tracking/map_update.py, in the same order. On failure it returns an
   error code and leaves the state unchanged. */

#include "tracking/residuals.h"

#define CONVERGED 1e-10  /* the square of a step in standard deviations that is the last */
#define MOST_ROUNDS 50
#define MOST_DAMPING 1e9
#define HALF_TURN 3.141592653589793

/* A group on its way, in n directions and m coordinates: posterior matrix and vector, best place and belief,
   trial and its belief. */
typedef struct {
  int n, m, is_done, is_begun;
  double *matrix, *vector, *x, *prior, *information, *trial, *trial_prior, *trial_information;
  double cost, prior_cost, trial_cost, posterior_cost, damping;
} Work;

static int is_finite(const double *a, int n) {
  for (int i = 0; i < n; i++)
    if (!isfinite(a[i])) return 0;
  return 1;
}

/* Make the trial the best place, if it is better; 0 if there is none to begin at. */
static int judge(const Problem *p, int64_t g, Work *w, const double *seen, const uint8_t *mask,
                 const double *whitening) {
  const int n = w->n;
  double matrix[MOST * MOST], vector[MOST], cost = w->trial_cost;
  memcpy(matrix, w->trial_information, n * n * sizeof(double));
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
  memcpy(w->x, w->trial, w->m * sizeof(double));
  memcpy(w->prior, w->trial_prior, n * sizeof(double));
  memcpy(w->information, w->trial_information, n * n * sizeof(double));
  memcpy(w->matrix, matrix, n * n * sizeof(double));
  memcpy(w->vector, vector, n * sizeof(double));
  w->prior_cost = w->trial_cost, w->cost = w->posterior_cost = cost;
  w->damping = w->damping > 1e-6 ? w->damping / 10 : 0.0;
  return 1;
}

/* Find the next trial, or settle; 0 if that is impossible. */
static int go_on(const Problem *p, int64_t g, Work *w) {
  const int n = w->n;
  const int64_t *own = p->own + p->first[g];
  double damped[MOST * MOST], inverse[MOST * MOST], step[MOST], low[MOST], high[MOST], back[MOST * MOST];
  memcpy(damped, w->matrix, n * n * sizeof(double));
  for (int i = 0; i < n; i++) damped[i * n + i] *= 1 + w->damping;
  double triangle[MOST * MOST];
  memcpy(triangle, damped, n * n * sizeof(double));
  if (!factor(triangle, n)) return 0;
  memcpy(step, w->vector, n * sizeof(double));
  solve(triangle, step, n);
  bounds(p, g, w->x, low, high);
  int is_inside = 1;
  for (int i = 0; i < n; i++) is_inside &= step[i] >= low[i] && step[i] <= high[i];
  if (!is_inside) {
    invert(triangle, inverse, n);
    if (!between(inverse, step, low, high, n)) return 0;
  }
  double turned = 0.0;
  for (int i = 0; i < n; i++)
    if (own[i] < 0) turned = fmax(turned, fabs(step[i]));
  if (turned > HALF_TURN)
    for (int i = 0; i < n; i++) step[i] *= HALF_TURN / turned;
  memcpy(w->trial, w->x, w->m * sizeof(double));
  const int moved = move(p, g, w->trial, step, back);
  if (!moved) return 0;
  double along = 0.0;
  for (int r = 0; r < n; r++) along += w->prior[r] * step[r];
  w->trial_cost = w->prior_cost - along + quadratic(w->information, step, n) / 2;
  memcpy(w->trial_prior, w->prior, n * sizeof(double));
  memcpy(w->trial_information, w->information, n * n * sizeof(double));
  carry(w->trial_information, w->trial_prior, step, moved == 2 ? back : NULL, n);
  if (quadratic(damped, step, n) <= CONVERGED || w->damping > MOST_DAMPING) {
    along = 0.0;
    for (int r = 0; r < n; r++) along += w->vector[r] * step[r];
    w->posterior_cost += quadratic(w->matrix, step, n) / 2 - along;
    carry(w->matrix, w->vector, step, moved == 2 ? back : NULL, n);
    memcpy(w->x, w->trial, w->m * sizeof(double));
    w->is_done = 1;
  }
  return 1;
}

/* What the bounds cost before anything is seen, for a mean at a step from x; below 0 if that is not known. */
static double beyond(const Problem *p, int64_t g, const Work *w, const double *triangle, const double *mean) {
  const int n = w->n;
  double inverse[MOST * MOST], step[MOST], low[MOST], high[MOST], cost = 0.0;
  int is_inside = 1;
  bounds(p, g, w->x, low, high);
  for (int i = 0; i < n; i++) {
    step[i] = mean[i];
    is_inside &= mean[i] >= low[i] && mean[i] <= high[i];
  }
  if (is_inside) return 0.0;
  invert(triangle, inverse, n);
  if (!between(inverse, step, low, high, n)) return -1.0;
  for (int r = 0; r < n; r++)
    for (int c = 0; c < n; c++)
      cost += (step[r] - mean[r]) * w->information[r * n + c] * (step[c] - mean[c]);
  return cost > 0.0 ? cost / 2 : 0.0;
}

/* Update x, η, log evidence of groups and Λ, which lie one after the other; nis and dof of groups are
   results. Groups of which nothing is seen stay. Returns the number of rounds; below 0, it gave up. */
EXPORTED int64_t update(const Problem *p, double *belief, const double *seen, const uint8_t *mask,
                        const double *whitening, const double *log_scale, double *nis, double *dof) {
  const int64_t n = p->directions, groups = p->groups;
  double *x = belief, *eta = x + p->coordinates, *evidence = eta + n, *information = evidence + groups;
  Work works[groups];
  double *room = p->work, before[groups], outside[groups], triangle[MOST * MOST];
  int64_t open = 0, rounds = 0;
  for (int64_t g = 0; g < groups; g++) {
    Work *w = works + g;
    const int64_t *place = p->place + p->first[g], *place_x = p->place_x + p->first_x[g];
    const int size = (int)(p->first[g + 1] - p->first[g]), many = (int)(p->first_x[g + 1] - p->first_x[g]);
    *w = (Work){.n = size, .m = many, .is_done = 1};
    w->vector = room, w->prior = room + size, w->trial_prior = room + 2 * size, w->matrix = room + 3 * size;
    w->information = w->matrix + size * size, w->trial_information = w->information + size * size;
    w->x = w->trial_information + size * size, w->trial = w->x + many;
    room = w->trial + many;
    dof[g] = nis[g] = 0.0;
    for (int64_t k = p->first_watch[g]; k < p->first_watch[g + 1]; k++)
      if (mask[p->watch[k]]) dof[g] += (double)p->size[p->watch[k]], w->is_done = 0;
    if (w->is_done) continue;
    open++;
    for (int r = 0; r < many; r++) w->x[r] = w->trial[r] = x[place_x[r]];
    for (int r = 0; r < size; r++) {
      w->prior[r] = w->trial_prior[r] = eta[place[r]];
      for (int c = 0; c < size; c++) w->information[r * size + c] = information[place[r] * n + place[c]];
    }
    memcpy(w->trial_information, w->information, size * size * sizeof(double));
    memcpy(triangle, w->information, size * size * sizeof(double));
    if (!factor(triangle, size)) return -1;
    before[g] = log_determinant(triangle, size);
    double mean[MOST], along = 0.0;
    memcpy(mean, w->prior, size * sizeof(double));
    solve(triangle, mean, size);
    for (int r = 0; r < size; r++) along += mean[r] * w->prior[r];
    w->trial_cost = along / 2;
    outside[g] = beyond(p, g, w, triangle, mean);
    if (outside[g] < 0.0) return -7;
  }
  memcpy(p->input, x, p->coordinates * sizeof(double));
  while (open) {
    if (++rounds > MOST_ROUNDS) return -2;
    for (int64_t g = 0; g < groups; g++)
      if (!works[g].is_done)
        for (int r = 0; r < works[g].m; r++) p->input[p->place_x[p->first_x[g] + r]] = works[g].trial[r];
    if (call(p->compute, p->input, p->output, NULL, NULL)) return -3;
    for (int64_t g = 0; g < groups; g++) {
      Work *w = works + g;
      if (w->is_done) continue;
      if (!judge(p, g, w, seen, mask, whitening)) return -4;
      if (!go_on(p, g, w)) return -5;
      open -= w->is_done;
    }
  }
  for (int64_t g = 0; g < groups; g++) {
    Work *w = works + g;
    if (!dof[g]) continue;
    const int64_t *place = p->place + p->first[g], *place_x = p->place_x + p->first_x[g];
    double mean[MOST], along = 0.0;
    if (p->rates[g]) {
      memcpy(triangle, w->trial_information, w->n * w->n * sizeof(double));
      if (!factor(triangle, w->n)) return -8;
      before[g] = log_determinant(triangle, w->n);
    }
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
    for (int r = 0; r < w->m; r++) x[place_x[r]] = w->x[r];
    for (int r = 0; r < w->n; r++) {
      eta[place[r]] = w->vector[r];
      for (int c = 0; c < w->n; c++) information[place[r] * n + place[c]] = w->matrix[r * w->n + c];
    }
  }
  return rounds;
}

/* Move x on, and add variances to the covariance, of each coordinate, where these are the tangent; then to
   the most probable place inside the bounds. Returns 0, or less if it gave up. */
EXPORTED int64_t predict(const Problem *p, double *belief, const double *moved, const double *grown) {
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
EXPORTED int64_t first_broken(const Problem *p, const double *seen, const uint8_t *mask, double rigid) {
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
