"""Python source of a program on arrays, for JAX and PyTorch alike.

Each instruction is an operation on all points at once. Its functions are those of the namespace ``m``, which
is ``jax.numpy`` or ``torch``: they have the same names.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import casadi as ca

from kineverse.compilation import codegen
from kineverse.compilation.program import Program
from kineverse.compilation.schedule import (
    Instruction,
    StraightLine,
    read_instructions,
    relax_residuals,
    schedule,
)
from kineverse.errors import CompileError
from kineverse.expressions.layout import ArrayShape

_VALUES = {
    **codegen.ARITHMETIC,
    **{op: f"m.{name}({{a}})" for op, name in codegen.UNARY_FUNCTIONS.items()},
    **{op: f"m.{name}({{a}}, {{b}})" for op, name in codegen.BINARY_FUNCTIONS.items()},
    ca.OP_TWICE: "{a} + {a}",
    ca.OP_INV: "one / {a}",
    ca.OP_SQRT: "m.sqrt({a})",
    ca.OP_SIN: "m.sin({a})",
    ca.OP_COS: "m.cos({a})",
    ca.OP_ERF: "erf({a})",
    ca.OP_ERFINV: "erfinv({a})",
    ca.OP_FABS: "m.abs({a})",
    ca.OP_SIGN: "m.where({a} < zero, -one, m.where({a} > zero, one, {a}))",
    ca.OP_COPYSIGN: "m.copysign({a}, {b})",
    ca.OP_FLOOR: "m.floor({a})",
    ca.OP_CEIL: "m.ceil({a})",
    # The first of two equal ones, as in C.
    ca.OP_FMIN: "m.where(({a} <= {b}) | ({b} != {b}), {a}, {b})",
    ca.OP_FMAX: "m.where(({a} >= {b}) | ({b} != {b}), {a}, {b})",
    ca.OP_REMAINDER: "remainder({a}, {b})",
    ca.OP_IF_ELSE_ZERO: "m.where({a}, {b}, zero)",
}
_CONDITIONS = {**codegen.COMPARISONS, ca.OP_NOT: "~{a}", ca.OP_AND: "{a} & {b}", ca.OP_OR: "{a} | {b}"}
# Operations, and how many of their arguments are truth values.
_OF_TRUTHS = {ca.OP_NOT: 1, ca.OP_AND: 2, ca.OP_OR: 2, ca.OP_IF_ELSE_ZERO: 1}

_HEAD = """\
def evaluate(x, constant):
    shape = tuple(x.shape[:-1])
    zero, one = constant(0.0), constant(1.0)
"""
# Both libraries have the remainder of division with rounding to floor or zero only. Each step here is exact.
_REMAINDER = """\
    def remainder(a, b):
        b = m.abs(b)
        r = m.abs(m.fmod(a, b + b))
        s = m.where(r + r > b, r - b, r)
        s = m.where((r + r > b) & (s + s >= b), s - b, s)
        return m.where(a < zero, -s, s)
