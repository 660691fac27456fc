/* Fit of a joint, and the evidence of a family with its joint values integrated out. */

#include "identification/joint_ranges.h"

#define ATOM 1e-10

/* How many numbers of memory the functions below need. */
EXPORTED int64_t memory_of(int64_t count) {
  return 1000 + count * (72 + 2 * (int64_t)(sizeof(Observation) / sizeof(double)));
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

/* The logarithm of the volume of mean poses per unit of the parameters and joint values that move them. A lever
   of length zero has no volume; a singular value is at least ATOM [m]. */
static double log_volume(const Problem *p, const double *x, const double *mean) {
  int rows = (int)p->rows, movers = (int)p->movers, n = movers + (int)p->joints;
  double square[36], column[36];
  Observation o;
  if (movers < 0) return 0.0;
  memcpy(o.values, mean, p->joints * sizeof(double));
  place(p, x, &o, rows);
  for (int i = 0; i < n; i++)
    for (int r = 0; r < rows; r++)
      column[6 * i + r] =
          i < movers ? o.by_parameters[MOST * r + p->mover[i]] : o.by_joints[6 * (i - movers) + r];
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) {
      square[n * i + j] = i == j ? ATOM * ATOM : 0.0;
      for (int r = 0; r < rows; r++) square[n * i + j] += column[6 * i + r] * column[6 * j + r];
    }
  return log(factorise(square, n));
}

/* As integrate_joint_values in marginal_likelihood.py, for several sizes of the noise. The covariance of the
   errors is the sum of two parts, times the square of a factor each; without parts it is as it is. The result is
   of the last size: log likelihood, widths, means, information, joint values alone and within their ranges, and
   the covariances of both. */
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
    logs[i] = weight * apart.log_likelihood + apart.log_density + log_volume(p, x, apart.mean) +
              0.5 * n * log(TAU) - log(factorise(copied, n));
    *log_likelihood = apart.log_likelihood;
    memcpy(deviations, apart.deviations, joints * sizeof(double));
    memcpy(mean, apart.mean, joints * sizeof(double));
  }
}
