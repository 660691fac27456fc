"""C functions of straight-line programs and of batches: of SIMD vectors, or of doubles.

The statements of both are the same but for the notation of operations, a :class:`Dialect`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import casadi as ca
from msgspec import Struct

from .c_source import Scalar, read_source
from .program import Program, c_literal
from .schedule import CFunction, Instruction, Schedule, StraightLine, read_instructions, schedule

# From so many operations on, a program is split: compile time grows faster than the length of a function.
# From 250 to 4000, the time to run changes by 6 % and that to compile by 30 %, with no clear best.
PART_LENGTH = 1000


class Dialect(Struct, frozen=True):
    """C notation of a program's operations."""

    type: str  # type of values
    mask: str  # type of truth values
    literal: str  # value, from a literal {}
    truth: str  # value, from a truth value {}: 1 or 0
    plain: Mapping[int, str]  # operations with the operands {a} and {b}
    conditions: Mapping[int, str]  # truth values with the operands {a} and {b}. NaN is true, as in C
    negation: str  # opposite of a truth value {}
    guarded: str  # value {b}, or 0 where the truth value {a} is false
    is_true: str  # truth value of a value {}
    circle: str  # statement for sine {s} and cosine {c} of an angle {a}
    written: str  # vector of a value {}


ARITHMETIC = {
    ca.OP_ASSIGN: "{a}",
    ca.OP_LIFT: "{a}",
    ca.OP_ADD: "{a} + {b}",
    ca.OP_SUB: "{a} - {b}",
    ca.OP_MUL: "{a} * {b}",
    ca.OP_DIV: "{a} / {b}",
    ca.OP_NEG: "-{a}",
    ca.OP_SQ: "{a} * {a}",
}
# Functions of the C library and of arrays, and with an underline behind the name, of vectors.
UNARY_FUNCTIONS = {
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_EXP: "exp",
    ca.OP_EXPM1: "expm1",
    ca.OP_LOG: "log",
    ca.OP_TANH: "tanh",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_ERF: "erf",
    ca.OP_LOG1P: "log1p",
}
BINARY_FUNCTIONS = {
    ca.OP_ATAN2: "atan2",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_HYPOT: "hypot",
}
COMPARISONS = {ca.OP_LT: "{a} < {b}", ca.OP_LE: "{a} <= {b}", ca.OP_EQ: "{a} == {b}", ca.OP_NE: "{a} != {b}"}
_CIRCLE = (ca.OP_SIN, ca.OP_COS)

VECTOR = Dialect(
    type="V",
    mask="I",
    literal="splat({})",
    truth="truth({})",
    plain={
        **ARITHMETIC,
        **{op: f"{name}_({{a}})" for op, name in UNARY_FUNCTIONS.items()},
        **{op: f"{name}_({{a}}, {{b}})" for op, name in BINARY_FUNCTIONS.items()},
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
    },
    conditions={
        **COMPARISONS,
        ca.OP_NOT: "~is_true({a})",
        ca.OP_AND: "is_true({a}) & is_true({b})",
        ca.OP_OR: "is_true({a}) | is_true({b})",
    },
    negation="~{}",
    guarded="(V)({a} & (I){b})",
    is_true="is_true({})",
    circle="V {s}, {c}; sincos_({a}, &{s}, &{c});",
    written="{}",
)

