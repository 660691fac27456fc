/* Linearised observations of a joint. */
#pragma once
#include "small_matrices.h"

/* Rows of derivatives by parameters have a fixed length, MOST, so that they are vectors. */

#define ALL 6 /* joint values of a function at most */

/* Covariances and their inverses; the stride from one to the next is 0 if all are alike. Round ones are the
   same in all axes. */
typedef struct { const double *covariance, *inverse; int64_t stride, round; } Noise;

typedef struct {
  /* Generated functions of the motion, see motion_functions.py, and of observations, see observation_functions.
     Each has one input and one output; their numbers of states, steps, joint values and residuals. */
  Function linearise, retract, slope, prior, errors, turn_parent;
  int64_t states, steps, all_joints, priors;
  /* The family: the steps that are parameters, rows of the prior, parameters that move the mean pose, joint
     values with limits and kinds, and a precision of parameters and means that keeps the information regular. */
  int64_t rows, size, beliefs, movers, joints;
  int64_t parameter[MOST], belief[MOST], mover[MOST], joint[ALL], kind[ALL];
  double largest[ALL], lower[ALL], upper[ALL], regular[UNKNOWNS];
  int64_t count;
  const double *parent, *child, *parent_covariance, *child_covariance;
  double close, little;
  int64_t widths;
  const double *grid;
  int64_t marginal; /* joint values are integrated out; their prior: */
  double mean[ALL], precision[ALL];
  Noise of_parent, of_child; /* as a solution works with them */
} Problem;

typedef struct {
  double parent[12], values[ALL];
  double own[6], residual[6], H[12];
  double of_parent[36], weights[36], covariance[36];
  double by_parameters[6 * MOST], by_joints[36];
  double weighted[36], curvature[36]; /* J_a' W and J_a' W J_a */
  double inverse[36], gains[36], slope[6]; /* for a step */
} Observation;

INLINE void call(Function f, const double *input, double *output) {
  const double *inputs[1] = {input};
  double *outputs[1] = {output};
  f(inputs, outputs, NULL, NULL, 0);
}

/* State and joint values as the functions take them; returns what is behind them. */
INLINE double *fill(const Problem *p, const double *x, const double *values, double *input) {
  double *a = input + p->states;
  memcpy(input, x, p->states * sizeof(double));
  for (int64_t j = 0; j < p->all_joints; j++) a[j] = 0.0;
  for (int64_t j = 0; j < p->joints; j++) a[p->joint[j]] = values[j];
  return a + p->all_joints;
}

/* The child's pose in the parent at joint values, and its derivatives. */
INLINE void place(const Problem *p, const double *x, Observation *o, const int rows) {
  double input[STATES + ALL], output[12 + 6 * (STEPS + ALL)];
  const double *by_step = output + 12, *by_joint = by_step + 6 * p->steps;
  fill(p, x, o->values, input);
  call(p->linearise, input, output);
  memcpy(o->H, output, sizeof o->H);
  for (int64_t i = 0; i < p->size; i++)
    for (int r = 0; r < rows; r++) o->by_parameters[MOST * r + i] = by_step[6 * p->parameter[i] + r];
  for (int64_t j = 0; j < p->joints; j++)
    for (int r = 0; r < rows; r++) o->by_joints[6 * j + r] = by_joint[6 * p->joint[j] + r];
}

/* M times a vector or the columns of a matrix, with M = (I, -[h]x; 0, I): the child's displacement by an error
   of the parent. */
INLINE void displace(const double *h, const double *e, const int stride, double *to, const int rows) {
  for (int r = 0; r < rows; r++) to[stride * r] = e[stride * r];
  to[0] += h[2] * e[4 * stride] - h[1] * e[5 * stride];
  to[stride] += h[0] * e[5 * stride] - h[2] * e[3 * stride];
  to[2 * stride] += h[1] * e[3 * stride] - h[0] * e[4 * stride];
}

/* S = Σ_B + M Σ_A Mᵀ */
INLINE void combine(Observation *o, const double *h, const int rows) {
  double half[36], row[6];
  for (int j = 0; j < 6; j++) displace(h, o->of_parent + j, 6, half + j, rows);
  for (int i = 0; i < rows; i++) {
    displace(h, half + 6 * i, 1, row, rows);
    for (int j = 0; j < rows; j++) o->covariance[rows * i + j] += row[j];
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
    whole[(joints + 1) * i] += p->precision[i];
    sum -= log(p->precision[i]);
  }
  root = factorise(whole, joints);
  return root == 0.0 ? NAN : sum + 2.0 * log(root);
}

