"""Straight-line programs, and their division into C functions.

CasADi's instructions overwrite places of a work vector. In a :class:`StraightLine` every result is a value
with a number of its own (static single assignment). Long programs are split into several C functions, because
compile time grows faster than the length of a function. Values for later functions are saved to slots of a
store.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import casadi as ca
from msgspec import Struct, field

from kineverse.expressions.implicit import FLOAT_RESIDUAL_TOLERANCE, RESIDUAL_TOLERANCE

from .program import CasadiFunction

# Known before the program runs: inputs, numbers that :func:`separate_parameters` keeps, and constants.
_LEAVES = (ca.OP_INPUT, ca.OP_PARAMETER, ca.OP_CONST)


class Instruction(Struct, frozen=True):
    """An operation and the numbers of its arguments, which defines one value.

    The argument of an input (``OP_INPUT``) is its place in the input vector, that of a kept number
    (``OP_PARAMETER``) its place among those; ``constant`` is the number of a constant (``OP_CONST``).
    """

    op: int
    arguments: tuple[int, ...]
    constant: float = 0.0


class StraightLine(Struct, frozen=True):
    """A program without branches and loops."""

    steps: list[Instruction]  # instructions of all values, by their numbers. Some may be for no output
    outputs: list[tuple[int, int]]  # pairs of a place in the outputs and its value


class CFunction(Struct):
    """The values, loads and saves of one C function."""

    values: list[int] = field(default_factory=list)  # computed values, in order
    loads: dict[int, int] = field(default_factory=dict)
    saves: dict[int, int] = field(default_factory=dict)
    outputs: list[tuple[int, int]] = field(default_factory=list)


class Schedule(Struct, frozen=True):
    """The C functions of a program."""

    steps: list[Instruction]  # instructions of all values, by their numbers
    parts: list[CFunction]  # functions, in order
    stored: int  # size of the store


def read_instructions(function: CasadiFunction) -> StraightLine:
    """Return the program of a function of one vector, its outputs concatenated."""
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
    return StraightLine(steps, outputs)


def separate_parameters(program: StraightLine, inputs: int) -> tuple[StraightLine, StraightLine]:
    """Return a program of the parameters, and one of the inputs and the results of the first."""
    varying: list[bool] = []
    for step in program.steps:
        if step.op == ca.OP_INPUT:
            varying.append(step.arguments[0] < inputs)
        else:
            varying.append(any(varying[argument] for argument in step.arguments))
    used = [a for v, step in enumerate(program.steps) if varying[v] for a in _operands(step)]
    used += [value for _, value in program.outputs]
    kept = [v for v in dict.fromkeys(used) if not varying[v] and program.steps[v].op != ca.OP_CONST]
    preparing = [
        Instruction(ca.OP_INPUT, (step.arguments[0] - inputs,)) if step.op == ca.OP_INPUT else step
        for step in program.steps
    ]
    computing = list(program.steps)
    for place, value in enumerate(kept):
        computing[value] = Instruction(ca.OP_PARAMETER, (place,))
    return StraightLine(preparing, list(enumerate(kept))), StraightLine(computing, program.outputs)


def relax_residuals(program: StraightLine) -> StraightLine:
    """Return a program for float, in which residuals of implicit functions are not as small as in double.

    The only comparison with the square of the tolerance is that of :class:`.Implicit`.
    """
    exact, relaxed = RESIDUAL_TOLERANCE**2, FLOAT_RESIDUAL_TOLERANCE**2
    compared = {step.arguments[1] for step in program.steps if step.op == ca.OP_LE}
    steps = [
        Instruction(step.op, (), relaxed) if v in compared and step.constant == exact else step
        for v, step in enumerate(program.steps)
    ]
    return StraightLine(steps, program.outputs)


def schedule(program: StraightLine, length: int) -> Schedule:
    """Return the schedule of a program."""
    steps = program.steps
    parts = [CFunction()]
    home: dict[int, int] = {}
    for value in _computed(program):
        if len(parts[-1].values) >= length:
            parts.append(CFunction())
        parts[-1].values.append(value)
        home[value] = len(parts) - 1
    for place, value in program.outputs:
        parts[home.get(value, 0)].outputs.append((place, value))
    return Schedule(steps, parts, _allocate_slots(steps, parts, home))


def _computed(program: StraightLine) -> list[int]:
    """Return the values that outputs depend on, without leaves, in order."""
    needed = [False] * len(program.steps)
    for _, value in program.outputs:
        needed[value] = True
    for value in range(len(needed) - 1, -1, -1):
        if needed[value]:
            for argument in _operands(program.steps[value]):
                needed[argument] = True
    return [v for v, step in enumerate(program.steps) if needed[v] and step.op not in _LEAVES]


def _allocate_slots(steps: Sequence[Instruction], parts: list[CFunction], home: dict[int, int]) -> int:
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


def _arguments(steps: Sequence[Instruction], values: Iterable[int]) -> Iterable[int]:
    return (argument for value in values for argument in steps[value].arguments)


def _operands(step: Instruction) -> tuple[int, ...]:
    return () if step.op in _LEAVES else step.arguments
