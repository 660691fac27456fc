/* Most likely point of the child that a translation moves; poses do not depend on it, the prior of values does. */
#pragma once
#include "joint_ranges.h"

/* The poses of a solution and their derivatives, at its joint values. */
static void place_all(const Problem *p, Answer *a) {
  at(p, p->count, &a->head->motion, a->values, a->poses, a->by_parameters, a->by_joints);
}

/* As optimise_sliding_point in joint_values.py: motion, values and derivatives are changed in their place. */
static void slide(const Problem *p, Answer *a, double *memory) {
  int joints = (int)p->joints, slides = (int)p->slides, n = joints + slides;
  Motion *m = &a->head->motion;
  double most = slides ? INFINITY : 0.0, *turned = memory;
  memory = turned + 9 * p->count;
  for (int64_t turn = 0; turn < p->sliding_turns && most > p->slid && !look_at_clock(&watch); turn++) {
    double normal[81] = {0}, change[9] = {0};
    Apart apart;
    take_apart(p, a, &apart, memory);
    for (int64_t k = 0; k < p->count; k++) {
      /* What the mean and the point make of joint values. */
      double twist[6] = {0}, W[36], by[54] = {0}, weighted[54], *G = turned + 9 * k;
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = a->values[joints * k + j];
      exponential(twist + 3, G);
      for (int i = 0; i < joints; i++) by[n * i + i] = 1.0;
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++) by[n * i + joints + j] = G[3 * i + j];
      widened(apart.covariances + joints * joints * k, joints, apart.deviations, W);
      for (int i = 0; i < joints; i++)
        for (int c = 0; c < n; c++) {
          weighted[n * i + c] = 0.0;
          for (int j = 0; j < joints; j++) weighted[n * i + c] += W[joints * i + j] * by[n * j + c];
        }
      for (int c = 0; c < n; c++)
        for (int i = 0; i < joints; i++) {
          change[c] += weighted[n * i + c] * apart.values[joints * k + i];
          for (int e = 0; e < n; e++) normal[n * c + e] += weighted[n * i + c] * by[n * i + e];
        }
    }
    double scale = 1.0 / (p->reach_scale * p->reach_scale);
    for (int i = 0; i < slides; i++) {
      normal[(n + 1) * (joints + i)] += scale;
      change[joints + i] -= m->right_p[i] * scale;
    }
    factorise(normal, n);
    resolve(normal, n, change);
    most = 0.0;
    for (int i = 0; i < slides; i++) {
      m->right_p[i] += change[joints + i];
      most = fmax(most, fabs(change[joints + i]));
    }
    for (int64_t k = 0; k < p->count; k++)
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++)
          a->values[joints * k + i] -= turned[9 * k + 3 * i + j] * change[joints + j];
    place_all(p, a);
  }
}
