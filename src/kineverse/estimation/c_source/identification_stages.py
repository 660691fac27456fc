"""C text of evidence and of the stages of identification, and the complete source."""

from kineverse.compilation.interruption import WATCH

from .identification_algebra import ALGEBRA
from .identification_joint_values import JOINT_RANGES, MIRRORED_VALUES, SLIDING_POINT
from .identification_linearise import LINEARISE, LOG_DETERMINANT_GRADIENT
from .identification_optimise import ITERATION, NEWTON_STEP

EVIDENCE = r"""
/* Parameters, means of joint values, and a point that slides, at most; rows of a fixed length are vectors. */
#define UNKNOWNS 16
#define ATOM 1e-10

/* Joint values, their covariances and the information, as observations and widths tell together. */
static void informed(const Problem *p, const Answer *a, const Apart *apart, double *values,
                     double *covariances, double *information) {
  int rows = (int)p->rows, joints = (int)p->joints, slides = (int)p->slides, size = (int)size_of(p);
  int n = size + joints + slides;
  const Motion *m = &a->head->motion;
  double total[UNKNOWNS * UNKNOWNS] = {0};
  Observation o;
  for (int64_t k = 0; k < p->count; k++) {
    const double *C = apart->covariances + joints * joints * k, *S = a->covariances + rows * rows * k;
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
    place_one(p, m, &o);
    for (int r = 0; r < rows; r++) {
      for (int s = 0; s < rows; s++) {
        moved[rows * r + s] = S[rows * r + s];
        for (int j = 0; j < joints; j++) {
          const double *J = o.by_joints + 6 * j;
          moved[rows * r + s] += apart->deviations[j] * apart->deviations[j] * J[r] * J[s];
        }
      }
      for (int i = 0; i < size; i++) both[UNKNOWNS * r + i] = o.by_parameters[MOST * r + i];
      for (int j = 0; j < joints; j++) both[UNKNOWNS * r + size + j] = o.by_joints[6 * j + r];
    }
    if (slides) {
      double twist[6] = {0}, G[9], turned[9];
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = o.values[j];
      exponential(twist + 3, G);
      times33(m->left_R, G, turned);
      for (int r = 0; r < 3; r++)
        for (int i = 0; i < slides; i++) both[UNKNOWNS * r + size + joints + i] = turned[3 * r + i];
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
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) information[n * i + j] = p->weight * total[UNKNOWNS * i + j];
}

static int has(const int64_t *components, int64_t count, int64_t component) {
  for (int64_t i = 0; i < count; i++)
    if (components[i] == component) return 1;
  return 0;
}

static double of_lever(const double *lever, int64_t count, double scale) {
  double log_density = -0.5 * count * log(TAU * scale * scale);
  for (int64_t i = 0; i < count; i++) log_density -= 0.5 * lever[i] * lever[i] / (scale * scale);
  return log_density;
}

/* As GroupMotion.log_prior and .prior: the density, and the precision is added to the information. */
static double beforehand(const Problem *p, const Motion *m, const double *mean, double *information) {
  int joints = (int)p->joints, size = (int)size_of(p), rights = (int)p->rights;
  int n = size + joints + (int)p->slides, columns = rights + joints;
  double log_density = 0.0, normal[MOST * MOST] = {0}, right[MOST] = {0}, matrix[36], volume[6];
  if (has(p->left, p->lefts, 3)) log_density -= log(TAU);
  if (has(p->left, p->lefts, 0) && has(p->left, p->lefts, 1))
    log_density += of_lever(m->right_p, p->reach, p->reach_scale);
  log_density += of_lever(m->right_p, p->slides, p->reach_scale);
  if (p->pitches) log_density += of_lever(&m->pitch, 1, p->pitch_scale);
  Observation o;
  memcpy(o.values, mean, joints * sizeof(double));
  place_one(p, m, &o);
  for (int r = 0; r < p->rows; r++)
    for (int i = 0; i < columns; i++)
      matrix[columns * r + i] =
          i < rights ? o.by_parameters[MOST * r + p->lefts + i] : o.by_joints[6 * (i - rights) + r];
  singular_values(matrix, (int)p->rows, columns, volume);
  for (int i = 0; i < columns; i++) log_density += log(fmax(volume[i], ATOM));
  believe(p, m, normal, right);
  for (int i = 0; i < size; i++)
    for (int j = 0; j < size; j++) information[n * i + j] += normal[MOST * i + j];
  for (int i = 0; i < n; i++) {
    double turns = i < p->lefts ? p->left[i] >= 3 : i >= size && i < size + joints && p->joint[i - size] >= 3;
    information[(n + 1) * i] += i < size + joints ? turns : 1.0 / (p->reach_scale * p->reach_scale);
  }
  return log_density;
}

/* As laplace_evidence in evidence.py. */
static double evidence(const Problem *p, const Answer *a, const Apart *apart, double *values,
                       double *covariances, double *information) {
  int n = (int)(size_of(p) + p->joints + p->slides);
  double copied[UNKNOWNS * UNKNOWNS], log_density = apart->log_likelihood + apart->log_density;
  informed(p, a, apart, values, covariances, information);
  log_density += beforehand(p, &a->head->motion, apart->mean, information) + 0.5 * n * log(TAU);
  memcpy(copied, information, n * n * sizeof(double));
  return log_density - 0.5 * log_volume(copied, n);
}

/* Its logarithm alone. */
static double log_evidence(const Problem *p, const Answer *a, const Apart *apart, double *memory) {
  double information[UNKNOWNS * UNKNOWNS];
  return evidence(p, a, apart, memory, memory + p->count * p->joints, information);
}

/* As evidence_excess in evidence.py. */
static double overrated(const Problem *p, const Answer *a, const Apart *apart) {
  if (a->head->converged > 0.0 || !(a->head->marginal > 0.0)) return 0.0;
  int n = (int)p->joints;
  double deviations[6], W[36], off[6], promised = apart->log_likelihood;
  for (int i = 0; i < n; i++) deviations[i] = 1.0 / sqrt(a->head->belief.precision[i]);
  for (int64_t k = 0; k < p->count; k++) {
    double root = widened(apart->covariances + n * n * k, n, deviations, W);
    for (int i = 0; i < n; i++) off[i] = apart->values[n * k + i] - a->head->belief.mean[i];
    promised -= 0.5 * squared(off, W, n) + log(root) + 0.5 * n * log(TAU);
  }
  double reached = a->head->cost - unlikely(p, &a->head->motion) + p->count * p->rows * log(TAU);
  return fmax(0.0, promised + 0.5 * reached);
}

/* Leave the logarithm of the evidence in an answer, with nothing that is not there. */
static void judge(const Problem *p, Answer *a, const Apart *apart, double *memory) {
  a->head->log_evidence = log_evidence(p, a, apart, memory) - overrated(p, a, apart);
}
"""

