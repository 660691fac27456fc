"""C text of joint ranges, sliding points and mirrored joint values."""

JOINT_RANGES = r"""
/* Observations alone, and the width of the motion: PerObservation and JointRanges in range_prior.py. */
typedef struct {
  double *values, *covariances, log_likelihood, deviations[6], mean[6], log_density;
} Apart;

/* As solve_per_observation in range_prior.py. The log likelihood is times the weight of observations. */
static void alone(const Problem *p, const Answer *a, Apart *apart) {
  int m = (int)p->rows, n = (int)p->joints;
  double log_likelihood = 0.0, *values = apart->values, *covariances = apart->covariances;
  memcpy(values, a->values, p->count * n * sizeof(double));
  for (int64_t k = 0; k < p->count; k++) {
    const double *J = a->by_joints + m * n * k, *e = a->residuals + m * k;
    double W[36], weighted[36], curvature[36], slope[6], left[6], *C = covariances + n * n * k;
    double root = invert(a->covariances + m * m * k, m, W);
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
  apart->log_likelihood = p->weight * log_likelihood;
}

/* Fold products of at most eight weights into a logarithm: so many are far from what a double can hold. */
static double logs_of(double *product) {
  double sum = log(product[0] * product[1] * product[2]) + log(product[3] * product[4] * product[5]) +
               log(product[6] * product[7]);
  for (int l = 0; l < 8; l++) product[l] = 1.0;
  return sum;
}

/* The log of the density of values around 0 at a width, with their mean integrated out; eight at once. */
static double density(int64_t count, const double *values, const double *variances, double width,
                      double weight) {
  double s0[8] = {0}, s1[8] = {0}, s2[8] = {0}, product[8] = {1, 1, 1, 1, 1, 1, 1, 1};
  double square = width * width, logs = 0.0;
  int64_t whole = count - count % 8;
  for (int64_t i = 0; i < whole; i += 8) {
    for (int l = 0; l < 8; l++) {
      double weight = 1.0 / (variances[i + l] + square), pulled = weight * values[i + l];
      s0[l] += weight;
      s1[l] += pulled;
      s2[l] += pulled * values[i + l];
      product[l] *= weight;
    }
    if (i % 64 == 56) logs += logs_of(product);
  }
  for (int64_t i = whole; i < count; i++) {
    double weight = 1.0 / (variances[i] + square), pulled = weight * values[i];
    s0[i - whole] += weight;
    s1[i - whole] += pulled;
    s2[i - whole] += pulled * values[i];
    product[i - whole] *= weight;
  }
  logs += logs_of(product);
  for (int l = 1; l < 8; l++) {
    s0[0] += s0[l];
    s1[0] += s1[l];
    s2[0] += s2[l];
  }
  return 0.5 * (weight * (logs - (s2[0] - s1[0] * s1[0] / s0[0])) - log(s0[0]));
}

/* The best width of several columns of values, and the logarithm of the mean over all of them relative to the
   best. */
static double widest(const Problem *p, int64_t columns, const double *values, const double *variances,
                     double *logs, double *deviation) {
  int64_t top = 0, count = p->count;
  double sum = 0.0, best;
  for (int64_t g = 0; g < p->widths; g++) {
    logs[g] = 0.0;
    for (int64_t c = 0; c < columns; c++)
      logs[g] += density(count, values + count * c, variances + count * c, p->grid[g], p->weight);
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
FAST double widened(const double *covariance, int n, const double *deviations, double *inverse) {
  double total[36];
  for (int i = 0; i < n * n; i++) total[i] = covariance[i];
  for (int i = 0; i < n; i++) total[(n + 1) * i] += deviations[i] * deviations[i];
  return invert(total, n, inverse);
}

/* As fit_joint_ranges in range_prior.py. */
static void widths(const Problem *p, Apart *apart, double *memory) {
  int n = (int)p->joints;
  const double *values = apart->values, *covariances = apart->covariances;
  double *deviations = apart->deviations, *mean = apart->mean;
  int64_t count = p->count;
  double result = 0.0, normal[36] = {0}, right[6] = {0}, inverse[36], W[36];
  double *variances = memory + count * n, *logs = variances + count * n;
  for (int64_t kind = 0; kind < 2; kind++) {
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
    result += widest(p, columns, memory, variances, logs, &width);
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
    result -= p->weight * (0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU));
  }
  apart->log_density = result;
}

/* Both of them, in memory of their own; returns what is free behind it. */
static double *take_apart(const Problem *p, const Answer *a, Apart *apart, double *memory) {
  apart->values = memory;
  apart->covariances = memory + p->count * p->joints;
  memory = apart->covariances + p->count * p->joints * p->joints;
  alone(p, a, apart);
  apart->log_density = 0.0;
  if (p->joints) widths(p, apart, memory);
  return memory;
}
"""

