"""C for many configurations at once: the operations of a program on vectors of configurations."""

from __future__ import annotations

import hashlib

import casadi as ca

from .program import Program, literal
from .schedule import Part, Schedule, Step, schedule
from .vector_functions import ARITHMETIC, EXPONENTIAL, TRIGONOMETRIC, by_lane
from .vector_types import ROWS, TYPES

# How operations are written; a and b are the operands, z is zero.
_PLAIN = {
    ca.OP_ASSIGN: "{a}",
    ca.OP_LIFT: "{a}",
    ca.OP_ADD: "{a} + {b}",
    ca.OP_SUB: "{a} - {b}",
    ca.OP_MUL: "{a} * {b}",
    ca.OP_DIV: "{a} / {b}",
    ca.OP_NEG: "-{a}",
    ca.OP_SQ: "{a} * {a}",
    ca.OP_TWICE: "splat(2.0) * {a}",
    ca.OP_INV: "splat(1.0) / {a}",
    ca.OP_SQRT: "root({a})",
    ca.OP_FABS: "magnitude({a})",
    ca.OP_SIGN: "sign_({a})",
    ca.OP_COPYSIGN: "with_sign_of({a}, {b})",
    ca.OP_FLOOR: "down({a})",
    ca.OP_CEIL: "up({a})",
    ca.OP_FMIN: "smaller({a}, {b})",
    ca.OP_FMAX: "larger({a}, {b})",
    ca.OP_TAN: "tan_({a})",
    ca.OP_ASIN: "asin_({a})",
    ca.OP_ACOS: "acos_({a})",
    ca.OP_ATAN: "atan_({a})",
    ca.OP_ATAN2: "atan2_({a}, {b})",
    ca.OP_EXP: "exp_({a})",
    ca.OP_EXPM1: "expm1_({a})",
    ca.OP_LOG: "log_({a})",
    ca.OP_TANH: "tanh_({a})",
    ca.OP_SINH: "sinh_({a})",
    ca.OP_COSH: "cosh_({a})",
    ca.OP_ASINH: "asinh_({a})",
    ca.OP_ACOSH: "acosh_({a})",
    ca.OP_ATANH: "atanh_({a})",
    ca.OP_ERF: "erf_({a})",
    ca.OP_LOG1P: "log1p_({a})",
    ca.OP_POW: "pow_({a}, {b})",
    ca.OP_CONSTPOW: "pow_({a}, {b})",
    ca.OP_FMOD: "fmod_({a}, {b})",
    ca.OP_REMAINDER: "remainder_({a}, {b})",
    ca.OP_HYPOT: "hypot_({a}, {b})",
}

# Comparisons: 1 where they hold, else 0. NaN is true, as in C.
_TRUTH = {
    ca.OP_LT: "{a} < {b}",
    ca.OP_LE: "{a} <= {b}",
    ca.OP_EQ: "{a} == {b}",
    ca.OP_NE: "{a} != {b}",
    ca.OP_NOT: "~is_true({a})",
    ca.OP_AND: "is_true({a}) & is_true({b})",
    ca.OP_OR: "is_true({a}) | is_true({b})",
}

_PART_LENGTH = 1000

