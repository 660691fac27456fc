"""C text: what :func:`.solving.solve` does for the families of joints, in the same steps."""

from .native_algebra import ALGEBRA
from .native_evidence import EVIDENCE
from .native_look import LOOK
from .native_sliding import SLIDING
from .native_step import STEP
from .native_widening import WIDEN
from .native_widths import WIDTHS

SOLVE = (
    ALGEBRA
    + LOOK
    + WIDEN
    + STEP
    + WIDTHS
    + SLIDING
    + EVIDENCE
    + r"""
/* Take steps until they are small; returns whether they became so. What was found is in *here then. */
static int64_t settle(const Problem *p, const Weights *w, Motion *now, Observation **here,
                      Observation **there, int64_t steps, double *best) {
  double damping = 0.0;
  for (int64_t i = 0; i < steps; i++) {
    double gain = 0.0, trial = NAN;
    Motion next;
    if (move(p, now, *here, damping, &next, *there, &gain)) trial = look_at_all(p, &next, w, *there);
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
      if (gain < p->close) return 1;
    } else if (gain < p->close) {
      return 1;
    } else {
      damping = damping > 1e-5 ? 10.0 * damping : 1e-4;
      if (damping > 1e8) return 0;
    }
  }
  return 0;
}

static void weights_of(const double *covariance, int64_t count, int rows, double *to,
                       int64_t stride) {
  int64_t size = rows * rows;
  for (int64_t k = 0; k < count; k++) {
    const double *of = covariance + size * k;
    /* Most often all are alike. */
    if (k && !memcmp(of, of - size, size * sizeof(double)))
      memcpy(to + stride * k, to + stride * (k - 1), size * sizeof(double));
    else
      invert(of, rows, to + stride * k);
  }
}

static void begin(const Problem *p, const double *values, const double *parents, Observation *all) {
  for (int64_t k = 0; k < p->count; k++) {
    for (int i = 0; i < 9; i++) all[k].parent_R[i] = parents[16 * k + 4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) all[k].parent_p[i] = parents[16 * k + 4 * i + 3];
    memcpy(all[k].values, values + p->joints * k, p->joints * sizeof(double));
  }
}

/* As solve_first in solving.py. Returns whether it converged, or -1 without memory. */
EXPORT int64_t solve(const Problem *p, int64_t starts, Motion *motion, double *values, double *parents,
                     int64_t first, int64_t steps, double *cost, double *residuals, double *covariances,
                     double *poses, double *by_parameters, double *by_joints) {
  int64_t joints = p->joints, rows = p->rows, count = p->count, size = size_of(p), converged = 0;
  Observation *memory = calloc(3 * count, sizeof(Observation));
  Weights *weights = malloc(count * sizeof(Weights));
  if (!memory || !weights) {
    free(memory);
    free(weights);
    return -1;
  }
  const int64_t stride = sizeof(Weights) / sizeof(double);
  weights_of(p->child_covariance, count, rows, weights->of_child, stride);
  if (!p->known) weights_of(p->parent_covariance, count, 6, weights->of_parent, stride);
  Observation *here = memory, *there = memory + count, *kept = memory + 2 * count;
  Motion now;
  double best = INFINITY;
  for (int64_t i = 0; i < starts; i++) {
    Motion trial = motion[i];
    straighten(trial.left_R);
    straighten(trial.right_R);
    begin(p, values + i * count * joints, parents, here);
    double reached = look_at_all(p, &trial, weights, here);
    int64_t done = starts > 1 ? settle(p, weights, &trial, &here, &there, first, &reached) : 0;
    if (i && !(reached < best)) continue;
    Observation *other = here;
    here = kept;
    kept = other;
    now = trial;
    best = reached;
    converged = done;
  }
  if (!converged) converged = settle(p, weights, &now, &kept, &there, steps, &best);
  *motion = now;
  *cost = best;
  for (int64_t k = 0; k < count; k++) {
    const Observation *o = kept + k;
    memcpy(values + joints * k, o->values, joints * sizeof(double));
    memcpy(residuals + rows * k, o->residual, rows * sizeof(double));
    memcpy(covariances + rows * rows * k, o->covariance, rows * rows * sizeof(double));
    keep(p, o, poses + 16 * k, by_parameters + rows * size * k, by_joints + rows * joints * k);
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) parents[16 * k + 4 * i + j] = o->parent_R[3 * i + j];
      parents[16 * k + 4 * i + 3] = o->parent_p[i];
    }
  }
  free(memory);
  free(weights);
  return converged;
}
"""
)
