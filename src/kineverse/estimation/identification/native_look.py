"""C text: one observation, linearised, as ``_point`` in :mod:`.solving` does it for all."""

LOOK = r"""
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
"""
