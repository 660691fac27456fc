/* Linearised observations of a joint. */
#pragma once
#include "small_matrices.h"

/* Rows have a fixed length, MOST, so that they are vectors; what a family has not is 0. */

typedef struct { double left_R[9], left_p[3], right_R[9], right_p[3], pitch; } Motion;

typedef struct { double mean[6], precision[6]; } Belief;

/* Covariances and their inverses; the stride from one to the next is 0 if all are alike. Round ones are the
   same in all axes. */
typedef struct { const double *covariance, *inverse; int64_t stride, round; } Noise;

typedef struct {
  /* The family: which components of twists are joint values and parameters, and the kinds of joint values. */
  int64_t rows, joints, lefts, rights, pitches, pitched, reach, slides;
  int64_t joint[6], left[6], right[6], kind[6];
  /* What was observed, and by how much errors of positions are larger while the valley narrows. */
  int64_t count, known, fresh, softer;
  const double *parent, *child, *parent_covariance, *child_covariance, *softness;
  /* Constants of the modules that say the same in numpy. */
  double reach_scale, pitch_scale, close, little, narrowest, settled, better, slid;
  double weight; /* of each observation in the evidence */
  int64_t steps, first_steps, turns, sliding_turns, mirrored_turns, mirrored_steps, widths;
  const double *grid;
  /* What a stage works with at the moment. */
  int64_t marginal, mirrored;
  Belief belief;
  Noise of_parent, of_child;
} Problem;

typedef struct {
  double parent_R[9], parent_p[3], values[6];
  double own[6], residual[6], H_R[9], lever[3], arm[3]; /* the lever from the parent, and from the joint */
  double of_parent[36], weights[36], covariance[36];
  double by_parameters[6 * MOST], by_joints[36], axes[18];
  double weighted[36], curvature[36]; /* J_a' W and J_a' W J_a */
  double inverse[36], gains[36], slope[6]; /* for a step */
} Observation;

/* A twist along or about an axis, as it moves the child at the end of a lever. */
INLINE void column(const double *axis, int about, const double *lever, double *J, int64_t stride,
                   const int rows) {
  double top[3];
  if (about) cross(axis, lever, top);
  for (int i = 0; i < 3; i++) J[i * stride] = about ? top[i] : axis[i];
  if (rows == 6)
    for (int i = 0; i < 3; i++) J[(3 + i) * stride] = about ? axis[i] : 0.0;
}

static int64_t size_of(const Problem *p) { return p->lefts + p->rights + p->pitches; }

/* The child's pose in the parent at joint values, and its derivatives. */
INLINE void place(const Problem *p, const Motion *m, Observation *o, const int rows) {
  int64_t joints = p->joints, at = 0;
  double twist[6] = {0}, G[9], PJ[9], way[3], whole[3], axis[3];
  for (int64_t j = 0; j < joints; j++) twist[p->joint[j]] = o->values[j];
  if (p->pitched) twist[2] += m->pitch * twist[5];
  exponential(twist + 3, G);
  times33(m->left_R, G, PJ);
  apply(PJ, m->right_p, o->arm);
  apply(m->left_R, twist, way);
  times33(PJ, m->right_R, o->H_R);
  for (int i = 0; i < 3; i++) {
    whole[i] = way[i] + o->arm[i];
    o->lever[i] = m->left_p[i] + whole[i];
  }
  for (int64_t j = 0; j < p->lefts; j++) {
    for (int i = 0; i < 3; i++) axis[i] = m->left_R[3 * i + p->left[j] % 3];
    column(axis, p->left[j] >= 3, whole, o->by_parameters + at++, MOST, rows);
  }
  for (int64_t j = 0; j < p->rights; j++) {
    for (int i = 0; i < 3; i++) axis[i] = PJ[3 * i + p->right[j] % 3];
    column(axis, p->right[j] >= 3, o->arm, o->by_parameters + at++, MOST, rows);
  }
  if (p->pitches)
    for (int i = 0; i < rows; i++)
      o->by_parameters[at + i * MOST] = i < 3 ? m->left_R[3 * i + 2] * twist[5] : 0.0;
  double J[9], turning[9];
  int bent = 0;
  for (int64_t j = 0; j < joints; j++) bent |= p->joint[j] == 3 || p->joint[j] == 4;
  if (bent) {
    right_jacobian(twist + 3, J);
    times33(PJ, J, turning);
  }
  for (int64_t j = 0; j < joints; j++) {
    int64_t c = p->joint[j];
    double *along = o->axes + 3 * j;
    const double *frame = c < 3 ? m->left_R : bent ? turning : PJ;
    for (int i = 0; i < 3; i++) along[i] = frame[3 * i + c % 3];
    column(along, c >= 3, o->arm, o->by_joints + 6 * j, 1, rows);
    if (c == 5 && p->pitched)
      for (int i = 0; i < 3; i++) o->by_joints[6 * j + i] += m->pitch * m->left_R[3 * i + 2];
  }
}

