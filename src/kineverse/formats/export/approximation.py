"""Polynomial approximation of curved motions, with bounds on the pose error of every frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import expand_nodes
from kineverse.intervals.arithmetic import REALS, RealInterval, interval_multiply
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import Term, TermGraph, reachable_terms
from kineverse.intervals.taylor import TaylorSeries, taylor_polynomial, taylor_variable
from kineverse.model.frame import WORLD
from kineverse.model.registry import FrameDeviation
from kineverse.symbols import Symbol

from .joint_axes import JointMotion, MotionChain, QuaternionMotion
from .minimax_fit import MinimaxFit, chebyshev_points, enclose_curve, fit_polynomial

_ROUNDING = 1e-12
_UP = 1 + 1e-12
"""What sums of a few errors are rounded up by."""


class CurveApproximation:
    """Replaces curves over one coordinate by polynomials.

    Parameters
    ----------
    terms
        Where the terms of motions are from.
    limits
        Of coordinates; those that are missing have none.
    degree
        Of the polynomials.
    tolerance
        What is to be reached [m], [rad].
    """

    def __init__(
        self, terms: TermGraph, limits: Mapping[Symbol, RealInterval], degree: int, tolerance: float
    ) -> None:
        self._terms, self._limits, self._degree, self._tolerance = terms, limits, degree, tolerance
        self._enclosures = Enclosures(terms)
        self._fits: dict[tuple[int, tuple[float, ...]], MinimaxFit] = {}
        self._errors: dict[str, dict[int, float]] = {}

    def placing(self, frame: str, found: MotionChain) -> MotionChain | str:
        """Return the same with polynomials, or why there are none."""
        moving = []
        for k, motion in enumerate(found.moving):
            if isinstance(motion, JointMotion) and (motion.curved or len(motion.amount) > self._degree + 1):
                replaced = self._replaced(motion)
                if isinstance(replaced, str):
                    return replaced
                motion, error = replaced
                self._errors.setdefault(frame, {})[k] = error
            moving.append(motion)
        return replace(found, moving=tuple(moving))

    def _replaced(self, motion: JointMotion) -> tuple[JointMotion, float] | str:
        symbols = find_term_symbols(motion.variable)
        if len(symbols) != 1:
            names = ", ".join(map(str, symbols))
            return f"moves by a curve over several coordinates, {names}, and one of them is approximated"
        (symbol,) = symbols
        lower, upper = self._limits.get(symbol, REALS)
        if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
            return f"moves by a curve over '{symbol}', which has no limits between which it is approximated"
        key = motion.variable.index, motion.amount
        if key not in self._fits:
            values = self._values(motion, symbol, lower, upper)
            if not np.isfinite(values).all():
                return f"moves by a curve over '{symbol}' that is no number everywhere within its limits"
            enough = self._tolerance if motion.turns else self._tolerance + _ROUNDING
            self._fits[key] = fit_polynomial(
                lambda where: self._series(motion, symbol, where), values, lower, upper, self._degree, enough
            )
        found = self._fits[key]
        if found.error > self._tolerance:
            unit = "rad" if motion.turns else "m"
            least = found.error if math.isfinite(found.error) else found.sampled
            return (
                f"moves by a curve over '{symbol}', and the best polynomial of degree {self._degree} is "
                f"off by {least:.3g} {unit}"
            )
        variable = self._terms.term(symbol)
        return replace(motion, variable=variable, amount=found.polynomial, curve=None), found.error

    def _series(self, motion: JointMotion, symbol: Symbol, where: RealInterval) -> TaylorSeries:
        (inner,) = self._enclosures.enclose([motion.variable], {symbol: taylor_variable(where)})
        return taylor_polynomial(motion.amount, inner)

    def _values(self, motion: JointMotion, symbol: Symbol, lower: float, upper: float) -> np.ndarray:
        x = chebyshev_points(lower, upper)
        if motion.curve is not None:
            function = ca.Function("curve", [symbol._sx], [expand_nodes(motion.curve)])
            inner = np.array([float(function(v)) for v in x])
            return np.asarray(np.polynomial.polynomial.polyval(inner, motion.amount))
        return np.array([sum(self._series(motion, symbol, (v, v))[0]) / 2 for v in x.tolist()])

    def implied(self, expression: Expression, lower: float, upper: float) -> bool:
        """Whether an expression stays within bounds as long as its one coordinate, and its speed, do."""
        positions = {s.position for s in expression.symbols}
        if len(positions) != 1 or any(s.order > 1 for s in expression.symbols):
            return False
        (symbol,) = positions
        ends = self._limits.get(symbol, REALS)
        if not (math.isfinite(ends[0]) and math.isfinite(ends[1]) and ends[0] < ends[1]):
            return False
        factor: RealInterval = (1.0, 1.0)
        speeds = [s for s in expression.symbols if s.order]
        if speeds:
            slope = expression.partial(speeds)[0]
            rest = expression({symbol: sum(ends) / 2, speeds[0]: 0.0})
            if any(s.order for s in slope.symbols) or abs(float(rest)) > 0:
                return False
            expression, factor = slope, self._limits.get(speeds[0], REALS)
        (term,) = self._terms.elements(expression)
        span = enclose_curve(
            lambda where: self._enclosures.enclose([term], {symbol: taylor_variable(where)})[0], *ends
        )
        low, high = interval_multiply(span, factor)
        return lower - _ROUNDING <= low and high <= upper + _ROUNDING

    def errors(
        self, placed: Mapping[str, MotionChain], parents: Mapping[str, str]
    ) -> dict[str, FrameDeviation]:
        """Return how far off frames may be, those that are off at all.

        A rotation that is off by ε turns everything behind it by ε at most, and moves it by 2 sin(ε/2) times
        its distance at most; a translation moves it by its own error. Errors of one motion after the other
        add up. Distances from the line of a motion are taken as large as they may get, with all errors.
        """
        result: dict[str, FrameDeviation] = {}
        # Before each frame: rotations that are off, with the distance from their lines, and translations.
        before: dict[str, tuple[list[tuple[float, float]], float]] = {WORLD: ([], 0.0)}
        for name, found in placed.items():
            turns, shift = before[parents[name]]
            errors = self._errors.get(name, {})
            reaches = [self._reach(m, errors.get(k, 0.0)) for k, m in enumerate(found.moving)]
            whole = float(np.linalg.norm(found.pose[:3, 3])) + sum(reaches)
            turns = [(angle, distance + whole) for angle, distance in turns]
            for k, error in errors.items():
                motion = found.moving[k]
                if _slides(motion):
                    shift += error
                else:
                    turns.append((error, float(np.linalg.norm(motion.point)) + sum(reaches[k + 1 :])))
            before[name] = turns, shift
            if turns or shift:
                moved = sum(2 * math.sin(min(a, math.pi) / 2) * d for a, d in turns if d)
                result[name] = FrameDeviation((shift + moved) * _UP, sum(a for a, _ in turns) * _UP)
        return result

    def _reach(self, motion: JointMotion | QuaternionMotion, error: float) -> float:
        """Return how far a motion takes the origin of its frame at most, also where it is off."""
        if isinstance(motion, QuaternionMotion) or motion.turns:
            return 2 * float(np.linalg.norm(motion.point))  # around a circle about the line
        lower, upper = self._limits.get(motion.variable.data, REALS)
        if not (math.isfinite(lower) and math.isfinite(upper)):
            return math.inf
        amount = motion.amount
        span = enclose_curve(lambda where: taylor_polynomial(amount, taylor_variable(where)), lower, upper)
        return max(abs(span[0]), abs(span[1])) + error


def _slides(motion: JointMotion | QuaternionMotion) -> bool:
    return isinstance(motion, JointMotion) and not motion.turns


def find_term_symbols(term: Term) -> list[Symbol]:
    """Return the symbols that a term depends on, sorted."""
    found: set[Symbol] = set()
    for step in reachable_terms((term,)):
        if step.op == ca.OP_PARAMETER:
            found.add(step.data)
        elif step.op == "implicit":
            found.update(step.data[0].symbols)
    return sorted(found, key=lambda s: s.sort_key)
