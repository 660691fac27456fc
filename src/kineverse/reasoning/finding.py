"""Interlocks, read off the constraints of a model."""

from __future__ import annotations

import math
from collections.abc import Mapping

from kineverse.errors import ExpressionError
from kineverse.expressions.evaluation import assign
from kineverse.model.constraint import Constraint
from kineverse.model.rates import plain
from kineverse.model.view import ModelView
from kineverse.symbols import Symbol

from .boxes import Interval
from .domain import Domain
from .interlock import Hold, Interlock, Interlocks, Undecided
from .orientations import orientations
from .positions import Kept
from .reading import read
from .regions import Region, common, merged
from .speeds import Blocked


def interlocks(model: ModelView, values: Mapping[Symbol | str, float] | None = None) -> Interlocks:
    """Return what locks what in a model, in which intervals: from its constraints alone.

    Bounds of constraints are taken apart into cases, by the signs of what ``less``, ``where``, minima and
    maxima, splines and products of truths compare. Each case is a box of intervals; whether a bound lets a
    speed go, or what range it leaves to a position, follows by exact arithmetic where bounds are
    polynomials, and by interval arithmetic elsewhere. Nothing is sampled. What cannot be decided is listed as
    ``undecided``, with the constraint, the reason and the region.

    Everything is said about configurations within the constant limits of coordinates. Ordinary limits and
    speed limits are no interlocks, and neither is a limit of one orientation, as a cone is. Conditions on
    coordinates that follow others, in a closed loop, are told by the free ones, and what goes round without
    limits by its angle within a turn, ``crank mod 2π``. Where several free ones would have to be told apart
    together, they are told as the constraints name them, and listed as undecided. Coordinates that wheels
    move are named as the constraints name them.

    Parameters
    ----------
    model
        A model or a snapshot.
    values
        Numbers for coordinates and parameters that are taken as given. Parameters have the value they were
        made with, unless they are given here.

    Raises
    ------
    ExpressionError
        If it is not a model.
    UnknownNameError, ValueRejectedError
        For values of unknown names, or NaN.
    """
    if not isinstance(model, ModelView):
        raise ExpressionError(
            f"Interlocks are read off a model or a snapshot of one, not off {type(model).__name__!r}."
        )
    constraints = dict(model.constraints.items())
    given = _given(constraints, values)
    domain = Domain(constant_limits(constraints), orientations(model.rates))
    order = list(constraints)
    found: list[Interlock] = []
    undecided: list[Undecided] = []
    blocked: dict[str, Blocked] = {}
    kept: dict[str, list[Kept]] = {}
    for name, constraint in constraints.items():
        if not _may_lock(constraint):
            continue
        reading = read(constraint, model.rates, given, domain)
        if reading.blocked is not None:
            blocked[name] = reading.blocked
        kept[name] = reading.kept
        for reason in dict.fromkeys(reason for reason, _ in reading.unknown):
            where = merged(box for other, box in reading.unknown if other == reason)
            undecided.append(Undecided(name, reason, where))
    for name, one in blocked.items():
        found += _of_speed(name, one)
    found += _by_two(blocked)
    for name, many in kept.items():
        found += [Interlock(k.held, k.hold, (name,), k.where, k.lower, k.upper) for k in many]
    found += _contradicting(kept)
    found.sort(key=lambda lock: [order.index(name) for name in lock.constraints])
    return Interlocks(found, undecided)


def constant_limits(constraints: Mapping[str, Constraint]) -> dict[Symbol, Interval]:
    """Return between which numbers symbols stay: what constraints on single symbols say by numbers."""
    limits: dict[Symbol, Interval] = {}
    for constraint in constraints.values():
        symbol = plain(constraint.expression)
        if isinstance(symbol, Symbol) and not constraint.lower.symbols and not constraint.upper.symbols:
            low, high = float(constraint.lower), float(constraint.upper)
            side = Interval(low, high, not math.isinf(low), not math.isinf(high))
            both = limits.get(symbol, Interval()).intersection(side)
            limits[symbol] = side if both.is_empty else both
    return limits


def _may_lock(constraint: Constraint) -> bool:
    """Return whether it is more than a limit of one coordinate, or speeds, by numbers around 0."""
    if constraint.lower.symbols or constraint.upper.symbols:
        return True
    if not constraint.order:
        return len(plain(constraint.expression).symbols) > 1
    return not float(constraint.lower) < 0 < float(constraint.upper) or not isinstance(
        plain(constraint.expression), Symbol
    )


def _given(
    constraints: Mapping[str, Constraint], values: Mapping[Symbol | str, float] | None
) -> dict[Symbol, float]:
    symbols = {
        s for c in constraints.values() for p in (c.lower, c.expression, c.upper) for s in plain(p).symbols
    }
    given = {s: s.value for s in symbols if s.value is not None}
    if values:
        names = {str(v) for v in values}
        chosen = tuple(sorted((s for s in symbols if str(s) in names), key=lambda s: s.sort_key))
        given |= dict(zip(chosen, map(float, assign(chosen, values)), strict=True))
    return given


def _of_speed(name: str, one: Blocked) -> list[Interlock]:
    both = one.up & one.down
    void = (one.up_beyond & one.down) | (one.up & one.down_beyond)
    regions: dict[Hold, Region] = {
        "stands still": both - void,
        "cannot increase": one.up - both,
        "cannot decrease": one.down - both,
        "has no value": void,
    }
    found = {hold: region.short() for hold, region in regions.items()}
    return [Interlock(one.held, hold, (name,), where) for hold, where in found.items() if where]


def _by_two(blocked: Mapping[str, Blocked]) -> list[Interlock]:
    """Return where one constraint stops what another one lets go, or even demands."""
    found: list[Interlock] = []
    names = list(blocked)
    for first in names:
        for second in names:
            a, b = blocked[first], blocked[second]
            if first == second or a.held != b.held:
                continue
            pair = tuple(sorted((first, second), key=names.index))
            void = (a.up_beyond & b.down) | (a.up & b.down_beyond)
            both = (a.up & b.down) - ((a.up & a.down) | (b.up & b.down))
            regions: dict[Hold, Region] = {"stands still": both - void, "has no value": void}
            holds = {hold: region.short() for hold, region in regions.items()}
            found += [Interlock(a.held, hold, pair, where) for hold, where in holds.items() if where]
    return found


def _contradicting(kept: Mapping[str, list[Kept]]) -> list[Interlock]:
    """Return where the constant ranges of two constraints leave one position, or none."""
    every = [(name, k) for name, many in kept.items() for k in many if k.range is not None]
    found = []
    for i, (first, a) in enumerate(every):
        for second, b in every[i + 1 :]:
            assert a.range is not None
            assert b.range is not None
            if first == second or a.held != b.held or "has no value" in (a.hold, b.hold):
                continue
            low, high = max(a.range[0], b.range[0]), min(a.range[1], b.range[1])
            where = merged(common(a.where, b.where))
            if not where or low < high or (low == high and "stands still" in (a.hold, b.hold)):
                continue
            if low > high:
                found.append(Interlock(a.held, "has no value", (first, second), where))
            else:
                bound = a.lower if low == a.range[0] else b.lower
                found.append(Interlock(a.held, "stands still", (first, second), where, bound, bound))
    return found
