/* Evaluation of a program at many points. `program.h` is generated: sizes, constants, and the function `compute`. */

#include "simd_functions.h"
#include "simd_rows.h"
#include "program.h"

#define PADDED(n) (((n) + W - 1) / W * W)

/* Compute rows of outputs from rows of inputs; return 1 if there is no memory. */
EXPORTED int kineverse_batch(const double *in, double *const *out, long long rows, int streaming) {
  static const int sizes[] = {SIZES};
  /* Whole cache lines: inputs, outputs, store, rows that are padded, rows that wait to be streamed. */
  const size_t vectors = PADDED(INPUTS) + PADDED(RESULTS) + STORED + PADDED(INPUTS) + 1 + RESULTS + OUTPUTS;
  void *memory = malloc(vectors * sizeof(V) + OUTPUTS * sizeof(Output) + 64);
  if (!memory) return 1;
  V *x = (V *)(((size_t)memory + 63) & ~(size_t)63), *o = x + PADDED(INPUTS), *store = o + PADDED(RESULTS);
  double *padded = (double *)(store + STORED), *pending = padded + W * (PADDED(INPUTS) + 1);
  Output *outputs = (Output *)(pending + W * (RESULTS + OUTPUTS));
  memset(x, 0, vectors * sizeof(V));
  for (int k = 0; k < OUTPUTS; k++) {
    output_begin(outputs + k, out[k], sizes[k], pending, streaming);
    pending += W * (sizes[k] + 1);
  }
  /* The first entries are there because no table is empty. */
  for (int k = 1; k <= CONSTANTS; k++) o[constant_place[k]] = splat(constant[k]);
  const long long full = rows / W * W;
  const int left = (int)(rows - full);
  for (long long row = 0; row < rows; row += W) {
    const double *from = in + row * INPUTS;
    /* Vectors of the last row of a block reach beyond it. Behind the last row of all may be nothing: blocks
       whose vectors reach there are read from a copy. */
    if ((rows - row - W) * INPUTS < PADDED(INPUTS) - INPUTS) {
      const int there = row == full ? left : W;
      for (int i = 0; i < W; i++)
        memcpy(padded + i * INPUTS, from + (i < there ? i : there - 1) * INPUTS, INPUTS * sizeof(double));
      from = padded;
    }
    read_rows(from, INPUTS, x);
    compute(x, 0, store, o);
    if (row == full) break;
    const V *results = o;
    for (int k = 0; k < OUTPUTS; k++) {
      output_write(outputs + k, results);
      results += sizes[k];
    }
  }
  const V *results = o;
  for (int k = 0; k < OUTPUTS; k++) {
    output_end(outputs + k);
    for (int c = 0; c < sizes[k]; c++)
      for (int i = 0; i < left; i++) outputs[k].next[(long long)i * sizes[k] + c] = results[c][i];
    results += sizes[k];
  }
  stream_end();
  free(memory);
  return 0;
}
