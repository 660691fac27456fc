"""C text: what :func:`.solving.solve` does for the families of joints, in the same steps."""

from .native_algebra import ALGEBRA
from .native_look import LOOK

SOLVE = (
    ALGEBRA
    + LOOK
    + r"""
/* What one observation has to say about its joint values: the inverse of its curvature, and J_a' W. */
static int own_part(const Problem *p, const Observation *o, double damping, double *inverse, double *weighted,
                    double *slope) {
  int rows = (int)p->rows, joints = (int)p->joints;
  double curvature[36];
  for (int i = 0; i < joints; i++) {
    slope[i] = -p->precision[i] * (o->values[i] - p->mean[i]);
    for (int r = 0; r < rows; r++) {
      double sum = 0.0;
      for (int s = 0; s < rows; s++) sum += o->by_joints[s * joints + i] * o->weights[rows * s + r];
      weighted[rows * i + r] = sum;
      slope[i] += sum * o->residual[r];
    }
  }
  for (int i = 0; i < joints; i++)
    for (int j = 0; j < joints; j++) {
      double sum = 0.0;
      for (int r = 0; r < rows; r++) sum += weighted[rows * i + r] * o->by_joints[r * joints + j];
      curvature[joints * i + j] = sum;
    }
  for (int i = 0; i < joints; i++)
    curvature[(joints + 1) * i] += p->precision[i] + damping * curvature[(joints + 1) * i];
  return invert(curvature, joints, inverse);
}

static void advance(const Problem *p, const Motion *m, const double *step, Motion *to) {
  double l[6] = {0}, r[6] = {0}, turned[9], moved[3];
  for (int i = 0; i < p->lefts; i++) l[p->left[i]] = step[i];
  for (int i = 0; i < p->rights; i++) r[p->right[i]] = step[p->lefts + i];
  to->pitch = m->pitch + (p->pitched ? step[p->lefts + p->rights] : 0.0);
  exponential(l + 3, turned);
  times33(m->left_R, turned, to->left_R);
  apply(m->left_R, l, moved);
  for (int i = 0; i < 3; i++) to->left_p[i] = m->left_p[i] + moved[i];
  exponential(r + 3, turned);
  times33(turned, m->right_R, to->right_R);
  apply(turned, m->right_p, moved);
  for (int i = 0; i < 3; i++) to->right_p[i] = moved[i] + r[i];
}

#define DIFFERENCE 1e-5

/* How the width of what is seen changes with each parameter, joint values following. */
static int widen(const Problem *p, const Motion *m, const Observation *all, double *slope) {
  int rows = (int)p->rows, joints = (int)p->joints, n = (int)size_of(p);
  Motion moved[MOST];
  for (int i = 0; i < n; i++) {
    double step[MOST] = {0};
    step[i] = DIFFERENCE;
    advance(p, m, step, moved + i);
    slope[i] = 0.0;
  }
  for (int64_t k = 0; k < p->count; k++) {
    Observation o = all[k];
    double inverse[36], weighted[36], own[6], before = spread(p, &o);
    if (!own_part(p, &o, 0.0, inverse, weighted, own)) return 0;
    for (int i = 0; i < n; i++) {
      for (int j = 0; j < joints; j++) {
        double change = 0.0;
        for (int l = 0; l < joints; l++)
          for (int r = 0; r < rows; r++)
            change += inverse[joints * j + l] * weighted[rows * l + r] * all[k].by_parameters[r * n + i];
        o.values[j] = all[k].values[j] - DIFFERENCE * change;
      }
      place(p, moved + i, &o);
      combine(p, &o);
      slope[i] += (spread(p, &o) - before) / DIFFERENCE;
    }
  }
  return 1;
}

/* Where a step leads; 0 if there is none. */
static int move(const Problem *p, const Motion *m, const Observation *all, double damping, Motion *to,
                Observation *next, double *gain) {
  int rows = (int)p->rows, joints = (int)p->joints, n = (int)size_of(p);
  double normal[MOST * MOST] = {0}, right[MOST] = {0}, step[MOST] = {0};
  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = all + k;
    double projected[36], inverse[36], weighted[36], slope[6], pushed[6];
    memcpy(projected, o->weights, sizeof projected);
    for (int r = 0; r < rows; r++) {
      pushed[r] = 0.0;
      for (int s = 0; s < rows; s++) pushed[r] += o->weights[rows * r + s] * o->residual[s];
    }
    if (joints) {
      if (!own_part(p, o, damping, inverse, weighted, slope)) return 0;
      for (int i = 0; i < joints; i++) {
        double gains[6] = {0}, back = 0.0;
        for (int j = 0; j < joints; j++) {
          back += inverse[joints * i + j] * slope[j];
          for (int r = 0; r < rows; r++) gains[r] += inverse[joints * i + j] * weighted[rows * j + r];
        }
        for (int r = 0; r < rows; r++) {
          pushed[r] -= weighted[rows * i + r] * back;
          for (int s = 0; s < rows; s++) projected[rows * r + s] -= weighted[rows * i + r] * gains[s];
        }
      }
    }
    for (int i = 0; i < n; i++) {
      double rotated[6];
      for (int s = 0; s < rows; s++) {
        rotated[s] = 0.0;
        for (int r = 0; r < rows; r++) rotated[s] += o->by_parameters[r * n + i] * projected[rows * r + s];
        right[i] += o->by_parameters[s * n + i] * pushed[s];
      }
      for (int j = 0; j <= i; j++)
        for (int s = 0; s < rows; s++) normal[n * i + j] += rotated[s] * o->by_parameters[s * n + j];
    }
  }
  /* Beforehand: levers are within reach. */
  for (int i = 0; i < p->reach; i++) {
    double row[MOST] = {0}, scale = 1.0 / (p->reach_scale * p->reach_scale);
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
      for (int l = 0; l <= j; l++) normal[n * j + l] += scale * row[j] * row[l];
    }
  }
  if (p->pitched) {
    double scale = 1.0 / (p->pitch_scale * p->pitch_scale);
    right[n - 1] -= scale * m->pitch;
    normal[n * n - 1] += scale;
  }
  if (p->marginal) {
    double slope[MOST];
    if (!widen(p, m, all, slope)) return 0;
    for (int i = 0; i < n; i++) right[i] -= 0.5 * slope[i];
  }
  for (int i = 0; i < n; i++) normal[(n + 1) * i] *= 1.0 + damping;
  memcpy(step, right, sizeof step);
  if (!factorise(normal, n)) return 0;
  forward(normal, n, step);
  backward(normal, n, step);
  *gain = 0.0;
  for (int i = 0; i < n; i++) *gain += step[i] * right[i];

  for (int64_t k = 0; k < p->count; k++) {
    const Observation *o = all + k;
    Observation *q = next + k;
    double left[6], inverse[36], weighted[36], slope[6];
    for (int r = 0; r < rows; r++) {
      left[r] = o->residual[r];
      for (int i = 0; i < n; i++) left[r] -= o->by_parameters[r * n + i] * step[i];
    }
    if (joints) {
      double change[6] = {0}, back[6], own_gain = 0.0;
      if (!own_part(p, o, damping, inverse, weighted, slope)) return 0;
      for (int i = 0; i < joints; i++) {
        back[i] = -p->precision[i] * (o->values[i] - p->mean[i]);
        for (int r = 0; r < rows; r++) back[i] += weighted[rows * i + r] * left[r];
      }
      for (int i = 0; i < joints; i++)
        for (int j = 0; j < joints; j++) {
          change[i] += inverse[joints * i + j] * back[j];
          own_gain += slope[i] * inverse[joints * i + j] * slope[j];
        }
      *gain += own_gain;
      for (int i = 0; i < joints; i++) {
        for (int r = 0; r < rows; r++) left[r] -= o->by_joints[r * joints + i] * change[i];
        double d = change[i];
        if (p->joint[i] >= 3) d = d > 0.5 ? 0.5 : d < -0.5 ? -0.5 : d;
        q->values[i] = o->values[i] + d;
      }
    }
    memcpy(q->parent_R, o->parent_R, sizeof o->parent_R);
    memcpy(q->parent_p, o->parent_p, sizeof o->parent_p);
    if (!p->known) {
      /* ε = e_A + Σ_A Mᵀ W rest */
      double rest[6] = {0}, carried[6] = {0}, moved[3], error[6], R[9];
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
        *gain += error[i] * error[i] / o->of_parent[7 * i];
      }
      exponential(error + 3, R);
      times33(o->parent_R, R, q->parent_R);
      apply(o->parent_R, error, moved);
      for (int i = 0; i < 3; i++) q->parent_p[i] = o->parent_p[i] + moved[i];
    }
  }

  advance(p, m, step, to);
  return 1;
}

/* As solve in solving.py. Returns whether it converged, or -1 without memory. */
EXPORT int64_t solve(const Problem *p, Motion *motion, double *values, double *parents, int64_t steps,
                     double *cost, double *residuals, double *covariances, double *poses,
                     double *by_parameters, double *by_joints) {
  int64_t joints = p->joints, rows = p->rows, size = size_of(p);
  Observation *memory = malloc(2 * p->count * sizeof(Observation));
  Observation *here = memory, *there = memory + p->count;
  if (!memory) return -1;
  for (int64_t k = 0; k < p->count; k++) {
    for (int i = 0; i < 9; i++) here[k].parent_R[i] = parents[16 * k + 4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) here[k].parent_p[i] = parents[16 * k + 4 * i + 3];
    memset(here[k].own, 0, sizeof here[k].own);
    memset(there[k].own, 0, sizeof there[k].own);
    memcpy(here[k].values, values + joints * k, joints * sizeof(double));
  }
  Motion now = *motion, next;
  double best = look_at_all(p, &now, here), damping = 0.0;
  int64_t converged = 0;
  for (int64_t i = 0; i < steps; i++) {
    double gain = 0.0, trial = NAN;
    if (move(p, &now, here, damping, &next, there, &gain)) trial = look_at_all(p, &next, there);
    if (!isfinite(trial)) {
      damping = damping > 1e-7 ? 10.0 * damping : 1e-6;
      if (damping > 1e8) break;
    } else if (trial <= best + 1e-12 * fabs(best)) {
      Observation *other = here;
      here = there;
      there = other;
      now = next;
      best = trial;
      damping = damping > 1e-6 ? 0.1 * damping : 0.0;
      if (gain < p->close) {
        converged = 1;
        break;
      }
    } else if (gain < p->close) {
      converged = 1;
      break;
    } else {
      damping = damping > 1e-5 ? 10.0 * damping : 1e-4;
      if (damping > 1e8) break;
    }
  }
  *motion = now;
  *cost = best;
  for (int64_t k = 0; k < p->count; k++) {
    memcpy(values + joints * k, here[k].values, joints * sizeof(double));
    memcpy(residuals + rows * k, here[k].residual, rows * sizeof(double));
    memcpy(covariances + rows * rows * k, here[k].covariance, rows * rows * sizeof(double));
    memcpy(by_parameters + rows * size * k, here[k].by_parameters, rows * size * sizeof(double));
    memcpy(by_joints + rows * joints * k, here[k].by_joints, rows * joints * sizeof(double));
    for (int i = 0; i < 9; i++) {
      parents[16 * k + 4 * (i / 3) + i % 3] = here[k].parent_R[i];
      poses[16 * k + 4 * (i / 3) + i % 3] = here[k].H_R[i];
    }
    for (int i = 0; i < 3; i++) {
      parents[16 * k + 4 * i + 3] = here[k].parent_p[i];
      poses[16 * k + 4 * i + 3] = here[k].lever[i];
    }
  }
  free(memory);
  return converged;
}
"""
)