SLIDING_POINT = r"""
/* The poses of a solution and their derivatives, at its joint values. */
static void place_all(const Problem *p, Answer *a) {
  at(p, p->count, &a->head->motion, a->values, a->poses, a->by_parameters, a->by_joints);
}

/* As optimise_sliding_point in ambiguities.py: motion, values and derivatives are changed in their place. */
static void slide(const Problem *p, Answer *a, double *memory) {
  int joints = (int)p->joints, slides = (int)p->slides, n = joints + slides;
  Motion *m = &a->head->motion;
  double most = slides ? INFINITY : 0.0, *turned = memory;
  memory = turned + 9 * p->count;
  for (int64_t turn = 0; turn < p->sliding_turns && most > p->slid && !look_at_clock(&watch); turn++) {
    double normal[81] = {0}, change[9] = {0};
    Apart apart;
    take_apart(p, a, &apart, memory);
    for (int64_t k = 0; k < p->count; k++) {
      /* What the mean and the point make of joint values. */
      double twist[6] = {0}, W[36], by[54] = {0}, weighted[54], *G = turned + 9 * k;
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = a->values[joints * k + j];
      exponential(twist + 3, G);
      for (int i = 0; i < joints; i++) by[n * i + i] = 1.0;
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++) by[n * i + joints + j] = G[3 * i + j];
      widened(apart.covariances + joints * joints * k, joints, apart.deviations, W);
      for (int i = 0; i < joints; i++)
        for (int c = 0; c < n; c++) {
          weighted[n * i + c] = 0.0;
          for (int j = 0; j < joints; j++) weighted[n * i + c] += W[joints * i + j] * by[n * j + c];
        }
      for (int c = 0; c < n; c++)
        for (int i = 0; i < joints; i++) {
          change[c] += weighted[n * i + c] * apart.values[joints * k + i];
          for (int e = 0; e < n; e++) normal[n * c + e] += weighted[n * i + c] * by[n * i + e];
        }
    }
    double scale = 1.0 / (p->reach_scale * p->reach_scale);
    for (int i = 0; i < slides; i++) {
      normal[(n + 1) * (joints + i)] += scale;
      change[joints + i] -= m->right_p[i] * scale;
    }
    factorise(normal, n);
    resolve(normal, n, change);
    most = 0.0;
    for (int i = 0; i < slides; i++) {
      m->right_p[i] += change[joints + i];
      most = fmax(most, fabs(change[joints + i]));
    }
    for (int64_t k = 0; k < p->count; k++)
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++)
          a->values[joints * k + i] -= turned[9 * k + 3 * i + j] * change[joints + j];
    place_all(p, a);
  }
}
"""

