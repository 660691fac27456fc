"""The instructions of a CasADi function as values that are each computed once, cut into parts.

CasADi's instructions write to places of a work vector again and again. Here every result is a value with a
number of its own. Long programs are cut into parts, each of which becomes a C function, because the time of a
compiler grows faster than the length of a function. Values that a later part needs wait in places of a store.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import casadi as ca

from .program import CasadiFunction


@dataclass(frozen=True, slots=True)
class Step:
    """One value: an operation and the numbers of the values it is applied to.

    For inputs (``OP_INPUT``) the one argument is the place in the input vector, and ``constant`` is the
    number of a constant (``OP_CONST``).
    """

    op: int
    arguments: tuple[int, ...]
    constant: float = 0.0


@dataclass(slots=True)
class Part:
    """What one C function does.

    Attributes
    ----------
    values
        The values it computes, in order.
    loads
        From values of earlier parts to their places in the store.
    saves
        From values of its own that later parts need to their places in the store.
    outputs
        From places in the outputs to the values that belong there.
    """

    values: list[int] = field(default_factory=list)
    loads: dict[int, int] = field(default_factory=dict)
    saves: dict[int, int] = field(default_factory=dict)
    outputs: list[tuple[int, int]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Schedule:
    """A whole program.

    Attributes
    ----------
    steps
        All values, by their numbers.
    constants
        From places in the outputs to numbers that never change.
    parts
        What is computed, in order.
    stored
        The size of the store.
    """

    steps: list[Step]
    constants: list[tuple[int, float]]
    parts: list[Part]
    stored: int


def schedule(function: CasadiFunction, length: int) -> Schedule:
    """Return the schedule of a function of one vector whose outputs are columns.

    Parameters
    ----------
    function
        CasADi's function; its outputs are laid one behind the other.
    length
        So many operations go into one part.
    """
    steps, outputs = _values(function)
    constants = [(place, steps[v].constant) for place, v in outputs if steps[v].op == ca.OP_CONST]
    parts, home = _cut(steps, length)
    for place, value in outputs:
        if steps[value].op != ca.OP_CONST:
            parts[max(home.get(value, 0), 0)].outputs.append((place, value))
    return Schedule(steps, constants, parts, _place(steps, parts, home))


def _values(function: CasadiFunction) -> tuple[list[Step], list[tuple[int, int]]]:
    """Return all values, and pairs of a place in the outputs and a value."""
    offsets = [0]
    for i in range(function.n_out()):
        offsets.append(offsets[-1] + function.numel_out(i))
    steps: list[Step] = []
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
            step = Step(op, (reads[1],))
        elif op == ca.OP_CONST:
            step = Step(op, (), function.instruction_constant(k))
        else:
            step = Step(op, tuple(holds[place] for place in reads))
        holds[writes[0]] = len(steps)
        steps.append(step)
    return steps, outputs


def _cut(steps: list[Step], length: int) -> tuple[list[Part], dict[int, int]]:
    """Return the parts with what they compute, and the part each value is computed in."""
    parts = [Part()]
    home: dict[int, int] = {}
    for value, step in enumerate(steps):
        if step.op in (ca.OP_INPUT, ca.OP_CONST):
            continue
        if len(parts[-1].values) >= length:
            parts.append(Part())
        parts[-1].values.append(value)
        home[value] = len(parts) - 1
    return parts, home


def _place(steps: list[Step], parts: list[Part], home: dict[int, int]) -> int:
    """Give values that are needed in later parts places in the store; return its size."""
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


def _arguments(steps: list[Step], values: Iterable[int]) -> Iterable[int]:
    return (argument for value in values for argument in steps[value].arguments)