_LOOP = r"""
#define PADDED(n) (((n) + W - 1) / W * W)

/* Compute rows of outputs from rows of inputs; return 1 if there is no memory. */
__attribute__((visibility("default")))
int kineverse_batch(const double *in, double *const *out, long long rows, int streaming) {
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
    if (row == full || (INPUTS % W && row + W >= rows)) {
      /* The last rows are read from a copy: behind them may be nothing. */
      const int there = row == full ? left : W;
      for (int i = 0; i < W; i++)
        memcpy(padded + i * INPUTS, from + (i < there ? i : there - 1) * INPUTS, INPUTS * sizeof(double));
      from = padded;
    }
    read_rows(from, INPUTS, x);
    compute(x, store, o);
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


_TEXTS = "\n".join([TYPES, ROWS, ARITHMETIC, TRIGONOMETRIC, EXPONENTIAL, by_lane()])

# Raise the number when other source is generated from the same program and texts.
KIND = "batch 2 " + hashlib.sha256((_TEXTS + _LOOP + repr((_PLAIN, _TRUTH))).encode()).hexdigest()


def vectorisable(program: Program) -> bool:
    """Whether every operation of the program can be done on vectors."""
    function = program.function
    known = {
        *_PLAIN,
        *_TRUTH,
        ca.OP_SIN,
        ca.OP_COS,
        ca.OP_IF_ELSE_ZERO,
        ca.OP_INPUT,
        ca.OP_OUTPUT,
        ca.OP_CONST,
    }
    return all(function.instruction_id(k) in known for k in range(function.n_instructions()))


def batch_source(program: Program) -> str:
    """Return the C source of ``kineverse_batch``, which evaluates a program at many points.

    Its arguments are the rows of inputs, a pointer to the rows of each output, the number of rows, and
    whether the outputs are written past the caches.
    """
    plan = schedule(program.function, _PART_LENGTH)
    definitions = {
        "INPUTS": program.size,
        "OUTPUTS": len(program.sizes),
        "RESULTS": sum(program.sizes),
        "STORED": plan.stored,
        "CONSTANTS": len(plan.constants),
        "SIZES": ", ".join(map(str, program.sizes)),
    }
    calls = "\n".join(f"  part{i}(x, store, o);" for i in range(len(plan.parts)))
    numbers = ", ".join(["0", *(literal(c) for _, c in plan.constants)])
    places = ", ".join(["0", *(str(place) for place, _ in plan.constants)])
    return "\n".join(
        [
            _TEXTS,
            *(f"#define {name} {value}" for name, value in definitions.items()),
            *(_part(plan, part, i) for i, part in enumerate(plan.parts)),
            f"static void compute(const V *x, V *store, V *o) {{\n{calls}\n}}",
            f"static const double constant[] = {{{numbers}}};",
            f"static const int constant_place[] = {{{places}}};",
            _LOOP,
        ]
    )


def _part(plan: Schedule, part: Part, number: int) -> str:
    lines = [f"static NOINLINE void part{number}(const V *restrict x, V *restrict store, V *restrict o) {{"]
    lines += [f"  const V v{value} = store[{place}];" for value, place in part.loads.items()]
    angles = {
        op: {plan.steps[v].arguments[0]: v for v in part.values if plan.steps[v].op == op} for op in _CIRCLE
    }
    truths: set[int] = set()
    done: set[int] = set()
    for value in part.values:
        step = plan.steps[value]
        if value in done:
            continue
        names = [_operand(plan.steps, argument) for argument in step.arguments]
        operands = dict(zip("ab", names, strict=False))
        if step.op in _CIRCLE:
            # Sine and cosine of one angle are computed together.
            pair = [angles[op].get(step.arguments[0]) for op in _CIRCLE]
            sine, cosine = (f"v{v}" if v is not None else f"unused{value}" for v in pair)
            lines.append(f"  V {sine}, {cosine}; sincos_({names[0]}, &{sine}, &{cosine});")
            done.update(v for v in pair if v is not None)
        elif step.op in _TRUTH:
            if step.op == ca.OP_NOT and step.arguments[0] in truths:
                condition = f"~m{step.arguments[0]}"
            else:
                condition = _TRUTH[step.op].format(**operands)
            lines.append(f"  const I m{value} = {condition}; const V v{value} = truth(m{value});")
            truths.add(value)
        elif step.op == ca.OP_IF_ELSE_ZERO:
            known = step.arguments[0] in truths
            condition = f"m{step.arguments[0]}" if known else f"is_true({operands['a']})"
            lines.append(f"  const V v{value} = (V)({condition} & (I){operands['b']});")
        else:
            lines.append(f"  const V v{value} = {_PLAIN[step.op].format(**operands)};")
    lines += [f"  store[{place}] = v{value};" for value, place in part.saves.items()]
    lines += [f"  o[{place}] = {_operand(plan.steps, value)};" for place, value in part.outputs]
    return "\n".join([*lines, "}"])


_CIRCLE = (ca.OP_SIN, ca.OP_COS)


def _operand(steps: list[Step], value: int) -> str:
    step = steps[value]
    if step.op == ca.OP_INPUT:
        return f"x[{step.arguments[0]}]"
    if step.op == ca.OP_CONST:
        return f"splat({literal(step.constant)})"
    return f"v{value}"