/* The same for a single observation, where it does not matter how long it takes. */
static void place_one(const Problem *p, const Motion *m, Observation *o) { place(p, m, o, (int)p->rows); }

/* S = Σ_B + M Σ_A Mᵀ with M = (I, -[h]x; 0, I). */
INLINE void combine(const Problem *p, Observation *o, const int rows) {
  if (p->known) return;
  const double *h = o->lever, *A = o->of_parent;
  double half[36];
  for (int i = 0; i < rows; i++)
    for (int j = 0; j < 6; j++) half[6 * i + j] = A[6 * i + j];
  for (int j = 0; j < 6; j++) {
    half[j] += h[2] * A[24 + j] - h[1] * A[30 + j];
    half[6 + j] += h[0] * A[30 + j] - h[2] * A[18 + j];
    half[12 + j] += h[1] * A[18 + j] - h[0] * A[24 + j];
  }
  for (int i = 0; i < rows; i++) {
    const double *row = half + 6 * i;
    double *S = o->covariance + rows * i;
    for (int j = 0; j < rows; j++) S[j] += row[j];
    S[0] += h[2] * row[4] - h[1] * row[5];
    S[1] += h[0] * row[5] - h[2] * row[3];
    S[2] += h[1] * row[3] - h[0] * row[4];
  }
}

/* J_a' W and J_a' W J_a; returns log |S + J_a P^-1 J_a'| - log |S|, with joint values as believed. */
INLINE double weigh(const Problem *p, Observation *o, const int rows) {
  int joints = (int)p->joints;
  for (int i = 0; i < joints; i++)
    for (int r = 0; r < rows; r++) {
      double sum = 0.0;
      for (int s = 0; s < rows; s++) sum += o->weights[rows * r + s] * o->by_joints[6 * i + s];
      o->weighted[6 * i + r] = sum;
    }
  for (int i = 0; i < joints; i++)
    for (int j = 0; j < joints; j++) {
      double sum = 0.0;
      for (int r = 0; r < rows; r++) sum += o->weighted[6 * i + r] * o->by_joints[6 * j + r];
      o->curvature[joints * i + j] = sum;
    }
  if (!p->marginal) return 0.0;
  double whole[36], sum = 0.0, root;
  for (int i = 0; i < joints * joints; i++) whole[i] = o->curvature[i];
  for (int i = 0; i < joints; i++) {
    whole[(joints + 1) * i] += p->belief.precision[i];
    sum -= log(p->belief.precision[i]);
  }
  root = factorise(whole, joints);
  return root == 0.0 ? NAN : sum + 2.0 * log(root);
}

/* The covariance of the k-th observation in other axes. */
INLINE void noise_in(const Noise *noise, int64_t k, const double *R, const int rows, double *turned) {
  const double *covariance = noise->covariance + noise->stride * k;
  if (noise->round)
    for (int i = 0; i < rows * rows; i++) turned[i] = covariance[i];
  else turn(covariance, R, rows, turned);
}

