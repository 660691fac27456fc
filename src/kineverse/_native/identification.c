/* Stages of the identification of a joint: fit, maximum of the marginal likelihood, evidence. */

#include "identification/evidence.h"

/* How many numbers of memory a stage needs: covariances with their inverses, two answers with what their
   observations say apart, and observations three times, which is more than any sum needs. */
EXPORTED int64_t memory_of(const Problem *p) {
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

/* As _iterate_ranges in marginal_likelihood.py; leaves what observations say alone; returns free memory. */
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

/* As maximise_marginal_likelihood in marginal_likelihood.py; leaves and returns the same. */
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

/* As levenberg_marquardt in least_squares.py. */
EXPORTED void solve(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  memory = begin_stage(&p, memory, answer, &a);
  go_on(&p, &a, memory);
}

/* As maximum_likelihood in marginal_likelihood.py, from several starts. */
EXPORTED void likeliest(const Problem *problem, int64_t starts, const Motion *motions, const double *values,
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

/* As maximise_marginal_likelihood in marginal_likelihood.py. */
EXPORTED void refine(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  Apart apart;
  double *noise = memory;
  memory = begin_stage(&p, memory, answer, &a);
  memory = refine_from(&p, &a, &apart, noise, memory);
  judge(&p, &a, &apart, memory);
}

/* As continue_from in marginal_likelihood.py. */
EXPORTED void carry_on(const Problem *problem, double *memory, double *answer) {
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

/* As laplace_evidence in marginal_likelihood.py, for several sizes of the noise; the rest is for the last. The
   covariance of the errors is the sum of two parts, times the square of a factor each; without parts it is as
   it is. */
EXPORTED void rate(const Problem *problem, int64_t sizes, const double *factors, const double *parts,
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
