"""C text: the point of the child whose slides are a joint value, as in :mod:`.sliding`."""

SLIDING = r"""
/* As slid in sliding.py: motion, values and derivatives are changed in their place. Returns 0 without
   memory. */
EXPORT int64_t slid(const Problem *p, int64_t count, int64_t slides, int64_t turns, double close,
                    double reach, double little, int64_t size, const double *grid, const int64_t *kinds,
                    const double *covariance, const double *residuals, Motion *m, double *values,
                    double *poses, double *by_parameters, double *by_joints) {
  int joints = (int)p->joints, n = joints + (int)slides;
  double *memory = malloc(count * (joints + joints * joints + 9) * sizeof(double));
  if (!memory) return 0;
  double *places = memory, *known = places + count * joints, *turned = known + count * joints * joints;
  double most = INFINITY;
  for (int64_t turn = 0; turn < turns && most > close; turn++) {
    double deviations[6], mean[6], normal[81] = {0}, change[9] = {0};
    memcpy(places, values, count * joints * sizeof(double));
    alone(count, p->rows, joints, little, covariance, by_joints, residuals, places, known);
    if (isnan(widths(count, joints, kinds, places, known, size, grid, deviations, mean))) break;
    for (int64_t k = 0; k < count; k++) {
      /* What the mean and the point make of joint values. */
      double twist[6] = {0}, W[36], by[54] = {0}, weighted[54], *G = turned + 9 * k;
      for (int j = 0; j < joints; j++) twist[p->joint[j]] = values[joints * k + j];
      exponential(twist + 3, G);
      for (int i = 0; i < joints; i++) by[n * i + i] = 1.0;
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++) by[n * i + joints + j] = G[3 * i + j];
      widened(known + joints * joints * k, joints, deviations, W);
      for (int i = 0; i < joints; i++)
        for (int c = 0; c < n; c++) {
          weighted[n * i + c] = 0.0;
          for (int j = 0; j < joints; j++) weighted[n * i + c] += W[joints * i + j] * by[n * j + c];
        }
      for (int c = 0; c < n; c++)
        for (int i = 0; i < joints; i++) {
          change[c] += weighted[n * i + c] * places[joints * k + i];
          for (int e = 0; e < n; e++) normal[n * c + e] += weighted[n * i + c] * by[n * i + e];
        }
    }
    for (int i = 0; i < slides; i++) {
      normal[(n + 1) * (joints + i)] += 1.0 / (reach * reach);
      change[joints + i] -= m->right_p[i] / (reach * reach);
    }
    factorise(normal, n);
    resolve(normal, n, change);
    most = 0.0;
    for (int i = 0; i < slides; i++) {
      m->right_p[i] += change[joints + i];
      most = fmax(most, fabs(change[joints + i]));
    }
    for (int64_t k = 0; k < count; k++)
      for (int i = 0; i < slides; i++)
        for (int j = 0; j < slides; j++)
          values[joints * k + i] -= turned[9 * k + 3 * i + j] * change[joints + j];
    at(p, count, m, values, poses, by_parameters, by_joints);
  }
  free(memory);
  return 1;
}
"""