/* The square of an error in other axes, by the k-th covariance. */
INLINE double square_in(const Noise *noise, int64_t k, const double *R, const double *error, const int rows) {
  double turned[6];
  if (noise->round) return squared(error, noise->inverse + noise->stride * k, rows);
  turn_back(R, error, rows, turned);
  return squared(turned, noise->inverse + noise->stride * k, rows);
}

/* Linearise one observation; return its cost. */
INLINE double look(const Problem *p, const Motion *m, int64_t k, Observation *o, const int rows) {
  place(p, m, o, rows);
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
  cost = square_in(&p->of_child, k, o->parent_R, error, rows);
  noise_in(&p->of_child, k, o->parent_R, rows, o->covariance);
  for (int r = 0; r < rows; r++) o->residual[r] = error[r];
  if (!p->known) {
    for (int i = 0; i < 9; i++) R[i] = A[4 * (i / 3) + i % 3];
    for (int i = 0; i < 3; i++) offset[i] = A[4 * i + 3] - o->parent_p[i];
    apply_transposed(o->parent_R, offset, o->own);
    transposed_times33(o->parent_R, R, S);
    logarithm(S, o->own + 3);
    cost += square_in(&p->of_parent, k, o->parent_R, o->own, 6);
    noise_in(&p->of_parent, k, o->parent_R, 6, o->of_parent);
    cross(o->own + 3, h, offset);
    for (int i = 0; i < rows; i++) o->residual[i] -= o->own[i] + (i < 3 ? offset[i] : 0.0);
  }
  combine(p, o, rows);
  double root = invert_size(o->covariance, rows, o->weights);
  if (root == 0.0) return NAN;
  for (int64_t j = 0; j < p->joints; j++) {
    double off = o->values[j] - p->belief.mean[j];
    cost += p->belief.precision[j] * off * off;
  }
  double spread = weigh(p, o, rows);
  return p->marginal ? cost + spread + 2.0 * log(root) : cost;
}

INLINE double look_at_rows(const Problem *p, const Motion *m, Observation *all, const int rows) {
  double cost = 0.0;
  for (int64_t k = 0; k < p->count; k++) cost += look(p, m, k, all + k, rows);
  return cost;
}

/* What parameters cost: levers are within reach, and pitches ordinary. */
static double unlikely(const Problem *p, const Motion *m) {
  double cost = 0.0;
  for (int64_t i = 0; i < p->reach; i++)
    cost += m->right_p[i] * m->right_p[i] / (p->reach_scale * p->reach_scale);
  if (p->pitches) cost += m->pitch * m->pitch / (p->pitch_scale * p->pitch_scale);
  return cost;
}

static double look_at_all(const Problem *p, const Motion *m, Observation *all) {
  return unlikely(p, m) + (p->rows == 6 ? look_at_rows(p, m, all, 6) : look_at_rows(p, m, all, 3));
}

static void keep(const Problem *p, const Observation *o, double *pose, double *by_parameters,
                 double *by_joints) {
  int64_t size = size_of(p), joints = p->joints;
  for (int r = 0; r < p->rows; r++) {
    memcpy(by_parameters + size * r, o->by_parameters + MOST * r, size * sizeof(double));
    for (int j = 0; j < joints; j++) by_joints[joints * r + j] = o->by_joints[6 * j + r];
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) pose[4 * i + j] = o->H_R[3 * i + j];
    pose[4 * i + 3] = o->lever[i];
  }
  for (int j = 0; j < 4; j++) pose[12 + j] = j == 3;
}

/* As GroupMotion.linearise in families.py. */
EXPORTED void at(const Problem *p, int64_t count, const Motion *m, const double *values, double *poses,
                 double *by_parameters, double *by_joints) {
  Observation o;
  for (int64_t k = 0; k < count; k++) {
    memcpy(o.values, values + p->joints * k, p->joints * sizeof(double));
    place_one(p, m, &o);
    int64_t each = p->rows * k;
    keep(p, &o, poses + 16 * k, by_parameters + size_of(p) * each, by_joints + p->joints * each);
  }
}
