/* Fit of a joint, and the evidence of a family with its joint values integrated out. */

#include "identification/joint_ranges.h"

#define ATOM 1e-10

/* How many numbers of memory the functions below need. */
EXPORTED int64_t memory_of(int64_t count) {
  return 1000 + count * (72 + 3 * (int64_t)(sizeof(Observation) / sizeof(double)));
}

/* Joint values, their covariances and the information of parameters and means, by observations and ranges. */
static void inform(const Problem *p, const double *x, const double *errors, double weight, const Apart *apart,
                   double *values, double *covariances, double *information) {
  int rows = (int)p->rows, joints = (int)p->joints, size = (int)p->size, n = size + joints;
  double total[UNKNOWNS * UNKNOWNS] = {0}, normal[MOST * MOST] = {0}, right[MOST] = {0};
  Observation o;
  for (int64_t k = 0; k < p->count; k++) {
    const double *C = apart->covariances + joints * joints * k, *S = errors + rows * rows * k;
    double W[36], moved[36], both[6 * UNKNOWNS] = {0}, weighted[6 * UNKNOWNS] = {0};
    if (joints) widened(C, joints, apart->deviations, W);
    for (int i = 0; i < joints; i++) {
      double square = apart->deviations[i] * apart->deviations[i], change = 0.0;
      for (int j = 0; j < joints; j++) {
        double sum = 0.0;
        for (int l = 0; l < joints; l++) sum += W[joints * i + l] * C[joints * l + j];
        covariances[joints * joints * k + joints * i + j] = square * sum;
        change += square * W[joints * i + j] * (apart->values[joints * k + j] - apart->mean[j]);
      }
      values[joints * k + i] = o.values[i] = apart->mean[i] + change;
    }
    place(p, x, &o, rows);
    for (int r = 0; r < rows; r++) {
      for (int s = 0; s < rows; s++) {
        moved[rows * r + s] = S[rows * r + s];
        for (int j = 0; j < joints; j++) {
          const double *J = o.by_joints + 6 * j;
          moved[rows * r + s] += apart->deviations[j] * apart->deviations[j] * J[r] * J[s];
        }
      }
      memcpy(both + UNKNOWNS * r, o.by_parameters + MOST * r, size * sizeof(double));
      for (int j = 0; j < joints; j++) both[UNKNOWNS * r + size + j] = o.by_joints[6 * j + r];
    }
    invert(moved, rows, W);
    for (int r = 0; r < rows; r++)
      for (int s = 0; s < rows; s++)
        for (int i = 0; i < UNKNOWNS; i++)
          weighted[UNKNOWNS * r + i] += W[rows * r + s] * both[UNKNOWNS * s + i];
    for (int i = 0; i < n; i++)
      for (int r = 0; r < rows; r++)
        for (int j = 0; j < UNKNOWNS; j++)
          total[UNKNOWNS * i + j] += both[UNKNOWNS * r + i] * weighted[UNKNOWNS * r + j];
  }
  believe(p, x, normal, right);
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++)
      information[n * i + j] = weight * total[UNKNOWNS * i + j] + (i == j ? p->regular[i] : 0.0) +
                               (i < size && j < size ? normal[MOST * i + j] : 0.0);
}

/* The logarithm of the volume of mean poses per unit of the parameters and joint values that move them, by
   the lengths of their columns across those before. A lever of length zero has none, but ATOM [m]. */
static double log_volume(const Problem *p, const double *x, const double *mean) {
  int rows = (int)p->rows, movers = (int)p->movers;
  double column[6 * (MOST + ALL)], log_sum = 0.0;
  Observation o;
  if (movers < 0) return 0.0;
  memcpy(o.values, mean, p->joints * sizeof(double));
  place(p, x, &o, rows);
  for (int i = 0; i < movers + (int)p->joints; i++) {
    double *own = column + 6 * i, square = 0.0;
    for (int r = 0; r < rows; r++)
      own[r] = i < movers ? o.by_parameters[MOST * r + p->mover[i]] : o.by_joints[6 * (i - movers) + r];
    for (int j = 0; j < i; j++) {
      double along = 0.0;
      for (int r = 0; r < rows; r++) along += own[r] * column[6 * j + r];
      for (int r = 0; r < rows; r++) own[r] -= along * column[6 * j + r];
    }
    for (int r = 0; r < rows; r++) square += own[r] * own[r];
    double length = fmax(sqrt(square), ATOM);
    for (int r = 0; r < rows; r++) own[r] /= length;
    log_sum += log(length);
  }
  return log_sum;
}