/* The square of an error in the axes of R, by the k-th covariance, which is left in these axes. */
INLINE double square_in(const Noise *noise, int64_t k, const double *pose, const double *error, const int rows,
                        double *covariance) {
  const double *given = noise->covariance + noise->stride * k, *inverse = noise->inverse + noise->stride * k;
  if (noise->round) {
    memcpy(covariance, given, rows * rows * sizeof(double));
    return squared(error, inverse, rows);
  }
  double R[9], turned[6];
  for (int i = 0; i < 9; i++) R[i] = pose[4 * (i / 3) + i % 3];
  turn(given, R, rows, covariance);
  for (int i = 0; i < rows; i += 3) apply(R, error + i, turned + i);
  return squared(turned, inverse, rows);
}

/* Linearise one observation; return its cost. */
INLINE double look(const Problem *p, const double *x, int64_t k, Observation *o, const int rows) {
  double input[48], errors[12], moved[6], cost;
  place(p, x, o, rows);
  memcpy(input, o->parent, 12 * sizeof(double));
  memcpy(input + 12, o->H, 12 * sizeof(double));
  memcpy(input + 24, p->parent + 16 * k, 12 * sizeof(double));
  memcpy(input + 36, p->child + 16 * k, 12 * sizeof(double));
  call(p->errors, input, errors);
  cost = square_in(&p->of_child, k, o->parent, errors + 6, rows, o->covariance);
  memcpy(o->residual, errors + 6, rows * sizeof(double));
  if (p->parent_covariance) {
    const double h[3] = {o->H[3], o->H[7], o->H[11]};
    memcpy(o->own, errors, sizeof o->own);
    cost += square_in(&p->of_parent, k, o->parent, o->own, 6, o->of_parent);
    displace(h, o->own, 1, moved, rows);
    for (int i = 0; i < rows; i++) o->residual[i] -= moved[i];
    combine(o, h, rows);
  }
  double root = invert_size(o->covariance, rows, o->weights);
  if (root == 0.0) return NAN;
  for (int64_t j = 0; j < p->joints; j++) {
    double off = o->values[j] - p->mean[j];
    cost += p->precision[j] * off * off;
  }
  double spread = weigh(p, o, rows);
  return p->marginal ? cost + spread + 2.0 * log(root) : cost;
}

/* Residuals of the prior of the parameters and their derivatives, added to a normal equation. Returns the cost. */
static double believe(const Problem *p, const double *x, double *normal, double *right) {
  double output[PRIORS * (1 + STEPS)], cost = 0.0;
  if (!p->beliefs) return 0.0;
  call(p->prior, x, output);
  for (int64_t b = 0; b < p->beliefs; b++) {
    const double off = output[p->belief[b]], *by = output + p->priors + p->steps * p->belief[b];
    cost += off * off;
    for (int64_t i = 0; normal && i < p->size; i++) {
      right[i] -= by[p->parameter[i]] * off;
      for (int64_t j = 0; j < p->size; j++)
        normal[MOST * i + j] += by[p->parameter[i]] * by[p->parameter[j]];
    }
  }
  return cost;
}

static double look_at_all(const Problem *p, const double *x, Observation *all) {
  double cost = believe(p, x, NULL, NULL);
  for (int64_t k = 0; k < p->count; k++)
    cost += p->rows == 6 ? look(p, x, k, all + k, 6) : look(p, x, k, all + k, 3);
  return cost;
}

static void keep(const Problem *p, const Observation *o, double *pose, double *by_parameters,
                 double *by_joints) {
  for (int r = 0; r < p->rows; r++) {
    memcpy(by_parameters + p->size * r, o->by_parameters + MOST * r, p->size * sizeof(double));
    for (int64_t j = 0; j < p->joints; j++) by_joints[p->joints * r + j] = o->by_joints[6 * j + r];
  }
  memcpy(pose, o->H, sizeof o->H);
  for (int j = 0; j < 4; j++) pose[12 + j] = j == 3;
}

/* Poses at joint values, and their derivatives. */
EXPORTED void evaluate(const Problem *p, int64_t count, const double *x, const double *values, double *poses,
                       double *by_parameters, double *by_joints) {
  Observation o;
  for (int64_t k = 0; k < count; k++) {
    memcpy(o.values, values + p->joints * k, p->joints * sizeof(double));
    place(p, x, &o, (int)p->rows);
    keep(p, &o, poses + 16 * k, by_parameters + p->rows * p->size * k, by_joints + p->rows * p->joints * k);
  }
}