SCALAR = Dialect(
    type="double",
    mask="int",
    literal="({})",
    truth="{}",
    plain={
        **ARITHMETIC,
        **{op: f"{name}({{a}})" for op, name in UNARY_FUNCTIONS.items()},
        **{op: f"{name}({{a}}, {{b}})" for op, name in BINARY_FUNCTIONS.items()},
        ca.OP_TWICE: "2.0 * {a}",
        ca.OP_INV: "1.0 / {a}",
        ca.OP_SQRT: "sqrt({a})",
        ca.OP_FABS: "fabs({a})",
        ca.OP_SIGN: "{a} < 0.0 ? -1.0 : {a} > 0.0 ? 1.0 : {a}",
        ca.OP_COPYSIGN: "copysign({a}, {b})",
        ca.OP_FLOOR: "floor({a})",
        ca.OP_CEIL: "ceil({a})",
        # The first of two equal ones, as CasADi's interpreter.
        ca.OP_FMIN: "{a} <= {b} || {b} != {b} ? {a} : {b}",
        ca.OP_FMAX: "{a} >= {b} || {b} != {b} ? {a} : {b}",
    },
    conditions={
        **COMPARISONS,
        ca.OP_NOT: "{a} == 0.0",
        ca.OP_AND: "({a} != 0.0) & ({b} != 0.0)",
        ca.OP_OR: "({a} != 0.0) | ({b} != 0.0)",
    },
    negation="!{}",
    guarded="{a} ? {b} : 0.0",
    is_true="({} != 0.0)",
    circle="const double {s} UNUSED = sin({a}), {c} UNUSED = cos({a});",
    written="splat({})",
)

_KNOWN = {
    *VECTOR.plain,
    *VECTOR.conditions,
    *_CIRCLE,
    ca.OP_IF_ELSE_ZERO,
    ca.OP_INPUT,
    ca.OP_OUTPUT,
    ca.OP_CONST,
}


def missing_operations(program: Program) -> list[str]:
    """Return the names, as CasADi writes them, of a program's operations without a version for vectors."""
    unknown = program.operations - _KNOWN
    return sorted(map(operation_name, unknown))


def operation_name(op: int) -> str:
    """Return the name of an operation, as CasADi writes it."""
    return _OPERATION_NAMES.get(op, f"operation {op}")


_OPERATION_NAMES = {
    getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")
}


def generate_parts(plan: Schedule, name: str, dialect: Dialect, scalar: Scalar = "double") -> str:
    """Return the C functions ``name0``, ``name1``, ... of a schedule, and ``name``, which calls them.

    Their arguments are the inputs ``x``, the kept numbers ``kept`` (both of the dialect's type, null if the
    program has none), the store ``store``, and the outputs ``o``, which are vectors.
    """
    type_ = dialect.type
    arguments = (
        f"const {type_} *restrict x UNUSED, const {type_} *restrict kept UNUSED, "
        f"{type_} *restrict store UNUSED, V *restrict o UNUSED"
    )
    texts = []
    for number, part in enumerate(plan.parts):
        statements = _Statements(plan.steps, part, dialect, scalar).text()
        texts.append(f"static NOINLINE void {name}{number}({arguments}) {{\n{statements}}}\n")
    calls = "".join(f"  {name}{number}(x, kept, store, o);\n" for number in range(len(plan.parts)))
    return "".join([*texts, f"static void {name}({arguments}) {{\n{calls}}}\n"])


