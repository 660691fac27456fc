"""C text: whole stages of identification, as :mod:`.refining` has them in numpy, each one call."""

STAGES = r"""
/* How many numbers of memory a stage needs: covariances with their inverses, two answers, and observations
   three times, which is more than any sum needs. */
EXPORT int64_t memory_of(const Problem *p) {
  return p->widths + 2 * answer_size(p) + p->count * (NOISE + 3 * OBSERVATION);
}

/* Every stage begins with the errors as they are, and with what is in its answer; returns free memory. */
static double *begin_stage(Problem *p, double *memory, double *answer, Answer *a) {
  lay(p, answer, a);
  believe_as(p, a->head);
  soften(p, p->softer, memory);
  return memory + NOISE * p->count;
}

/* As _settled in refining.py. */
static void widen_until_settled(Problem *p, Answer *a, double *memory) {
  int n = (int)p->joints;
  double before[6], wide[6], *places = memory, *known = places + p->count * n;
  int believed = a->head->marginal > 0.0;
  for (int i = 0; i < n; i++) before[i] = 1.0 / sqrt(a->head->belief.precision[i]);
  for (int64_t turn = 0; turn < p->turns; turn++) {
    double most = 0.0;
    Belief *belief = &a->head->belief, found;
    slide(p, a, memory);
    alone(p, a, 1.0, places, known);
    widths(p, places, known, wide, found.mean, known + p->count * n * n);
    for (int i = 0; i < n; i++) {
      wide[i] = fmax(wide[i], p->narrowest);
      most = fmax(most, fabs(log(wide[i] / before[i])));
    }
    if (believed && most < p->settled) return;
    believed = 1;
    a->head->marginal = 1.0;
    for (int i = 0; i < n; i++) {
      before[i] = wide[i];
      belief->mean[i] = found.mean[i];
      belief->precision[i] = 1.0 / (wide[i] * wide[i]);
    }
    go_on(p, a, memory);
    exchange(p, a, memory);
  }
}

/* As refined in refining.py. */
static void refine_from(Problem *p, Answer *a, double *noise, double *memory) {
  if (!p->joints || !size_of(p)) return;
  Answer other;
  double *rest = lay(p, memory, &other);
  int narrowing = p->softer && !(a->head->marginal > 0.0);
  if (narrowing) copy(p, a, &other);
  widen_until_settled(p, a, rest);
  if (!narrowing) return;
  double information[UNKNOWNS * UNKNOWNS], *values = rest, *covariances = values + p->count * p->joints;
  double *more = covariances + p->count * p->joints * p->joints;
  for (int64_t level = 0; level <= p->softer; level++) {
    soften(p, level, noise);
    go_on(p, &other, rest);
    exchange(p, &other, rest);
    widen_until_settled(p, &other, rest);
  }
  if (evidence(p, &other, 1.0, values, covariances, information, more) >
      evidence(p, a, 1.0, values, covariances, information, more))
    copy(p, &other, a);
}

/* As solve in solving.py. */
EXPORT void solve(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  memory = begin_stage(&p, memory, answer, &a);
  go_on(&p, &a, memory);
}

/* As likeliest in refining.py, from several starts. */
EXPORT void likeliest(const Problem *problem, int64_t starts, const Motion *motions, const double *values,
                      double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
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
  a.head->log_evidence = honest(&p, &a, memory);
}

/* As refined in refining.py. */
EXPORT void refine(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  double *noise = memory;
  memory = begin_stage(&p, memory, answer, &a);
  refine_from(&p, &a, noise, memory);
  a.head->log_evidence = honest(&p, &a, memory);
}

/* As continued in refining.py. */
EXPORT void carry_on(const Problem *problem, double *memory, double *answer) {
  Problem p = *problem;
  Answer a;
  memory = begin_stage(&p, memory, answer, &a);
  go_on(&p, &a, memory);
  if (p.marginal) widen_until_settled(&p, &a, memory);
  else slide(&p, &a, memory);
  a.head->log_evidence = honest(&p, &a, memory);
}

/* As evidence in evidence.py, for errors that are larger by several factors; the rest is for the last. */
EXPORT void rate(const Problem *problem, int64_t scales, const double *scale, double *memory,
                 double *answer, double *logs, double *values, double *covariances, double *information) {
  Answer a;
  lay(problem, answer, &a);
  for (int64_t i = 0; i < scales; i++)
    logs[i] = evidence(problem, &a, scale[i] * scale[i], values, covariances, information, memory);
}
"""
