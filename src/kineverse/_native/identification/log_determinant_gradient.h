/* Gradient of the log-determinants of observations by the parameters of a joint.

   With T = S + J_a P⁻¹ J_aᵀ for an observation, Π = T⁻¹ and the gains G = P⁻¹ J_aᵀ Π,

       d log |T| = tr(Π dS) + 2 tr(G dJ_a)

   S depends on the lever h of the parent alone, with d log |T| = 2 q·dh. A rotation of the joint's frame
   rotates the columns of J_a, a lever of the joint changes the effect of its rotations, and the joint values
   follow the parameters. */
#pragma once
#include "linearisation.h"

/* How the axes of turns about more than one axis change with joint value l, weighed by v for each of them:
   the columns of L J(a), with J(a) e = e + b a x e + d a x (a x e). */
static double bend(const Problem *p, const Motion *m, const Observation *o, int l, const double *v) {
  double a[3] = {0}, u[3] = {0}, sum = 0.0;
  for (int j = 0; j < p->joints; j++)
    if (p->joint[j] >= 3) a[p->joint[j] - 3] = o->values[j];
  u[p->joint[l] - 3] = 1.0;
  double square = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], angle = sqrt(square), b, d, db, dd;
  if (square < 1e-4) {
    b = 0.5 - square / 24.0;
    d = 1.0 / 6.0 - square / 120.0;
    db = -1.0 / 12.0 + square / 180.0;
    dd = -1.0 / 60.0 + square / 1260.0;
  } else {
    b = (1.0 - cos(angle)) / square;
    d = (angle - sin(angle)) / (square * angle);
    db = (sin(angle) / angle - 2.0 * b) / square;
    dd = (b - 3.0 * d) / square;
  }
  double along = a[0] * u[0] + a[1] * u[1] + a[2] * u[2];
  for (int j = 0; j < p->joints; j++) {
    int64_t c = p->joint[j] - 3;
    if (c < 0) continue;
    double e[3] = {0}, ae[3], aae[3], ue[3], uae[3], aue[3], in_left[3];
    e[c] = 1.0;
    cross(a, e, ae);
    cross(a, ae, aae);
    cross(u, e, ue);
    cross(u, ae, uae);
    cross(a, ue, aue);
    apply_transposed(m->left_R, v + 3 * j, in_left);
    for (int i = 0; i < 3; i++)
      sum += in_left[i] * (along * (db * ae[i] + dd * aae[i]) + b * ue[i] + d * (uae[i] + aue[i]));
  }
  return sum;
}

/* Take half the slope of the width of one observation off what the parameters are pushed by. */
INLINE void widen(const Problem *p, const Motion *m, const Observation *o, const double *left, double *right,
                  const int rows) {
  int joints = (int)p->joints, bent = 0;
  double q[3] = {0}, by_arm[3], by_turn[3] = {0}, by_axis[18], own[6], c[3];
  if (!p->known) {
    /* The lower left of Σ_A Mᵀ Π, where Mᵀ Π is Π with [h]x times its upper rows added to the lower. */
    double back[9], Q[9];
    for (int i = 0; i < 3; i++)
      for (int s = 0; s < 3; s++) {
        Q[3 * i + s] = 0.0;
        for (int r = 0; r < rows; r++) Q[3 * i + s] += o->of_parent[6 * (3 + i) + r] * left[rows * r + s];
      }
    for (int s = 0; s < 3; s++) {
      double above[3] = {left[s], left[rows + s], left[2 * rows + s]};
      cross(o->lever, above, c);
      for (int i = 0; i < 3; i++) back[3 * i + s] = c[i];
    }
    for (int i = 0; i < 3; i++)
      for (int s = 0; s < 3; s++)
        for (int r = 0; r < 3; r++) Q[3 * i + s] += o->of_parent[6 * (3 + i) + 3 + r] * back[3 * r + s];
    q[0] = Q[7] - Q[5];
    q[1] = Q[2] - Q[6];
    q[2] = Q[3] - Q[1];
  }
  for (int i = 0; i < 3; i++) by_arm[i] = q[i];
  for (int j = 0; j < joints; j++) {
    const double *gains = o->gains + 6 * j, *J = o->by_joints + 6 * j;
    for (int r = 0; r < rows; r += 3) {
      cross(J + r, gains + r, c);
      for (int i = 0; i < 3; i++) by_turn[i] += c[i];
    }
    if (p->joint[j] < 3) continue;
    bent |= p->joint[j] < 5;
    cross(gains, o->axes + 3 * j, c);
    for (int i = 0; i < 3; i++) by_arm[i] += c[i];
    cross(o->arm, gains, by_axis + 3 * j);
    if (rows == 6)
      for (int i = 0; i < 3; i++) by_axis[3 * j + i] += gains[3 + i];
  }
  for (int l = 0; l < joints; l++) {
    const double *J = o->by_joints + 6 * l;
    own[l] = q[0] * J[0] + q[1] * J[1] + q[2] * J[2];
    if (p->joint[l] < 3) continue;
    cross(o->axes + 3 * l, o->arm, c);
    for (int i = 0; i < 3; i++) own[l] += (by_arm[i] - q[i]) * c[i];
    if (bent) own[l] += bend(p, m, o, l, by_axis);
  }
  int n = (int)size_of(p);
  for (int i = 0; i < n; i++) {
    const double *J = o->by_parameters + i;
    const double *by_lever = i >= p->lefts && i < p->lefts + p->rights ? by_arm : q;
    double slope = 0.0;
    for (int r = 0; r < 3; r++) slope += by_lever[r] * J[MOST * r];
    if (i < p->lefts && p->left[i] >= 3)
      for (int r = 0; r < 3; r++) slope += m->left_R[3 * r + p->left[i] - 3] * by_turn[r];
    if (p->pitches && i == n - 1)
      for (int r = 0; r < 3; r++) slope += o->gains[r] * m->left_R[3 * r + 2];
    for (int j = 0; j < joints; j++)
      for (int r = 0; r < rows; r++) slope -= own[j] * o->gains[6 * j + r] * J[MOST * r];
    right[i] -= slope;
  }
}