"""


def load_operations(
    program: Program, shapes: Sequence[ArrayShape], **functions: Any
) -> Callable[[bool], Callable[[Any, Callable[[float], Any]], list[Any]]]:
    """Return a function that gives ``evaluate`` of :func:`array_source`, in single precision or not.

    ``functions`` are ``m``, ``erf`` and ``erfinv`` of the source.
    """

    @cache
    def load(single_precision: bool) -> Callable[[Any, Callable[[float], Any]], list[Any]]:
        source = array_source(program, shapes, single_precision=single_precision)
        names = dict(functions)
        exec(compile(source, "<kineverse operations>", "exec"), names)
        evaluate: Callable[[Any, Callable[[float], Any]], list[Any]] = names["evaluate"]
        return evaluate

    return load


def array_source(program: Program, shapes: Sequence[ArrayShape], *, single_precision: bool = False) -> str:
    """Return the source of ``evaluate(x, constant)``.

    ``x`` has the inputs along its last axis. ``constant`` makes a number an array without axes, of the type
    and at the place of ``x``. The result is a list with an array for each output, of its shape, behind the
    other axes of ``x``. In single precision, residuals of implicit functions are not as small as in double.
    """
    whole = read_instructions(program.function)
    if single_precision:
        whole = relax_residuals(whole)
    (part,) = schedule(whole, len(whole.steps) + 1).parts
    missing = sorted({whole.steps[v].op for v in part.values} - {*_VALUES, *_CONDITIONS})
    if missing:
        listed = ", ".join(f"'{codegen.operation_name(op)}'" for op in missing)
        raise CompileError(f"The expression contains {listed}, which is no operation on arrays.")
    names = _name_values(whole)
    body = _define(whole, part.values, names)
    values = dict(whole.outputs)
    results, first = [], 0
    for shape in shapes:
        last = first + math.prod(shape)
        results.append(_stack([names[values[place]] for place in range(first, last)], shape))
        first = last
    leaves = []
    for v, step in enumerate(whole.steps):
        if step.op == ca.OP_CONST:
            leaves.append(f"    {names[v]} = constant({_literal(step.constant)})\n")
        elif step.op == ca.OP_INPUT:
            leaves.append(f"    {names[v]} = x[..., {step.arguments[0]}]\n")
    return "".join([_HEAD, _REMAINDER, *leaves, *body, f"    return [{', '.join(results)}]\n"])


def _name_values(program: StraightLine) -> list[str]:
    letters = {ca.OP_CONST: "c", ca.OP_INPUT: "x"}
    return [f"{letters.get(step.op, 'v')}{value}" for value, step in enumerate(program.steps)]


def _define(program: StraightLine, values: Sequence[int], names: Sequence[str]) -> list[str]:
    """Return the statements of values. Each ends with the names that are not used again, to free memory."""
    steps = program.steps
    last = {argument: value for value in values for argument in steps[value].arguments}
    temporary = set(values).difference(value for _, value in program.outputs)
    lines = []
    for value in values:
        step = steps[value]
        condition = step.op in _CONDITIONS
        template = _CONDITIONS[step.op] if condition else _VALUES[step.op]
        text = template.format(**dict(zip("ab", _operands(step, steps, names), strict=False)))
        lines.append(f"    {'t' if condition else 'v'}{value} = {text}\n")
        if condition:
            lines.append(f"    v{value} = m.where(t{value}, one, zero)\n")
        ended = [a for a in dict.fromkeys(step.arguments) if last[a] == value and a in temporary]
        gone = [name for a in ended for name in _names(a, steps)]
        if gone:
            lines.append(f"    del {', '.join(gone)}\n")
    return lines


def _operands(step: Instruction, steps: Sequence[Instruction], names: Sequence[str]) -> list[str]:
    truths = _OF_TRUTHS.get(step.op, 0)
    result = []
    for place, argument in enumerate(step.arguments):
        if place >= truths:
            result.append(names[argument])
        elif steps[argument].op in _CONDITIONS:
            result.append(f"t{argument}")
        else:
            result.append(f"({names[argument]} != zero)")
    return result


def _names(value: int, steps: Sequence[Instruction]) -> list[str]:
    return [f"v{value}", f"t{value}"] if steps[value].op in _CONDITIONS else [f"v{value}"]


def _stack(names: Sequence[str], shape: ArrayShape) -> str:
    """Return an array of some shape, along the last axes, from its elements in C order."""
    wide = [f"m.broadcast_to({name}, shape)" if name.startswith("c") else name for name in names]
    if not shape:
        return wide[0]
    if not wide:
        return f"m.reshape(x[..., :0], shape + {shape})"
    return f"m.reshape(m.stack([{', '.join(wide)}], -1), shape + {shape})"


def _literal(number: float) -> str:
    return repr(number) if math.isfinite(number) else f"float('{number}')"
