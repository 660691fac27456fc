"""C text: what observations say about parameters with joint values integrated out, as in :mod:`.evidence`."""

EVIDENCE = r"""
#define UNKNOWNS 21 /* parameters, means of joint values, and a point that slides, at most */

/* As _together and _information in evidence.py. */
EXPORT void informed(const Problem *p, int64_t count, int64_t slides, const Motion *m,
                     const double *covariance, const double *places, const double *known,
                     const double *deviations, const double *mean, double *values, double *covariances,
                     double *information) {
  int rows = (int)p->rows, joints = (int)p->joints, size = (int)size_of(p), n = size + joints + (int)slides;
  memset(information, 0, n * n * sizeof(double));
  Observation o;
  for (int64_t k = 0; k < count; k++) {
    const double *C = known + joints * joints * k, *S = covariance + rows * rows * k;
    double W[36], moved[36], change[6], both[6 * UNKNOWNS] = {0}, weighted[6 * UNKNOWNS];
    if (joints) widened(C, joints, deviations, W);
    for (int i = 0; i < joints; i++) {
      double square = deviations[i] * deviations[i];
      change[i] = 0.0;
      for (int j = 0; j < joints; j++) {
        double sum = 0.0;
        for (int l = 0; l < joints; l++) sum += W[joints * i + l] * C[joints * l + j];
        covariances[joints * joints * k + joints * i + j] = square * sum;
        change[i] += square * W[joints * i + j] * (places[joints * k + j] - mean[j]);
      }
      values[joints * k + i] = o.values[i] = mean[i] + change[i];
    }
    if (rows == 6) place(p, m, &o, 6);
    else place(p, m, &o, 3);
    for (int r = 0; r < rows; r++) {
      for (int s = 0; s < rows; s++) {
        moved[rows * r + s] = S[rows * r + s];
        for (int j = 0; j < joints; j++) {
          const double *J = o.by_joints + 6 * j;
          moved[rows * r + s] += deviations[j] * deviations[j] * J[r] * J[s];
        }
      }
      for (int i = 0; i < size; i++) both[n * r + i] = o.by_parameters[MOST * r + i];
      for (int j = 0; j < joints; j++) both[n * r + size + j] = o.by_joints[6 * j + r];
    }
    if (slides) {
      double twist[6] = {0}, G[9], turned[9];
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = o.values[j];
      exponential(twist + 3, G);
      times33(m->left_R, G, turned);
      for (int r = 0; r < 3; r++)
        for (int i = 0; i < slides; i++) both[n * r + size + joints + i] = turned[3 * r + i];
    }
    if (rows == 6) invert(moved, 6, W);
    else invert(moved, 3, W);
    for (int r = 0; r < rows; r++)
      for (int i = 0; i < n; i++) {
        weighted[n * r + i] = 0.0;
        for (int s = 0; s < rows; s++) weighted[n * r + i] += W[rows * r + s] * both[n * s + i];
      }
    for (int i = 0; i < n; i++)
      for (int r = 0; r < rows; r++)
        for (int j = 0; j < n; j++) information[n * i + j] += both[n * r + i] * weighted[n * r + j];
  }
}
"""