/* As integrate_joint_values in marginal_likelihood.py, for several sizes of the noise. The covariance of the
   errors is the sum of two parts, times the square of a factor each; without parts it is as it is. The result
   is of the last size: log likelihood, widths, means, information, joint values alone and within their ranges,
   and the covariances of both. */
EXPORTED void rate(const Problem *p, int64_t sizes, const double *factors, const double *parts, double weight,
                   double *memory, const double *x, const double *joint_values, const double *residuals,
                   const double *errors, const double *by_joints, double *logs, double *result) {
  int64_t joints = p->joints, each = p->count * joints, numbers = p->count * p->rows * p->rows;
  int n = (int)(p->size + joints);
  double *log_likelihood = result, *deviations = result + 1, *mean = deviations + joints;
  double *information = mean + joints, *alone_values = information + n * n, *values = alone_values + each;
  double *alone_covariances = values + each, *covariances = alone_covariances + each * joints;
  double *scaled = memory + p->widths + 2 * each, copied[UNKNOWNS * UNKNOWNS];
  Apart apart = {.values = alone_values, .covariances = alone_covariances};
  watch_begin(&watch, INFINITY);
  for (int64_t i = 0; i < sizes && !look_at_clock(&watch); i++) {
    double place = factors[2 * i] * factors[2 * i], turn = factors[2 * i + 1] * factors[2 * i + 1];
    for (int64_t k = 0; parts && k < numbers; k++) scaled[k] = place * parts[k] + turn * parts[numbers + k];
    const double *S = parts ? scaled : errors;
    alone(p, joint_values, residuals, S, by_joints, &apart);
    if (joints) widths(p, weight, &apart, memory);
    inform(p, x, S, weight, &apart, values, covariances, information);
    memcpy(copied, information, n * n * sizeof(double));
    double root = factorise(copied, n);
    logs[i] = weight * apart.log_likelihood + apart.log_density + log_volume(p, x, apart.mean) +
              0.5 * n * log(TAU) - (root > 0.0 ? log(root) : INFINITY);
    *log_likelihood = apart.log_likelihood;
    memcpy(deviations, apart.deviations, joints * sizeof(double));
    memcpy(mean, apart.mean, joints * sizeof(double));
  }
}

/* As levenberg_marquardt in least_squares.py, from the parents of the answer and the best of several starts
   after a few steps. Starts are a state and joint values each. The evidence comes with it. */
EXPORTED void solve(Problem *p, int64_t starts, const double *begin, int64_t few, int64_t steps,
                    double *memory, double *answer) {
  Answer a = lay(p, answer);
  const double one[2] = {1.0, 1.0};
  double *work = memory;
  int64_t values = p->count * p->joints;
  memory = prepare(p->parent_covariance, p->count, 6, memory, &p->of_parent);
  memory = prepare(p->child_covariance, p->count, p->rows, memory, &p->of_child);
  Observation *best = (Observation *)memory, *here = best + p->count, *there = here + p->count;
  watch_begin(&watch, INFINITY);
  for (int64_t s = 0; s < starts; s++, begin += p->states + values) {
    double x[STATES], cost;
    memcpy(x, begin, p->states * sizeof(double));
    for (int64_t k = 0; k < p->count; k++) {
      memcpy(here[k].parent, a.parents + 16 * k, sizeof here[k].parent);
      memcpy(here[k].values, begin + p->states + p->joints * k, p->joints * sizeof(double));
    }
    int converged = settle(p, x, &here, &there, starts > 1 ? few : steps, &cost);
    if (s && !(cost < *a.cost)) continue;
    Observation *other = best;
    best = here;
    here = other;
    memcpy(a.x, x, p->states * sizeof(double));
    *a.cost = cost;
    *a.converged = converged;
  }
  if (starts > 1 && !*a.converged) *a.converged = settle(p, a.x, &best, &there, steps, a.cost);
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = best + k;
    int64_t each = p->rows * k;
    memcpy(a.parents + 16 * k, o->parent, sizeof o->parent);
    memcpy(a.values + p->joints * k, o->values, p->joints * sizeof(double));
    memcpy(a.residuals + each, o->residual, p->rows * sizeof(double));
    memcpy(a.covariances + p->rows * each, o->covariance, p->rows * p->rows * sizeof(double));
    keep(p, o, a.poses + 16 * k, a.by_parameters + p->size * each, a.by_joints + p->joints * each);
  }
  rate(p, 1, one, NULL, 1.0, work, a.x, a.values, a.residuals, a.covariances, a.by_joints, a.integral,
       a.integral + 1);
}
