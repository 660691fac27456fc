"""C text of the Levenberg-Marquardt step and its iteration."""

NEWTON_STEP = r"""
static void advance(const Problem *p, const Motion *m, const double *step, Motion *to) {
  double l[6] = {0}, r[6] = {0}, turned[9], moved[3];
  for (int i = 0; i < p->lefts; i++) l[p->left[i]] = step[i];
  for (int i = 0; i < p->rights; i++) r[p->right[i]] = step[p->lefts + i];
  to->pitch = m->pitch + (p->pitches ? step[p->lefts + p->rights] : 0.0);
  exponential(l + 3, turned);
  times33(m->left_R, turned, to->left_R);
  apply(m->left_R, l, moved);
  for (int i = 0; i < 3; i++) to->left_p[i] = m->left_p[i] + moved[i];
  exponential(r + 3, turned);
  times33(turned, m->right_R, to->right_R);
  apply(turned, m->right_p, moved);
  for (int i = 0; i < 3; i++) to->right_p[i] = moved[i] + r[i];
}

/* Eliminate the joint values of an observation: W - W J_a (J_a' W J_a + P)^-1 J_a' W is what is left. */
FAST int eliminate(const Problem *p, Observation *o, double damping, double *left, const int rows) {
  int joints = (int)p->joints;
  for (int i = 0; i < rows * rows; i++) left[i] = o->weights[i];
  if (!joints) return 1;
  double curvature[36];
  for (int i = 0; i < joints * joints; i++) curvature[i] = o->curvature[i];
  for (int i = 0; i < joints; i++)
    curvature[(joints + 1) * i] += p->belief.precision[i] + damping * curvature[(joints + 1) * i];
  if (joints == 1) {
    if (!(curvature[0] > 0.0)) return 0;
    o->inverse[0] = 1.0 / curvature[0];
  } else if (invert(curvature, joints, o->inverse) == 0.0) return 0;
  for (int i = 0; i < joints; i++) {
    double *gains = o->gains + 6 * i;
    for (int r = 0; r < rows; r++) gains[r] = 0.0;
    for (int j = 0; j < joints; j++)
      for (int r = 0; r < rows; r++) gains[r] += o->inverse[joints * i + j] * o->weighted[6 * j + r];
    for (int r = 0; r < rows; r++)
      for (int s = 0; s < rows; s++) left[rows * r + s] -= o->weighted[6 * i + r] * gains[s];
  }
  return 1;
}

/* Add what one observation says about the parameters. */
FAST void gather(const Problem *p, Observation *o, const double *left, double *normal, double *right,
                 const int rows) {
  int joints = (int)p->joints, n = (int)size_of(p);
  double pushed[6], rotated[6 * MOST];
  for (int r = 0; r < rows; r++) {
    pushed[r] = 0.0;
    for (int s = 0; s < rows; s++) pushed[r] += o->weights[rows * r + s] * o->residual[s];
  }
  for (int i = 0; i < joints; i++) {
    o->slope[i] = -p->belief.precision[i] * (o->values[i] - p->belief.mean[i]);
    for (int r = 0; r < rows; r++) o->slope[i] += o->weighted[6 * i + r] * o->residual[r];
  }
  for (int i = 0; i < joints; i++)
    for (int r = 0; r < rows; r++) pushed[r] -= o->gains[6 * i + r] * o->slope[i];
  for (int r = 0; r < rows; r++)
    for (int i = 0; i < MOST; i++) {
      double sum = 0.0;
      for (int s = 0; s < rows; s++) sum += left[rows * r + s] * o->by_parameters[s * MOST + i];
      rotated[r * MOST + i] = sum;
    }
  for (int r = 0; r < rows; r++)
    for (int i = 0; i < MOST; i++) right[i] += o->by_parameters[r * MOST + i] * pushed[r];
  for (int i = 0; i < n; i++)
    for (int r = 0; r < rows; r++) {
      double by = o->by_parameters[r * MOST + i];
      for (int j = 0; j < MOST; j++) normal[MOST * i + j] += by * rotated[r * MOST + j];
    }
}

/* Beforehand levers are within reach, and pitches ordinary. */
static void believe(const Problem *p, const Motion *m, double *normal, double *right) {
  int n = (int)size_of(p);
  double scale = 1.0 / (p->reach_scale * p->reach_scale);
  for (int i = 0; i < p->reach; i++) {
    double row[MOST] = {0};
    for (int j = 0; j < p->rights; j++) {
      int64_t c = p->right[j];
      double unit[3] = {0}, moved[3];
      if (c >= 3) {
        unit[c - 3] = 1.0;
        cross(unit, m->right_p, moved);
        row[p->lefts + j] = moved[i];
      } else row[p->lefts + j] = c == i;
    }
    for (int j = 0; j < n; j++) {
      right[j] -= scale * row[j] * m->right_p[i];
      for (int l = 0; l < n; l++) normal[MOST * j + l] += scale * row[j] * row[l];
    }
  }
  if (!p->pitches) return;
  scale = 1.0 / (p->pitch_scale * p->pitch_scale);
  right[n - 1] -= scale * m->pitch;
  normal[(MOST + 1) * (n - 1)] += scale;
}

/* Move joint value and parent of an observation as a step of the parameters tells; returns the gain. */
FAST double follow(const Problem *p, const Observation *o, const double *step, Observation *q,
                   const int rows) {
  int joints = (int)p->joints, n = (int)size_of(p);
  double left[6], gain = 0.0;
  for (int r = 0; r < rows; r++) {
    left[r] = o->residual[r];
    for (int i = 0; i < n; i++) left[r] -= o->by_parameters[r * MOST + i] * step[i];
  }
  double change[6] = {0}, back[6];
  for (int i = 0; i < joints; i++) {
    back[i] = -p->belief.precision[i] * (o->values[i] - p->belief.mean[i]);
    for (int r = 0; r < rows; r++) back[i] += o->weighted[6 * i + r] * left[r];
  }
  for (int i = 0; i < joints; i++)
    for (int j = 0; j < joints; j++) {
      change[i] += o->inverse[joints * i + j] * back[j];
      gain += o->slope[i] * o->inverse[joints * i + j] * o->slope[j];
    }
  for (int i = 0; i < joints; i++) {
    double d = change[i];
    for (int r = 0; r < rows; r++) left[r] -= o->by_joints[6 * i + r] * d;
    if (p->joint[i] >= 3) d = d > 0.5 ? 0.5 : d < -0.5 ? -0.5 : d;
    q->values[i] = o->values[i] + d;
  }
  memcpy(q->parent_R, o->parent_R, sizeof o->parent_R);
  memcpy(q->parent_p, o->parent_p, sizeof o->parent_p);
  if (p->known) return gain;
  /* ε = e_A + Σ_A Mᵀ W rest */
  double rest[6] = {0}, carried[6], moved[3], error[6], R[9];
  for (int r = 0; r < rows; r++)
    for (int s = 0; s < rows; s++) rest[r] += o->weights[rows * r + s] * left[s];
  cross(o->lever, rest, moved);
  for (int i = 0; i < 3; i++) {
    carried[i] = rest[i];
    carried[3 + i] = moved[i] + rest[3 + i];
  }
  for (int i = 0; i < 6; i++) {
    error[i] = o->own[i];
    for (int j = 0; j < 6; j++) error[i] += o->of_parent[6 * i + j] * carried[j];
    gain += error[i] * error[i] / o->of_parent[7 * i];
  }
  exponential(error + 3, R);
  times33(o->parent_R, R, q->parent_R);
  apply(o->parent_R, error, moved);
  for (int i = 0; i < 3; i++) q->parent_p[i] = o->parent_p[i] + moved[i];
  return gain;
}

FAST int move_rows(const Problem *p, const Motion *m, Observation *all, double damping, Motion *to,
              Observation *next, double *gain, const int rows) {
  int n = (int)size_of(p);
  double normal[MOST * MOST] = {0}, right[MOST] = {0}, step[MOST] = {0}, packed[MOST * MOST], left[36];
  for (int64_t k = 0; k < p->count; k++) {
    Observation *o = all + k;
    if (p->marginal) {
      if (!eliminate(p, o, 0.0, left, rows)) return 0;
      widen(p, m, o, left, right, rows);
    }
    if (!p->marginal || damping > 0.0)
      if (!eliminate(p, o, damping, left, rows)) return 0;
    gather(p, o, left, normal, right, rows);
  }
  believe(p, m, normal, right);
  for (int i = 0; i < n; i++)
    for (int j = 0; j < n; j++) packed[n * i + j] = normal[MOST * i + j] * (i == j ? 1.0 + damping : 1.0);
  memcpy(step, right, n * sizeof(double));
  if (factorise(packed, n) == 0.0) return 0;
  resolve(packed, n, step);
  *gain = 0.0;
  for (int i = 0; i < n; i++) *gain += step[i] * right[i];
  for (int64_t k = 0; k < p->count; k++) *gain += follow(p, all + k, step, next + k, rows);
  advance(p, m, step, to);
  return 1;
}

/* Where a step leads; 0 if there is none. */
static int move(const Problem *p, const Motion *m, Observation *all, double damping, Motion *to,
                Observation *next, double *gain) {
  return p->rows == 6 ? move_rows(p, m, all, damping, to, next, gain, 6)
                      : move_rows(p, m, all, damping, to, next, gain, 3);
}
"""

