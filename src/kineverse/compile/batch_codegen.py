"""C source of batches: a program for SIMD vectors, and the loop over rows of doubles."""

from __future__ import annotations

import hashlib

import casadi as ca

from . import vector_codegen
from .program import Program, c_literal
from .schedule import StraightLine, read_instructions, schedule
from .simd import vector_header
from .simd_rows import ROWS
from .vector_codegen import VECTOR, generate_parts

_LOOP = r"""
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
"""

_TEXTS = vector_header("double") + ROWS

# Raise the number when other source is generated from the same program and texts.
BATCH_KIND = "batch 4 " + hashlib.sha256((_TEXTS + _LOOP + repr(VECTOR)).encode()).hexdigest()


def generate_batch_source(program: Program) -> str:
    """Return the C source of ``kineverse_batch``, which evaluates a program at many points.

    Its arguments are the rows of inputs, a pointer to the rows of each output, the number of rows, and a flag
    to write the outputs past the caches.
    """
    whole = read_instructions(program.function)
    # Constants are written once, and not for each vector.
    is_constant = [step.op == ca.OP_CONST for step in whole.steps]
    constants = [(place, whole.steps[v].constant) for place, v in whole.outputs if is_constant[v]]
    computed = StraightLine(whole.steps, [(place, v) for place, v in whole.outputs if not is_constant[v]])
    plan = schedule(computed, vector_codegen.PART_LENGTH)
    definitions = {
        "INPUTS": program.size,
        "OUTPUTS": len(program.sizes),
        "RESULTS": sum(program.sizes),
        "STORED": plan.stored,
        "CONSTANTS": len(constants),
        "SIZES": ", ".join(map(str, program.sizes)),
    }
    numbers = ", ".join(["0", *(c_literal(c) for _, c in constants)])
    places = ", ".join(["0", *(str(place) for place, _ in constants)])
    return "\n".join(
        [
            _TEXTS,
            *(f"#define {name} {value}" for name, value in definitions.items()),
            generate_parts(plan, "compute", VECTOR),
            f"static const double constant[] = {{{numbers}}};",
            f"static const int constant_place[] = {{{places}}};",
            _LOOP,
        ]
    )
