/* Fit of a joint, and the evidence of a family with its joint values integrated out. */

#include "identification/levenberg_marquardt.h"

/* Joint values of each observation, the ranges of their values, and the information of the parameters. */

/* PerObservation and JointRanges in marginal_likelihood.py. */
typedef struct {
  double *values, *covariances, log_likelihood, deviations[6], mean[6], log_density;
} Apart;

/* As solve_per_observation in marginal_likelihood.py. */
static void alone(const Problem *p, const double *joint_values, const double *residuals, const double *errors,
                  const double *by_joints, Apart *apart) {
  int m = (int)p->rows, n = (int)p->joints;
  double log_likelihood = 0.0, *values = apart->values, *covariances = apart->covariances;
  memcpy(values, joint_values, p->count * n * sizeof(double));
  for (int64_t k = 0; k < p->count; k++) {
    const double *J = by_joints + m * n * k, *e = residuals + m * k;
    double W[36], weighted[36], curvature[36], slope[6], left[6], *C = covariances + n * n * k;
    double root = invert(errors + m * m * k, m, W);
    for (int i = 0; i < n; i++) {
      slope[i] = 0.0;
      for (int r = 0; r < m; r++) {
        double sum = 0.0;
        for (int s = 0; s < m; s++) sum += W[m * r + s] * J[n * s + i];
        weighted[m * i + r] = sum;
        slope[i] += sum * e[r];
      }
    }
    for (int i = 0; i < n; i++)
      for (int j = 0; j < n; j++) {
        double sum = i == j ? p->little : 0.0;
        for (int r = 0; r < m; r++) sum += weighted[m * i + r] * J[n * r + j];
        curvature[n * i + j] = sum;
      }
    double known = n ? invert(curvature, n, C) : 1.0;
    for (int r = 0; r < m; r++) left[r] = e[r];
    for (int i = 0; i < n; i++) {
      double change = 0.0;
      for (int j = 0; j < n; j++) change += C[n * i + j] * slope[j];
      values[n * k + i] += change;
      for (int r = 0; r < m; r++) left[r] -= J[n * r + i] * change;
    }
    /* |C| is one over the square of the root that is known. */
    log_likelihood -= 0.5 * squared(left, W, m) + log(root * known) + 0.5 * (m - n) * log(TAU);
  }
  apart->log_likelihood = log_likelihood;
}

/* The log of the density of values around 0 at a width, with their mean integrated out. */
static double density(int64_t count, const double *values, const double *variances, double width,
                      double observation_weight) {
  double s0 = 0.0, s1 = 0.0, s2 = 0.0, product = 1.0, logs = 0.0;
  for (int64_t i = 0; i < count; i++) {
    double weight = 1.0 / (variances[i] + width * width), pulled = weight * values[i];
    s0 += weight;
    s1 += pulled;
    s2 += pulled * values[i];
    product *= weight;
    if (i % 8 == 7) { /* so many are far from what a double can hold */
      logs += log(product);
      product = 1.0;
    }
  }
  logs += log(product);
  return 0.5 * (observation_weight * (logs - (s2 - s1 * s1 / s0)) - log(s0));
}

/* The best width of several columns of values, and the logarithm of the mean over all of them relative to the
   best. */
static double widest(const Problem *p, double weight, int64_t columns, const double *values,
                     const double *variances, double *logs, double *deviation) {
  int64_t top = 0, count = p->count;
  double sum = 0.0, best;
  for (int64_t g = 0; g < p->widths; g++) {
    logs[g] = 0.0;
    for (int64_t c = 0; c < columns; c++)
      logs[g] += density(count, values + count * c, variances + count * c, p->grid[g], weight);
    if (logs[g] > logs[top]) top = g;
  }
  best = log(p->grid[top]);
  if (top > 0 && top < p->widths - 1) {
    double before = logs[top - 1], here = logs[top], after = logs[top + 1];
    best += 0.5 * log(p->grid[1] / p->grid[0]) * (after - before) / (2.0 * here - before - after);
  }
  *deviation = exp(best);
  for (int64_t g = 0; g < p->widths; g++) sum += exp(logs[g] - logs[top]);
  return log(sum / p->widths);
}

/* The inverse of C + diag(s^2); returns the root of the determinant. */
INLINE double widened(const double *covariance, int n, const double *deviations, double *inverse) {
  double total[36];
  for (int i = 0; i < n * n; i++) total[i] = covariance[i];
  for (int i = 0; i < n; i++) total[(n + 1) * i] += deviations[i] * deviations[i];
  return invert(total, n, inverse);
}

/* As fit_joint_ranges in marginal_likelihood.py. */
static void widths(const Problem *p, double weight, Apart *apart, double *memory) {
  int n = (int)p->joints;
  const double *values = apart->values, *covariances = apart->covariances;
  double *deviations = apart->deviations, *mean = apart->mean;
  int64_t count = p->count;
  double result = 0.0, normal[36] = {0}, right[6] = {0}, inverse[36], W[36];
  double *variances = memory + count * n, *logs = variances + count * n;
  for (int64_t kind = 0; kind < ALL; kind++) {
    int64_t columns = 0;
    double width;
    for (int j = 0; j < n; j++) {
      if (p->kind[j] != kind) continue;
      double *column = memory + count * columns, *variance = variances + count * columns++, middle = 0.0;
      for (int64_t k = 0; k < count; k++) middle += values[n * k + j] / count;
      for (int64_t k = 0; k < count; k++) {
        column[k] = values[n * k + j] - middle;
        variance[k] = covariances[n * n * k + (n + 1) * j];
      }
    }
    if (!columns) continue;
    result += widest(p, weight, columns, memory, variances, logs, &width);
    for (int j = 0; j < n; j++)
      if (p->kind[j] == kind) deviations[j] = width;
  }
  for (int64_t k = 0; k < count; k++) {
    widened(covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++)
      for (int j = 0; j < n; j++) {
        normal[n * i + j] += W[n * i + j];
        right[i] += W[n * i + j] * (values[n * k + j] - values[j]);
      }
  }
  invert(normal, n, inverse);
  for (int i = 0; i < n; i++) {
    mean[i] = values[i];
    for (int j = 0; j < n; j++) mean[i] += inverse[n * i + j] * right[j];
  }
  for (int64_t k = 0; k < count; k++) {
    double off[6], root = widened(covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++) off[i] = values[n * k + i] - mean[i];
    result -= weight * (0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU));
  }
  apart->log_density = result;
}


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