MIRRORED_VALUES = r"""
#define ERRORS 9 /* of the way between both parts and of both orientations */

/* The lower factor of the covariance of these errors; returns the logarithm of its volume. */
static double errors_factor(const Problem *p, int64_t k, double *lower) {
  const double *A = p->of_parent.covariance + p->of_parent.stride * k;
  const double *B = p->of_child.covariance + p->of_child.stride * k;
  int rows = (int)p->rows, n = 3 + rows;
  memset(lower, 0, n * n * sizeof(double));
  for (int i = 0; i < 6; i++)
    for (int j = 0; j < 6; j++) lower[n * i + j] = (i < 3) == (j < 3) ? A[6 * i + j] : -A[6 * i + j];
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < rows; j++) lower[n * (i < 3 ? i : i + 3) + (j < 3 ? j : j + 3)] += B[rows * i + j];
  return log(factorise(lower, n));
}

/* The least turn before R that makes a lever point along a way. */
static void align(double *R, const double *lever, const double *way) {
  double pointing[3], normal[3], turned[9], whole[9], along = 0.0, sine = 0.0;
  apply(R, lever, pointing);
  cross(pointing, way, normal);
  for (int i = 0; i < 3; i++) {
    along += pointing[i] * way[i];
    sine += normal[i] * normal[i];
  }
  sine = sqrt(sine);
  for (int i = 0; i < 3; i++) normal[i] *= sine > 0.0 ? atan2(sine, along) / sine : 0.0;
  exponential(normal, turned);
  times33(turned, R, whole);
  memcpy(R, whole, sizeof whole);
}

/* s I + t [v]x */
static void beside(const double *v, double s, double t, double *to) {
  to[0] = to[4] = to[8] = s;
  to[1] = -t * v[2]; to[2] = t * v[1]; to[5] = -t * v[0];
  to[3] = t * v[2]; to[6] = -t * v[1]; to[7] = t * v[0];
}

/* Errors of an observation at a joint value and an orientation T of the parent, and their derivatives by a
   turn before T and by the joint value: ERRORS rows of 5 columns. */
static void errors_at(const Problem *p, const Motion *m, int64_t k, const double *T, Observation *o,
                      double *errors) {
  double A[9], B[9], way[3], turned[9], child[9], half[9], crossed[9], lever[3], moved[3], e[3];
  for (int i = 0; i < 9; i++) A[i] = p->parent[16 * k + 4 * (i / 3) + i % 3];
  for (int i = 0; i < 9; i++) B[i] = p->child[16 * k + 4 * (i / 3) + i % 3];
  for (int i = 0; i < 3; i++) way[i] = p->child[16 * k + 4 * i + 3] - p->parent[16 * k + 4 * i + 3];
  place_one(p, m, o);
  memset(errors, 0, 5 * ERRORS * sizeof(double));
  apply(T, o->lever, lever);
  apply(T, o->by_joints, moved);
  beside(lever, 0.0, 1.0, crossed);
  times_transposed33(A, T, turned);
  logarithm(turned, e);
  beside(e, 1.0, 0.5, half);
  for (int i = 0; i < 3; i++) {
    errors[5 * i + 4] = way[i] - lever[i];
    errors[5 * i + 3] = -moved[i];
    errors[5 * (3 + i) + 4] = e[i];
    for (int j = 0; j < 3; j++) {
      errors[5 * i + j] = crossed[3 * i + j];
      errors[5 * (3 + i) + j] = -half[3 * i + j];
    }
  }
  if (p->rows == 3) return;
  times_transposed33(B, o->H_R, child);
  times_transposed33(child, T, turned);
  logarithm(turned, e);
  beside(e, 1.0, 0.5, half);
  apply(T, o->by_joints + 3, lever);
  apply(half, lever, moved);
  for (int i = 0; i < 3; i++) {
    errors[5 * (6 + i) + 4] = e[i];
    errors[5 * (6 + i) + 3] = -moved[i];
    for (int j = 0; j < 3; j++) errors[5 * (6 + i) + j] = -half[3 * i + j];
  }
}

/* As evaluate_each_observation in ambiguities.py, for one: joint value and orientation become the likeliest
   ones. Returns the logarithm of the density. */
static double single(const Problem *p, const Motion *m, int64_t k, const double *lower, double volume,
                     double *value, double *orientation) {
  int n = 3 + (int)p->rows;
  double best = -INFINITY, T[9], way[3], a = *value;
  Observation o;
  memcpy(T, orientation, sizeof T);
  for (int i = 0; i < 3; i++) way[i] = p->child[16 * k + 4 * i + 3] - p->parent[16 * k + 4 * i + 3];
  o.values[0] = a;
  place_one(p, m, &o);
  align(T, o.lever, way);
  memcpy(orientation, T, sizeof T);
  for (int64_t turn = 0; turn < p->mirrored_steps; turn++) {
    double by[5 * ERRORS], normal[16] = {0}, step[4] = {0}, squares = 0.0, turned[9], whole[9];
    o.values[0] = a;
    errors_at(p, m, k, T, &o, by);
    for (int i = 0; i < n; i++)
      for (int c = 0; c < 5; c++) {
        for (int j = 0; j < i; j++) by[5 * i + c] -= lower[n * i + j] * by[5 * j + c];
        by[5 * i + c] *= lower[(n + 1) * i];
      }
    for (int r = 0; r < n; r++) {
      const double *row = by + 5 * r;
      squares += row[4] * row[4];
      for (int i = 0; i < 4; i++) {
        step[i] -= row[i] * row[4];
        for (int j = 0; j < 4; j++) normal[4 * i + j] += row[i] * row[j];
      }
    }
    double precision = p->belief.precision[0], off = a - p->belief.mean[0];
    normal[15] += precision;
    step[3] -= precision * off;
    double root = factorise(normal, 4);
    double log_density =
        -0.5 * (squares + precision * off * off) - volume - log(root) - 0.5 * log(precision);
    if (log_density > best) {
      best = log_density;
      *value = a;
      memcpy(orientation, T, sizeof T);
    }
    resolve(normal, 4, step);
    exponential(step, turned);
    times33(turned, T, whole);
    memcpy(T, whole, sizeof T);
    double d = step[3];
    if (p->joint[0] >= 3) d = d > 0.5 ? 0.5 : d < -0.5 ? -0.5 : d;
    a += d;
  }
  return best;
}

/* The other joint value at which the child is as far from the parent. */
static double other_value(const Problem *p, const Motion *m, double value) {
  double parent[3];
  apply_transposed(m->left_R, m->left_p, parent);
  if (p->joint[0] < 5) return 2.0 * (-parent[2] - m->right_p[2]) - value;
  double towards = atan2(-parent[1], -parent[0]) - atan2(m->right_p[1], m->right_p[0]);
  double other = 2.0 * towards - value;
  return other - TAU * rint((other - p->belief.mean[0]) / TAU);
}

/* As choose_mirrored_values in ambiguities.py. */
static void exchange(Problem *p, Answer *a, double *memory) {
  if (!p->mirrored) return;
  Answer trial;
  memory = lay(p, memory, &trial);
  for (int64_t turn = 0; turn < p->mirrored_turns; turn++) {
    const Motion *m = &a->head->motion;
    double lower[ERRORS * ERRORS], volume = 0.0;
    int exchanged = 0;
    copy(p, a, &trial);
    for (int64_t k = 0; k < p->count; k++) {
      if (!k || p->of_parent.stride || p->of_child.stride) volume = errors_factor(p, k, lower);
      double here = a->values[k], there = other_value(p, m, here), one[9], other[9];
      for (int i = 0; i < 9; i++) one[i] = other[i] = a->parents[16 * k + 4 * (i / 3) + i % 3];
      double log_here = single(p, m, k, lower, volume, &here, one);
      if (!(single(p, m, k, lower, volume, &there, other) > log_here + p->better)) continue;
      exchanged = 1;
      trial.values[k] = there;
      for (int i = 0; i < 9; i++) trial.parents[16 * k + 4 * (i / 3) + i % 3] = other[i];
    }
    if (!exchanged) return;
    go_on(p, &trial, memory);
    if (!(trial.head->cost < a->head->cost)) return;
    copy(p, &trial, a);
  }
}
"""
