"""SIMD C code for batches: instruction schedule and source generation.

CasADi's instructions overwrite places of a work vector. In a :class:`Schedule` every result is a value with a
number of its own (static single assignment). Long programs are split into several C functions, because
compile time grows faster than the length of a function. Values for later functions are saved to slots of a
store.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field

import casadi as ca

from .program import CasadiFunction, Program, c_literal
from .simd import ARITHMETIC, EXPONENTIAL, ROWS, TRIGONOMETRIC, TYPES, scalar_fallbacks


@dataclass(frozen=True, slots=True)
class Instruction:
    """An operation and the numbers of its arguments, which defines one value.

    The argument of an input (``OP_INPUT``) is its place in the input vector; ``constant`` is the number of a
    constant (``OP_CONST``).
    """

    op: int
    arguments: tuple[int, ...]
    constant: float = 0.0


@dataclass(slots=True)
class CFunction:
    """The values, loads and saves of one C function.

    Attributes
    ----------
    values
        The computed values, in order.
    loads
        From values of earlier functions to their slots in the store.
    saves
        From own values for later functions to their slots in the store.
    outputs
        Pairs of a place in the outputs and its value.
    """

    values: list[int] = field(default_factory=list)
    loads: dict[int, int] = field(default_factory=dict)
    saves: dict[int, int] = field(default_factory=dict)
    outputs: list[tuple[int, int]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Schedule:
    """The C functions of a program.

    Attributes
    ----------
    steps
        The instructions of all values, by their numbers.
    constants
        Pairs of a place in the outputs and its constant number.
    parts
        The functions, in order.
    stored
        The size of the store.
    """

    steps: list[Instruction]
    constants: list[tuple[int, float]]
    parts: list[CFunction]
    stored: int


def schedule(function: CasadiFunction, length: int) -> Schedule:
    """Return the schedule of a function of one vector whose outputs are columns.

    Parameters
    ----------
    function
        CasADi's function; its outputs are concatenated.
    length
        The number of operations of one C function.
    """
    steps, outputs = _values(function)
    constants = [(place, steps[v].constant) for place, v in outputs if steps[v].op == ca.OP_CONST]
    parts, home = _split_functions(steps, length)
    for place, value in outputs:
        if steps[value].op != ca.OP_CONST:
            parts[max(home.get(value, 0), 0)].outputs.append((place, value))
    return Schedule(steps, constants, parts, _allocate_slots(steps, parts, home))


def _values(function: CasadiFunction) -> tuple[list[Instruction], list[tuple[int, int]]]:
    """Return the instructions of all values, and pairs of a place in the outputs and a value."""
    offsets = [0]
    for i in range(function.n_out()):
        offsets.append(offsets[-1] + function.numel_out(i))
    steps: list[Instruction] = []
    outputs: list[tuple[int, int]] = []
    holds: dict[int, int] = {}
    for k in range(function.n_instructions()):
        op, reads, writes = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if op == ca.OP_OUTPUT:
            outputs.append((offsets[writes[0]] + writes[1], holds[reads[0]]))
            continue
        if op == ca.OP_INPUT:
            step = Instruction(op, (reads[1],))
        elif op == ca.OP_CONST:
            step = Instruction(op, (), function.instruction_constant(k))
        else:
            step = Instruction(op, tuple(holds[place] for place in reads))
        holds[writes[0]] = len(steps)
        steps.append(step)
    return steps, outputs


def _split_functions(steps: list[Instruction], length: int) -> tuple[list[CFunction], dict[int, int]]:
    """Return the functions with their values, and the number of the function of each value."""
    parts = [CFunction()]
    home: dict[int, int] = {}
    for value, step in enumerate(steps):
        if step.op in (ca.OP_INPUT, ca.OP_CONST):
            continue
        if len(parts[-1].values) >= length:
            parts.append(CFunction())
        parts[-1].values.append(value)
        home[value] = len(parts) - 1
    return parts, home


def _allocate_slots(steps: list[Instruction], parts: list[CFunction], home: dict[int, int]) -> int:
    """Assign slots of the store to values for later functions, and return the size of the store."""
    last: dict[int, int] = {}
    for number, part in enumerate(parts):
        for argument in _arguments(steps, part.values):
            if home.get(argument, number) < number:
                last[argument] = number
    free: list[int] = []
    size = 0
    places: dict[int, int] = {}
    ends: dict[int, list[int]] = {}
    for number, part in enumerate(parts):
        for argument in _arguments(steps, part.values):
            if home.get(argument, number) < number:
                part.loads[argument] = places[argument]
        free += ends.pop(number, [])
        for value in part.values:
            if value in last:
                if free:
                    places[value] = free.pop()
                else:
                    places[value] = size
                    size += 1
                part.saves[value] = places[value]
                ends.setdefault(last[value], []).append(places[value])
    return size


def _arguments(steps: list[Instruction], values: Iterable[int]) -> Iterable[int]:
    return (argument for value in values for argument in steps[value].arguments)


# C of operations with the operands a and b.
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


_TEXTS = "\n".join([TYPES, ROWS, ARITHMETIC, TRIGONOMETRIC, EXPONENTIAL, scalar_fallbacks()])

# Raise the number when other source is generated from the same program and texts.
BATCH_KIND = "batch 2 " + hashlib.sha256((_TEXTS + _LOOP + repr((_PLAIN, _TRUTH))).encode()).hexdigest()


def is_vectorizable(program: Program) -> bool:
    """Return True if every operation of the program has a version for vectors."""
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


def generate_batch_source(program: Program) -> str:
    """Return the C source of ``kineverse_batch``, which evaluates a program at many points.

    Its arguments are the rows of inputs, a pointer to the rows of each output, the number of rows, and a flag
    to write the outputs past the caches.
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
    numbers = ", ".join(["0", *(c_literal(c) for _, c in plan.constants)])
    places = ", ".join(["0", *(str(place) for place, _ in plan.constants)])
    return "\n".join(
        [
            _TEXTS,
            *(f"#define {name} {value}" for name, value in definitions.items()),
            *(_generate_function(plan, part, i) for i, part in enumerate(plan.parts)),
            f"static void compute(const V *x, V *store, V *o) {{\n{calls}\n}}",
            f"static const double constant[] = {{{numbers}}};",
            f"static const int constant_place[] = {{{places}}};",
            _LOOP,
        ]
    )


def _generate_function(plan: Schedule, part: CFunction, number: int) -> str:
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
            # The sine and cosine of an angle are computed together.
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


def _operand(steps: list[Instruction], value: int) -> str:
    step = steps[value]
    if step.op == ca.OP_INPUT:
        return f"x[{step.arguments[0]}]"
    if step.op == ca.OP_CONST:
        return f"splat({c_literal(step.constant)})"
    return f"v{value}"
