"""C text: joint values of each observation alone, and how wide the motion is, as in :mod:`.widths`."""

WIDTHS = r"""
/* As alone in widths.py, for errors whose covariances are larger by a factor. Returns the logarithm of the
   likelihood. */
static double alone(const Problem *p, const Answer *a, double factor, double *values, double *covariances) {
  int m = (int)p->rows, n = (int)p->joints;
  double log_likelihood = 0.0;
  memcpy(values, a->values, p->count * n * sizeof(double));
  for (int64_t k = 0; k < p->count; k++) {
    const double *J = a->by_joints + m * n * k, *e = a->residuals + m * k;
    double W[36], weighted[36], curvature[36], slope[6], left[6], *C = covariances + n * n * k;
    double S[36], root;
    for (int i = 0; i < m * m; i++) S[i] = factor * a->covariances[m * m * k + i];
    root = invert(S, m, W);
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
  return log_likelihood;
}

/* The log of the density of values at a width, with their mean integrated out. */
static double density(int64_t count, int64_t block, const double *values, const double *variances,
                      double width, double *weights) {
  double sum[6] = {0}, mean[6] = {0}, squares = 0.0, logs = 0.0, product = 1.0;
  for (int64_t i = 0; i < count * block; i++) weights[i] = 1.0 / (variances[i] + width * width);
  for (int64_t i = 0; i < count * block; i++) {
    /* A logarithm of eight at once. */
    product *= weights[i];
    if (i % 8 == 7 || i + 1 == count * block) {
      logs += log(product);
      product = 1.0;
    }
  }
  for (int64_t k = 0; k < count; k++)
    for (int64_t b = 0; b < block; b++) {
      sum[b] += weights[block * k + b];
      mean[b] += weights[block * k + b] * values[block * k + b];
    }
  for (int64_t b = 0; b < block; b++) {
    mean[b] /= sum[b];
    logs -= log(sum[b]);
  }
  for (int64_t k = 0; k < count; k++)
    for (int64_t b = 0; b < block; b++) {
      double off = values[block * k + b] - mean[b];
      squares += off * off * weights[block * k + b];
    }
  return 0.5 * (logs - squares);
}

/* The best width, and the logarithm of the mean over all of them relative to the best. */
static double widest(int64_t count, int64_t block, const double *values, const double *variances,
                     int64_t size, const double *grid, double *weights, double *logs, double *deviation) {
  int64_t top = 0;
  double sum = 0.0, best;
  for (int64_t g = 0; g < size; g++) {
    logs[g] = density(count, block, values, variances, grid[g], weights);
    if (logs[g] > logs[top]) top = g;
  }
  best = log(grid[top]);
  if (top > 0 && top < size - 1) {
    double before = logs[top - 1], here = logs[top], after = logs[top + 1];
    best += 0.5 * log(grid[1] / grid[0]) * (after - before) / (2.0 * here - before - after);
  }
  *deviation = exp(best);
  for (int64_t g = 0; g < size; g++) sum += exp(logs[g] - logs[top]);
  return log(sum / size);
}

/* The inverse of C + diag(s^2); returns the root of the determinant. */
FAST double widened(const double *covariance, int n, const double *deviations, double *inverse) {
  double total[36];
  for (int i = 0; i < n * n; i++) total[i] = covariance[i];
  for (int i = 0; i < n; i++) total[(n + 1) * i] += deviations[i] * deviations[i];
  return invert(total, n, inverse);
}

/* As widths in widths.py. Returns the logarithm of the density. */
static double widths(const Problem *p, const double *values, const double *covariances,
                     double *deviations, double *mean, double *memory) {
  int n = (int)p->joints;
  int64_t count = p->count;
  double result = 0.0, normal[36] = {0}, right[6] = {0}, inverse[36], W[36];
  double *variances = memory + count * n, *weights = variances + count * n, *logs = weights + count * n;
  for (int64_t kind = 0; kind < 2; kind++) {
    int64_t block = 0, at = 0;
    double width;
    for (int j = 0; j < n; j++) block += p->kind[j] == kind;
    if (!block) continue;
    for (int64_t k = 0; k < count; k++)
      for (int j = 0; j < n; j++)
        if (p->kind[j] == kind) {
          memory[at] = values[n * k + j];
          variances[at++] = covariances[n * n * k + (n + 1) * j];
        }
    result += widest(count, block, memory, variances, p->widths, p->grid, weights, logs, &width);
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
    result -= 0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU);
  }
  return result;
}
"""
