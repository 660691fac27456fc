"""Periodicity in unlimited coordinates, and their replacement by angles within one turn."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import TypeAlias

import casadi as ca

from kineverse.expressions.expression import Expression
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.expressions.substitution import apply_substitution
from kineverse.intervals.graph import Term, TermGraph, reachable_terms
from kineverse.symbols import Symbol, position

from .boxes import Interval, IntervalBox, wrap_to_turn

TURN = Interval(0.0, math.tau, True, False)
TurnCount: TypeAlias = Fraction | None
UNCHANGED = Fraction(0)
_WAVES = (ca.OP_SIN, ca.OP_COS, ca.OP_TAN)
_SAME = 1e-12


class PeriodicCoordinates:
    """Replacement of periodic coordinates by angles within one turn."""

    def __init__(self, coordinates: Iterable[Symbol]) -> None:
        self.wrapped = {s: position(f"{s.path} mod 2π") for s in coordinates}
        self._originals = {inner: s for s, inner in self.wrapped.items()}

    def restore_box(self, box: IntervalBox) -> IntervalBox:
        """Return a box in terms of the original coordinates."""
        return IntervalBox({self._restore_axis(axis): side for axis, side in box.items()})

    def restore_expression(self, expression: Expression) -> Expression:
        """Return an expression in the original coordinates."""
        return apply_substitution(
            expression, {s: e for s, e in self._originals.items() if s in expression.symbols}
        )

    def _restore_axis(self, axis: Expression) -> Expression:
        original = self._originals.get(axis) if isinstance(axis, Symbol) else None
        return axis if original is None else wrap_to_turn(original)


def is_periodic(expressions: Sequence[Expression], symbol: Symbol) -> bool:
    """Return True if the form of expressions proves that they are equal at ``symbol`` + 2π."""
    return all(g == 0 for e in expressions for g in _turn_counts(e, {symbol: Fraction(1)}))


def _turn_counts(expression: Expression, moving: Mapping[Symbol, Fraction]) -> list[TurnCount]:
    """Return the increments of elements, in turns, after given turns of symbols; None if not certain."""
    terms = TermGraph({})
    roots = tuple(terms.elements(expression))
    found: dict[int, TurnCount] = {}
    for term in reachable_terms(roots):
        args = [found[a.index] for a in term.args]
        found[term.index] = (
            moving.get(term.data, UNCHANGED) if term.op == ca.OP_PARAMETER else _turn_count(term, args)
        )
    return [found[term.index] for term in roots]


def _turn_count(term: Term, args: list[TurnCount]) -> TurnCount:
    known = [arg for arg in args if arg is not None]
    if len(known) < len(args):
        return None
    if not any(known):
        return UNCHANGED
    if term.op == ca.OP_NEG:
        return -known[0]
    if term.op in (ca.OP_ADD, ca.OP_SUB):
        return known[0] + known[1] if term.op == ca.OP_ADD else known[0] - known[1]
    if term.op in (ca.OP_MUL, ca.OP_DIV):
        return _scale_count(term, known)
    whole = all(arg.denominator == 1 for arg in known)
    if term.op in _WAVES:
        return UNCHANGED if whole else None
    if term.op == "piecewise":
        periodic, knots, _ = term.data
        periods = float(known[0]) * math.tau / (knots[-1] - knots[0])
        return (
            UNCHANGED
            if periodic and abs(periods - round(periods)) <= _SAME * max(1.0, abs(periods))
            else None
        )
    if term.op == "implicit":
        node, element = term.data
        count: TurnCount = _loop_turn_counts(node.function, tuple(known))[element]
        return count
    return None


def _scale_count(term: Term, known: list[Fraction]) -> TurnCount:
    for moving, factor in ((0, 1), (1, 0)) if term.op == ca.OP_MUL else ((0, 1),):
        number = term.args[factor].data
        if term.args[factor].op == ca.OP_CONST and math.isfinite(number) and number:
            return (
                known[moving] * Fraction(number) if term.op == ca.OP_MUL else known[moving] / Fraction(number)
            )
    return None


@lru_cache(256)
def _loop_turn_counts(function: ImplicitFunction, inputs: tuple[Fraction, ...]) -> tuple[TurnCount, ...]:
    """Return the increments of unknowns after turns of inputs: those of the seed, for periodic equations."""
    moving = {s: g for s, g in zip(function.inputs, inputs, strict=True) if g}
    ends = dict(zip(function.inputs, function.domain, strict=False))
    if any(math.isfinite(end) for s in moving for end in ends.get(s, ())):
        return (None,) * len(function.unknowns)  # after a turn, outside of the function's domain
    by = _turn_counts(function.seed, moving)
    moving |= {s: g for s, g in zip(function.unknowns, by, strict=True) if g}
    same = None not in by and all(g == 0 for g in _turn_counts(function.equations, moving))
    return tuple(by) if same else (None,) * len(by)