ITERATION = r"""
/* What a solution is, for Python: numbers first, and arrays behind them in the same memory. */
typedef struct {
  Motion motion;
  double cost, converged, marginal, log_evidence;
  Belief belief;
} Head;

typedef struct {
  Head *head;
  double *values, *parents, *residuals, *covariances, *poses, *by_parameters, *by_joints;
} Answer;

#define HEAD ((int64_t)(sizeof(Head) / sizeof(double)))
#define NOISE 144
#define OBSERVATION ((int64_t)(sizeof(Observation) / sizeof(double)))

static int64_t answer_size(const Problem *p) {
  return HEAD + p->count * (p->joints + 32 + p->rows * (1 + p->rows + size_of(p) + p->joints));
}

/* The parts of a solution in some memory; returns what is behind it. */
static double *lay(const Problem *p, double *memory, Answer *a) {
  a->head = (Head *)memory;
  a->values = memory + HEAD;
  a->parents = a->values + p->count * p->joints;
  a->residuals = a->parents + p->count * 16;
  a->covariances = a->residuals + p->count * p->rows;
  a->poses = a->covariances + p->count * p->rows * p->rows;
  a->by_parameters = a->poses + p->count * 16;
  a->by_joints = a->by_parameters + p->count * p->rows * size_of(p);
  return a->by_joints + p->count * p->rows * p->joints;
}

static void copy(const Problem *p, const Answer *from, Answer *to) {
  memcpy(to->head, from->head, answer_size(p) * sizeof(double));
}

static double *noise_of(const double *given, int64_t count, const int rows, double factor, double *memory,
                        Noise *noise) {
  int64_t size = rows * rows, several = 0;
  for (int64_t k = 1; k < count && !several; k++)
    several = memcmp(given + size * k, given, size * sizeof(double)) != 0;
  int64_t each = several ? count : 1;
  double *covariance = memory, *inverse = memory + each * size;
  for (int64_t k = 0; k < each; k++) {
    for (int i = 0; i < rows; i++)
      for (int j = 0; j < rows; j++)
        covariance[size * k + rows * i + j] =
            given[size * k + rows * i + j] * (i < 3 ? factor : 1.0) * (j < 3 ? factor : 1.0);
    invert(covariance + size * k, rows, inverse + size * k);
  }
  noise->covariance = covariance;
  noise->inverse = inverse;
  noise->stride = several ? size : 0;
  noise->round = 1;
  for (int64_t k = 0; k < each * size; k++) {
    int64_t i = k % size / rows, j = k % size % rows, first = k - k % size + (i < 3 ? 0 : 3) * (rows + 1);
    noise->round &= covariance[k] == (i == j ? covariance[first] : 0.0);
  }
  return inverse + each * size;
}

/* Take errors of positions as larger; the last level is as they are. As Observations.softened. */
static void soften(Problem *p, int64_t level, double *memory) {
  double factor = level < p->softer ? p->softness[level] : 1.0;
  memory = noise_of(p->child_covariance, p->count, (int)p->rows, factor, memory, &p->of_child);
  if (!p->known) noise_of(p->parent_covariance, p->count, 6, factor, memory, &p->of_parent);
  /* Softened ones are precise too, but for the first two. */
  p->mirrored = p->softer && p->joints == 1 && size_of(p) && (level == p->softer || level > 1);
}

static void believe_as(Problem *p, const Head *head) {
  p->marginal = head->marginal > 0.0;
  p->belief = head->belief;
}

/* Take steps until they are small; returns whether they became so. What was found is in *here then. */
static int64_t settle(const Problem *p, Motion *now, Observation **here, Observation **there, int64_t steps,
                      double *best) {
  double damping = 0.0, before = 0.0;
  for (int64_t i = 0; i < steps && !look_at_clock(&watch); i++) {
    double gain = 0.0, trial = NAN;
    Motion next;
    if (move(p, now, *here, damping, &next, *there, &gain)) trial = look_at_all(p, &next, *there);
    if (!isfinite(trial)) {
      damping = damping > 1e-7 ? 10.0 * damping : 1e-6;
      if (damping > 1e8) return 0;
    } else if (trial <= *best + 1e-12 * fabs(*best)) {
      Observation *other = *here;
      *here = *there;
      *there = other;
      *now = next;
      *best = trial;
      damping = damping > 1e-6 ? 0.1 * damping : 0.0;
      if (gain < p->close || gain * gain < p->close * before) return 1;
      before = gain;
    } else if (gain < p->close) {
      return 1;
    } else {
      damping = damping > 1e-5 ? 10.0 * damping : 1e-4;
      if (damping > 1e8) return 0;
    }
  }
  return 0;
}

static void begin(const Problem *p, const double *values, const double *parents, Observation *all) {
  for (int64_t k = 0; k < p->count; k++) {
    for (int i = 0; i < 9; i++) all[k].parent_R[i] = parents[16 * k + 4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) all[k].parent_p[i] = parents[16 * k + 4 * i + 3];
    memcpy(all[k].values, values + p->joints * k, p->joints * sizeof(double));
  }
}

static void note_unknowns(const Problem *p, const Observation *found, double *values, double *parents) {
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = found + k;
    double *parent = parents + 16 * k;
    memcpy(values + p->joints * k, o->values, p->joints * sizeof(double));
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) parent[4 * i + j] = o->parent_R[3 * i + j];
      parent[4 * i + 3] = o->parent_p[i];
    }
    for (int j = 0; j < 4; j++) parent[12 + j] = j == 3;
  }
}

/* Leave in an answer what was found. */
static void note(const Problem *p, const Motion *m, double cost, int64_t converged, const Observation *found,
                 Answer *a) {
  int64_t joints = p->joints, rows = p->rows, size = size_of(p);
  a->head->motion = *m;
  a->head->cost = cost;
  a->head->converged = (double)converged;
  a->head->marginal = (double)p->marginal;
  a->head->belief = p->belief;
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = found + k;
    memcpy(a->residuals + rows * k, o->residual, rows * sizeof(double));
    memcpy(a->covariances + rows * rows * k, o->covariance, rows * rows * sizeof(double));
    keep(p, o, a->poses + 16 * k, a->by_parameters + rows * size * k, a->by_joints + rows * joints * k);
  }
  note_unknowns(p, found, a->values, a->parents);
}

/* From the best of several starts, after few steps of each, to where steps are small. Parents begin where
   the answer has them. */
static void solve_from(const Problem *p, int64_t starts, const Motion *motions, const double *values,
                       int64_t steps, Answer *a, double *memory) {
  int64_t count = p->count, converged = 0;
  Observation *here = (Observation *)memory, *there = here + count, *kept = there + count;
  Motion now;
  double best = INFINITY;
  for (int64_t i = 0; i < starts; i++) {
    Motion trial = motions[i];
    straighten(trial.left_R);
    straighten(trial.right_R);
    begin(p, values + i * count * p->joints, a->parents, here);
    double reached = look_at_all(p, &trial, here);
    int64_t done = starts > 1 ? settle(p, &trial, &here, &there, p->first_steps, &reached) : 0;
    if (i && !(reached < best)) continue;
    Observation *other = here;
    here = kept;
    kept = other;
    now = trial;
    best = reached;
    converged = done;
  }
  if (!converged) converged = settle(p, &now, &kept, &there, steps, &best);
  note(p, &now, best, converged, kept, a);
}

/* Go on from an answer, as it says what is believed. */
static void go_on(Problem *p, Answer *a, double *memory) {
  Motion from = a->head->motion;
  believe_as(p, a->head);
  solve_from(p, 1, &from, a->values, p->steps, a, memory);
}

/* Move joint values and parents of the last observations, which are new, with the motion as it is. */
static void settle_new(const Problem *p, Answer *a, double *memory) {
  int64_t first = p->count - p->fresh;
  Problem q = *p;
  q.count = p->fresh;
  q.lefts = q.rights = q.pitches = q.reach = 0;
  q.parent += 16 * first;
  q.child += 16 * first;
  q.of_parent.covariance += q.of_parent.stride * first;
  q.of_parent.inverse += q.of_parent.stride * first;
  q.of_child.covariance += q.of_child.stride * first;
  q.of_child.inverse += q.of_child.stride * first;
  Observation *here = (Observation *)memory, *there = here + q.count;
  double *values = a->values + q.joints * first, *parents = a->parents + 16 * first;
  Motion m = a->head->motion;
  begin(&q, values, parents, here);
  double cost = look_at_all(&q, &m, here);
  settle(&q, &m, &here, &there, q.steps, &cost);
  note_unknowns(&q, here, values, parents);
}
"""
