/* Rows of a quadratic program that keep near pairs of bodies apart. */

#include "definitions.h"

#include <stdint.h>

typedef struct {
  int64_t n, width, bodies, used; /* speeds, all variables, bodies, rows */
  const int64_t *group;           /* of each body, among the twists */
  const double *twists, *margins; /* (groups, 6, n), (bodies, bodies) */
  double *H, *f, *A, *lower;
  const double *distances, *witnesses;
  const int32_t *owners;
  double gain, recovery, weight, inwards;
} Rows;

static void add(double *row, const double *twist, int64_t n, const double *p, const double *m, double sign) {
  const double wrench[6] = {m[0], m[1], m[2], p[1] * m[2] - p[2] * m[1], p[2] * m[0] - p[0] * m[2],
                            p[0] * m[1] - p[1] * m[0]};
  for (int i = 0; i < 6; i++)
    for (int64_t j = 0; j < n; j++) row[j] += sign * wrench[i] * twist[i * n + j];
}

EXPORTED void write_rows(const Rows *r) {
  const int64_t n = r->n;
  for (int64_t k = 0; k < r->used; k++) {
    const int32_t a = r->owners[2 * k], b = r->owners[2 * k + 1];
    const double *witness = r->witnesses + 9 * k, gap = r->distances[k] - r->margins[r->bodies * a + b];
    double *row = r->A + r->width * k;
    for (int64_t j = 0; j < n; j++) row[j] = 0.0;
    add(row, r->twists + 6 * n * r->group[b], n, witness + 3, witness + 6, 1.0);
    add(row, r->twists + 6 * n * r->group[a], n, witness, witness + 6, -1.0);
    r->lower[k] = gap > 0.0 ? -r->gain * gap : 0.0;
    if (!(gap < 0.0)) continue;
    const double rate = r->recovery * (r->inwards - gap);
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) r->H[r->width * i + j] += r->weight * row[i] * row[j];
      r->f[i] -= r->weight * rate * row[i];
    }
  }
}