class _Statements:
    """Statements of one C function."""

    def __init__(
        self, steps: Sequence[Instruction], part: CFunction, dialect: Dialect, scalar: Scalar
    ) -> None:
        self._steps, self._part, self._dialect, self._scalar = steps, part, dialect, scalar
        # Values that are known as truth values too, and values that are defined before their turn.
        self._truths: set[int] = set()
        self._defined: set[int] = set()
        # Sines and cosines by their angles.
        self._circle: dict[int, dict[int, int]] = {op: {} for op in _CIRCLE}
        for value in part.values:
            step = steps[value]
            if step.op in _CIRCLE:
                self._circle[step.op][step.arguments[0]] = value

    def text(self) -> str:
        part, type_ = self._part, self._dialect.type
        lines = [f"const {type_} v{value} = store[{slot}];" for value, slot in part.loads.items()]
        lines += [self._define(value) for value in part.values if value not in self._defined]
        lines += [f"store[{slot}] = v{value};" for value, slot in part.saves.items()]
        for place, value in part.outputs:
            lines.append(f"o[{place}] = {self._dialect.written.format(self._operand(value))};")
        return "".join(f"  {line}\n" for line in lines)

    def _define(self, value: int) -> str:
        step, dialect = self._steps[value], self._dialect
        operands = dict(zip("ab", map(self._operand, step.arguments), strict=False))
        if step.op in _CIRCLE:
            return self._define_circle(value, operands["a"])
        if step.op in dialect.conditions:
            condition = self._condition(step, operands)
            self._truths.add(value)
            return (
                f"const {dialect.mask} m{value} = {condition}; "
                f"const {dialect.type} v{value} UNUSED = {dialect.truth.format(f'm{value}')};"
            )
        if step.op == ca.OP_IF_ELSE_ZERO:
            known = step.arguments[0] in self._truths
            operands["a"] = f"m{step.arguments[0]}" if known else dialect.is_true.format(operands["a"])
            template = dialect.guarded
        else:
            template = dialect.plain[step.op]
        return f"const {dialect.type} v{value} = {template.format(**operands)};"

    def _condition(self, step: Instruction, operands: dict[str, str]) -> str:
        if step.op == ca.OP_NOT and step.arguments[0] in self._truths:
            return self._dialect.negation.format(f"m{step.arguments[0]}")
        return self._dialect.conditions[step.op].format(**operands)

    def _define_circle(self, value: int, angle: str) -> str:
        pair = [self._circle[op].get(self._steps[value].arguments[0]) for op in _CIRCLE]
        self._defined.update(v for v in pair if v is not None)
        sine, cosine = (f"v{v}" if v is not None else f"unused{value}" for v in pair)
        return self._dialect.circle.format(s=sine, c=cosine, a=angle)

    def _operand(self, value: int) -> str:
        step = self._steps[value]
        if step.op == ca.OP_INPUT:
            return f"x[{step.arguments[0]}]"
        if step.op == ca.OP_PARAMETER:
            return f"kept[{step.arguments[0]}]"
        if step.op == ca.OP_CONST:
            return self._dialect.literal.format(c_literal(step.constant, self._scalar))
        return f"v{value}"


# Raise the number when other source is generated from the same program and texts.
BATCH_KIND = "batch 5 " + hashlib.sha256(
    (read_source("batch.c", {"program.h": ""}) + repr(VECTOR)).encode()
).hexdigest()  # fmt: skip


def generate_batch_source(program: Program, file: str = "batch.c") -> str:
    """Return the C source of ``kineverse_batch``, which evaluates a program at many points.

    Its arguments are the rows of inputs, a pointer to the rows of each output, the number of rows, and a flag
    to write the outputs past the caches. ``file`` is the hand-written file, or one that includes it.
    """
    whole = read_instructions(program.function)
    # Constants are written once, and not for each vector.
    is_constant = [step.op == ca.OP_CONST for step in whole.steps]
    constants = [(place, whole.steps[v].constant) for place, v in whole.outputs if is_constant[v]]
    computed = StraightLine(whole.steps, [(place, v) for place, v in whole.outputs if not is_constant[v]])
    plan = schedule(computed, PART_LENGTH)
    definitions = {
        "INPUTS": program.size,
        "OUTPUTS": len(program.sizes),
        "RESULTS": sum(program.sizes),
        "STORED": plan.stored,
        "CONSTANTS": len(constants),
        "OPERATIONS": program.instructions,
        "SIZES": ", ".join(map(str, program.sizes)),
    }
    numbers = ", ".join(["0", *(c_literal(c) for _, c in constants)])
    places = ", ".join(["0", *(str(place) for place, _ in constants)])
    lines = [
        *(f"#define {name} {value}" for name, value in definitions.items()),
        generate_parts(plan, "compute", VECTOR),
        f"static const double constant[] = {{{numbers}}};",
        f"static const int constant_place[] = {{{places}}};",
    ]
    return read_source(file, {"program.h": "\n".join(lines)})