STAGES = r"""
/* How many numbers of memory a stage needs: covariances with their inverses, two answers with what their
   observations say apart, and observations three times, which is more than any sum needs. */
EXPORT int64_t memory_of(const Problem *p) {
  int64_t apart = p->joints * (1 + p->joints);
  return p->widths + 2 * answer_size(p) + p->count * (NOISE + 2 * apart + 3 * OBSERVATION);
}

/* Every stage begins with the errors as they are, and with what is in its answer; returns free memory. */
static double *begin_stage(Problem *p, double *memory, double *answer, Answer *a) {
  watch_begin(&watch, INFINITY);
  lay(p, answer, a);
  believe_as(p, a->head);
  soften(p, p->softer, memory);
  return memory + NOISE * p->count;
}

/* As _iterate_ranges in maximum_likelihood.py; leaves what observations say alone; returns free memory. */
static double *widen_until_settled(Problem *p, Answer *a, Apart *apart, double *memory) {
  int n = (int)p->joints, believed = a->head->marginal > 0.0;
  double before[6], *rest = memory;
  for (int i = 0; i < n; i++) before[i] = 1.0 / sqrt(a->head->belief.precision[i]);
  for (int64_t turn = 0;; turn++) {
    double most = 0.0, *wide = apart->deviations;
    Belief *belief = &a->head->belief;
    if (turn < p->turns) slide(p, a, memory);
    rest = take_apart(p, a, apart, memory);
    for (int i = 0; i < n; i++) most = fmax(most, fabs(log(fmax(wide[i], p->narrowest) / before[i])));
    if (turn == p->turns || (believed && most < p->settled) || look_at_clock(&watch)) return rest;
    believed = 1;
    a->head->marginal = 1.0;
    for (int i = 0; i < n; i++) {
      before[i] = fmax(wide[i], p->narrowest);
      belief->mean[i] = apart->mean[i];
      belief->precision[i] = 1.0 / (before[i] * before[i]);
    }
    go_on(p, a, memory);
    exchange(p, a, memory);
  }
}

/* As maximise_marginal_likelihood in maximum_likelihood.py; leaves and returns the same. */
static double *refine_from(Problem *p, Answer *a, Apart *apart, double *noise, double *memory) {
  int narrowing = p->softer && !(a->head->marginal > 0.0);
  Answer other;
  Apart of_other;
  if (!p->joints || !size_of(p)) return take_apart(p, a, apart, memory);
  if (narrowing) {
    memory = lay(p, memory, &other);
    copy(p, a, &other);
  }
  memory = widen_until_settled(p, a, apart, memory);
  if (!narrowing) return memory;
  double *rest = memory;
  for (int64_t level = 0; level <= p->softer; level++) {
    soften(p, level, noise);
    go_on(p, &other, memory);
    exchange(p, &other, memory);
    rest = widen_until_settled(p, &other, &of_other, memory);
  }
  if (log_evidence(p, &other, &of_other, rest) <= log_evidence(p, a, apart, rest)) return memory;
  copy(p, &other, a);
  *apart = of_other;
  return rest;
}

/* As levenberg_marquardt in optimise.py. */
EXPORT void solve(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  memory = begin_stage(&p, memory, answer, &a);
  go_on(&p, &a, memory);
}

/* As maximum_likelihood in maximum_likelihood.py, from several starts. */
EXPORT void likeliest(const Problem *problem, int64_t starts, const Motion *motions, const double *values,
                      double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  Apart apart;
  double *noise = memory;
  memory = begin_stage(&p, memory, answer, &a);
  soften(&p, 0, noise);
  solve_from(&p, starts, motions, values, p.steps, &a, memory);
  for (int64_t level = 1; level <= p.softer; level++) {
    soften(&p, level, noise);
    go_on(&p, &a, memory);
  }
  exchange(&p, &a, memory);
  slide(&p, &a, memory);
  memory = take_apart(&p, &a, &apart, memory);
  judge(&p, &a, &apart, memory);
}

/* As maximise_marginal_likelihood in maximum_likelihood.py. */
EXPORT void refine(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  Apart apart;
  double *noise = memory;
  memory = begin_stage(&p, memory, answer, &a);
  memory = refine_from(&p, &a, &apart, noise, memory);
  judge(&p, &a, &apart, memory);
}

/* As continue_from in maximum_likelihood.py. */
EXPORT void carry_on(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  Apart apart;
  memory = begin_stage(&p, memory, answer, &a);
  settle_new(&p, &a, memory);
  go_on(&p, &a, memory);
  if (!p.marginal) slide(&p, &a, memory);
  memory = p.marginal ? widen_until_settled(&p, &a, &apart, memory) : take_apart(&p, &a, &apart, memory);
  judge(&p, &a, &apart, memory);
}

/* As laplace_evidence in evidence.py, for several sizes of the noise; the rest is for the last. The
   covariance of the errors is the sum of two parts, times the square of a factor each; without parts it is as
   it is. */
EXPORT void rate(const Problem *problem, int64_t sizes, const double *factors, const double *parts,
                 double *memory, double *answer, double *logs, double *values, double *covariances,
                 double *information) {
  Answer a;
  Apart apart;
  int64_t numbers = problem->count * problem->rows * problem->rows;
  watch_begin(&watch, INFINITY);
  lay(problem, answer, &a);
  for (int64_t i = 0; i < sizes && !look_at_clock(&watch); i++) {
    double place = factors[2 * i] * factors[2 * i], turn = factors[2 * i + 1] * factors[2 * i + 1];
    for (int64_t k = 0; parts && k < numbers; k++)
      a.covariances[k] = place * parts[k] + turn * parts[numbers + k];
    take_apart(problem, &a, &apart, memory);
    logs[i] = evidence(problem, &a, &apart, values, covariances, information);
  }
}
"""

# Stages end early if a handler of signals has raised an exception; then nobody looks at the answer.
_WATCHED = WATCH + "static _Thread_local Watch watch;\n"

IDENTIFICATION_SOURCE = (
    _WATCHED
    + ALGEBRA
    + LINEARISE
    + LOG_DETERMINANT_GRADIENT
    + NEWTON_STEP
    + ITERATION
    + JOINT_RANGES
    + SLIDING_POINT
    + MIRRORED_VALUES
    + EVIDENCE
    + STAGES
)
