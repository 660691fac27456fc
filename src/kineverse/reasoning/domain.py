"""Domain of configurations: constant limits, unit quaternions, and periodic coordinates within one turn."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.expressions.substitution import apply_substitution
from kineverse.intervals.arithmetic import RealInterval
from kineverse.intervals.graph import Term, TermGraph, reachable_terms
from kineverse.symbols import Symbol, position

from .boxes import EVERYTHING, Interval, IntervalBox, wrap_to_turn
from .polynomial import Monomial, Polynomial

UnitSphere = tuple[Symbol, ...]  # coordinates whose squares have the sum 1, such as a unit quaternion

_WHOLE = Interval(-1.0, 1.0, True, True)
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Domain:
    """Limits of coordinates, and the coordinates that form unit quaternions."""

    limits: Mapping[Symbol, Interval]  # constant limits of symbols
    spheres: tuple[UnitSphere, ...] = ()  # unit quaternions

    def limits_of(self, symbol: Symbol) -> Interval:
        """Return the interval in which a symbol lies."""
        limit = self.limits.get(symbol, EVERYTHING)
        return limit.intersection(_WHOLE) if symbol in self._on_sphere else limit

    def sphere(self, symbols: Iterable[Symbol]) -> UnitSphere | None:
        """Return the unit quaternion to which all symbols belong, or None."""
        spheres = {self._on_sphere.get(s) for s in symbols}
        return spheres.pop() if len(spheres) == 1 else None

    def reduce(self, p: Polynomial) -> Polynomial:
        """Return the polynomial with squares of the last element of each quaternion eliminated."""
        for sphere in self.spheres:
            last = sphere[-1]
            while any(dict(m).get(last, 0) > 1 for m in p.terms):
                p = _without_square(p, sphere)
        return p

    def form_range(self, p: Polynomial) -> RealInterval | None:
        """Return the range of a quadratic form of a unit quaternion, None for other polynomials.

        Its ends are the smallest and the largest eigenvalue of the matrix of the form, in which a constant is
        a multiple of the identity.
        """
        sphere = self.sphere(p.symbols) if p.symbols else None
        if sphere is None or any(sum(power for _, power in m) not in (0, 2) for m in p.terms):
            return None
        matrix = float(p.offset) * np.eye(len(sphere))
        for monomial, factor in p.terms.items():
            if monomial:
                i, j = sphere.index(monomial[0][0]), sphere.index(monomial[-1][0])
                matrix[i, j] += float(factor) / 2
                matrix[j, i] += float(factor) / 2
        values = np.linalg.eigvalsh(matrix)
        slack = _ROUNDING * max(1.0, *map(abs, values.tolist()))
        return float(values[0]) - slack, float(values[-1]) + slack

    @cached_property
    def _on_sphere(self) -> dict[Symbol, UnitSphere]:
        return {s: sphere for sphere in self.spheres for s in sphere}


def _without_square(p: Polynomial, sphere: UnitSphere) -> Polynomial:
    last = sphere[-1]
    total: dict[Monomial, Fraction] = {}
    for monomial, factor in p.terms.items():
        powers = dict(monomial)
        parts: list[tuple[dict[Symbol, int], Fraction]] = [(powers, factor)]
        if powers.get(last, 0) > 1:
            powers[last] -= 2
            more = ({**powers, s: powers.get(s, 0) + 2} for s in sphere[:-1])
            parts += [(part, -factor) for part in more]
        for part, weight in parts:
            key = tuple(sorted(((s, n) for s, n in part.items() if n), key=lambda item: item[0].sort_key))
            total[key] = total.get(key, Fraction(0)) + weight
    return Polynomial({m: f for m, f in total.items() if f})


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
        wraps = {inner: wrap_to_turn(s) for inner, s in self._originals.items()}
        return IntervalBox(
            {wraps.get(axis, axis) if isinstance(axis, Symbol) else axis: side for axis, side in box.items()}
        )

    def restore_expression(self, expression: Expression) -> Expression:
        """Return an expression in the original coordinates."""
        inside = {s: e for s, e in self._originals.items() if s in expression.symbols}
        return apply_substitution(expression, inside)


def is_periodic(expressions: Sequence[Expression], symbol: Symbol) -> bool:
    """Return True if the form of expressions proves that they are equal at ``symbol`` + 2π."""
    return all(g == 0 for e in expressions for g in _turn_counts(e, {symbol: Fraction(1)}))


def _turn_counts(expression: Expression, moving: Mapping[Symbol, Fraction]) -> list[TurnCount]:
    """Return the increments of elements, in turns, after given turns of symbols; None if not certain."""
    terms = TermGraph({})
    roots = tuple(terms.elements(expression))
    result: dict[int, TurnCount] = {}
    for term in reachable_terms(roots):
        args = [result[a.index] for a in term.args]
        free = term.op == ca.OP_PARAMETER
        result[term.index] = moving.get(term.data, UNCHANGED) if free else _turn_count(term, args)
    return [result[term.index] for term in roots]


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
        whole = abs(periods - round(periods)) <= _SAME * max(1.0, abs(periods))
        return UNCHANGED if periodic and whole else None
    if term.op == "implicit":
        node, element = term.data
        count: TurnCount = _loop_turn_counts(node.function, tuple(known))[element]
        return count
    return None


def _scale_count(term: Term, known: list[Fraction]) -> TurnCount:
    product = term.op == ca.OP_MUL
    for moving, factor in ((0, 1), (1, 0)) if product else ((0, 1),):
        number = term.args[factor].data
        if term.args[factor].op == ca.OP_CONST and math.isfinite(number) and number:
            return known[moving] * (Fraction(number) if product else 1 / Fraction(number))
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
