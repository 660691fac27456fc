"""C text: what :func:`.solving.solve` does for the families of joints, in the same steps."""

from .native_algebra import ALGEBRA

SOLVE = (
    ALGEBRA
    + r"""
#define EXPORT __attribute__((visibility("default")))
#define MOST 11 /* parameters of a family */

typedef struct {
  int64_t count, rows, joints, lefts, rights, pitched, reach, known, marginal;
  int64_t joint[6], left[6], right[6];
  const double *parent, *child, *parent_covariance, *child_covariance;
  double reach_scale, pitch_scale, close, mean[6], precision[6]; /* what is believed of joint values */
} Problem;

typedef struct { double left_R[9], left_p[3], right_R[9], right_p[3], pitch; } Motion;

typedef struct {
  double parent_R[9], parent_p[3], values[6];
  double own[6], residual[6], lever[3], H_R[9];
  double of_parent[36], of_child[36], weights[36], covariance[36];
  double by_parameters[6 * MOST], by_joints[36];
} Observation;

/* A twist along or about a column of a frame, as it moves the child at the end of a lever. */
static void column(const double *R, int64_t component, const double *lever, double *J, int64_t stride,
                   int rows) {
  double axis[3], top[3];
  int about = component >= 3, c = component % 3;
  for (int i = 0; i < 3; i++) axis[i] = R[3 * i + c];
  if (about) cross(axis, lever, top);
  for (int i = 0; i < 3; i++) J[i * stride] = about ? top[i] : axis[i];
  if (rows == 6)
    for (int i = 0; i < 3; i++) J[(3 + i) * stride] = about ? axis[i] : 0.0;
}

static int64_t size_of(const Problem *p) { return p->lefts + p->rights + p->pitched; }

/* The child's pose in the parent at joint values, and its derivatives. */
static void place(const Problem *p, const Motion *m, Observation *o) {
  int rows = (int)p->rows;
  int64_t n = size_of(p), joints = p->joints;
  double twist[6] = {0}, G[9], PJ[9], lever[3], way[3], whole[3];
  for (int64_t j = 0; j < joints; j++) twist[p->joint[j]] = o->values[j];
  if (p->pitched) twist[2] += m->pitch * twist[5];
  exponential(twist + 3, G);
  times33(m->left_R, G, PJ);
  apply(PJ, m->right_p, lever);
  apply(m->left_R, twist, way);
  times33(PJ, m->right_R, o->H_R);
  for (int i = 0; i < 3; i++) {
    whole[i] = way[i] + lever[i];
    o->lever[i] = m->left_p[i] + whole[i];
  }
  int64_t at = 0;
  for (int64_t j = 0; j < p->lefts; j++)
    column(m->left_R, p->left[j], whole, o->by_parameters + at++, n, rows);
  for (int64_t j = 0; j < p->rights; j++)
    column(PJ, p->right[j], lever, o->by_parameters + at++, n, rows);
  if (p->pitched)
    for (int i = 0; i < rows; i++)
      o->by_parameters[at + i * n] = i < 3 ? m->left_R[3 * i + 2] * twist[5] : 0.0;
  double J[9], turning[9];
  int bent = 0;
  for (int64_t j = 0; j < joints; j++) bent |= p->joint[j] == 3 || p->joint[j] == 4;
  if (bent) {
    right_jacobian(twist + 3, J);
    times33(PJ, J, turning);
  }
  for (int64_t j = 0; j < joints; j++) {
    int64_t c = p->joint[j];
    column(c < 3 ? m->left_R : bent ? turning : PJ, c, lever, o->by_joints + j, joints, rows);
    if (c == 5 && p->pitched)
      for (int i = 0; i < 3; i++) o->by_joints[i * joints + j] += m->pitch * m->left_R[3 * i + 2];
  }

}

/* S = Σ_B + M Σ_A Mᵀ with M = (I, -[h]x; 0, I). */
static void combine(const Problem *p, Observation *o) {
  int rows = (int)p->rows;
  const double *h = o->lever;
  memcpy(o->covariance, o->of_child, rows * rows * sizeof(double));
  if (p->known) return;
  double M[18] = {0, 0, 0, 0, h[2], -h[1], 0, 0, 0, -h[2], 0, h[0], 0, 0, 0, h[1], -h[0], 0}, half[36];
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < 6; j++) {
      half[6 * i + j] = o->of_parent[6 * i + j];
      if (i < 3)
        for (int l = 3; l < 6; l++) half[6 * i + j] += M[6 * i + l] * o->of_parent[6 * l + j];
    }
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < rows; j++) {
      o->covariance[rows * i + j] += half[6 * i + j];
      if (j < 3)
        for (int l = 3; l < 6; l++) o->covariance[rows * i + j] += half[6 * i + l] * M[6 * j + l];
    }
}

/* log |S + J_a P^-1 J_a'|: what the width of what is seen costs, with joint values as believed. */
static double spread(const Problem *p, Observation *o) {
  int rows = (int)p->rows, joints = (int)p->joints;
  double whole[36], sum = 0.0;
  memcpy(whole, o->covariance, rows * rows * sizeof(double));
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < rows; j++)
      for (int l = 0; l < joints; l++)
        whole[rows * i + j] += o->by_joints[i * joints + l] * o->by_joints[j * joints + l] / p->precision[l];
  if (!factorise(whole, rows)) return NAN;
  for (int i = 0; i < rows; i++) sum += log(whole[(rows + 1) * i]);
  return 2.0 * sum;
}

/* Linearise one observation; return its cost. */
static double look(const Problem *p, const Motion *m, int64_t k, Observation *o) {
  int rows = (int)p->rows;
  place(p, m, o);
  const double *A = p->parent + 16 * k, *B = p->child + 16 * k, *h = o->lever;
  double R[9], S[9], T[9], offset[3], error[6], cost;
  for (int i = 0; i < 9; i++) R[i] = B[4 * (i / 3) + i % 3];
  for (int i = 0; i < 3; i++) offset[i] = B[4 * i + 3] - o->parent_p[i];
  apply_transposed(o->parent_R, offset, error);
  for (int i = 0; i < 3; i++) error[i] -= h[i];
  if (rows == 6) {
    transposed_times33(o->parent_R, R, S);
    times_transposed33(S, o->H_R, T);
    logarithm(T, error + 3);
  }
  turn(p->child_covariance + rows * rows * k, o->parent_R, rows, o->of_child);
  cost = squared(error, o->of_child, rows);
  memcpy(o->residual, error, sizeof error);
  if (!p->known) {
    for (int i = 0; i < 9; i++) R[i] = A[4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) offset[i] = A[4 * i + 3] - o->parent_p[i];
    apply_transposed(o->parent_R, offset, o->own);
    transposed_times33(o->parent_R, R, S);
    logarithm(S, o->own + 3);
    turn(p->parent_covariance + 36 * k, o->parent_R, 6, o->of_parent);
    cost += squared(o->own, o->of_parent, 6);
    cross(o->own + 3, h, offset);
    for (int i = 0; i < rows; i++) o->residual[i] -= o->own[i] + (i < 3 ? offset[i] : 0.0);
  }
  combine(p, o);
  if (!invert(o->covariance, rows, o->weights)) return NAN;
  for (int64_t j = 0; j < p->joints; j++) {
    double off = o->values[j] - p->mean[j];
    cost += p->precision[j] * off * off;
  }
  return p->marginal ? cost + spread(p, o) : cost;
}

static double look_at_all(const Problem *p, const Motion *m, Observation *all) {
  double cost = 0.0;
  for (int64_t i = 0; i < p->reach; i++)
    cost += m->right_p[i] * m->right_p[i] / (p->reach_scale * p->reach_scale);
  if (p->pitched) cost += m->pitch * m->pitch / (p->pitch_scale * p->pitch_scale);
  for (int64_t k = 0; k < p->count; k++) cost += look(p, m, k, all + k);
  return cost;
}

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
                     double *cost, double *residuals, double *covariances) {
  int64_t joints = p->joints, rows = p->rows;
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
    for (int i = 0; i < 9; i++) parents[16 * k + 4 * (i / 3) + i % 3] = here[k].parent_R[i];
    for (int i = 0; i < 3; i++) parents[16 * k + 4 * i + 3] = here[k].parent_p[i];
  }
  free(memory);
  return converged;
}
"""
)
