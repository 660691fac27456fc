"""Interlocks of a model, derived from its constraints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from kineverse.errors import ExpressionError
from kineverse.expressions.evaluation import symbol_values
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.intervals.graph import TermGraph
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.rate_nodes import to_plain
from kineverse.model.rates import Rates
from kineverse.symbols import Symbol

from .boxes import Interval, IntervalBox
from .case_split import Case
from .constraint_effects import PositionEffect, SpeedEffect, find_position_effects, find_speed_effect
from .domain import Domain, UnitSphere
from .interlock import Hold, Interlock, Interlocks, Undecided
from .periodicity import TURN, PeriodicCoordinates, is_periodic
from .regions import Region, intersect_boxes, merge_boxes


def find_orientations(rates: Rates) -> tuple[UnitSphere, ...]:
    """Return the coordinates whose rates keep the sum of their squares: x·ẋ + y·ẏ + z·ż + w·ẇ = 0."""
    groups: dict[frozenset[Symbol], list[Symbol]] = {}
    for coordinate in sorted(rates, key=lambda s: s.sort_key):
        groups.setdefault(frozenset(rates[coordinate]), []).append(coordinate)
    return tuple(tuple(g) for g in groups.values() if len(g) > 1 and _keep_length(g, rates))


def _keep_length(group: list[Symbol], rates: Rates) -> bool:
    for speed in rates[group[0]]:
        growth = TermGraph({}).term(sum((x * rates[x][speed] for x in group), as_expression(0.0)))
        exact = Case((growth,), Domain({})).value(growth).polynomial
        if exact is None or exact.terms:
            return False
    return True


@dataclass
class ConstraintEffects:
    """What a constraint stops or keeps, and with reasons what is unknown about it."""

    blocked: SpeedEffect | None = None
    kept: list[PositionEffect] = field(default_factory=list)
    unknown: list[tuple[str, IntervalBox]] = field(default_factory=list)


def find_effects(
    constraint: Constraint, rates: Rates, given: Mapping[Symbol, float], domain: Domain
) -> ConstraintEffects:
    """Return what a constraint does.

    Conditions on coordinates that follow others are told by those that they follow, and conditions on what
    goes round without limits by an angle within one turn. Where that is not possible they are told by the
    names in the constraint, and that it was not is unknown.
    """
    lower, held, upper = (to_plain(p) for p in (constraint.lower, constraint.expression, constraint.upper))
    bare = Constraint(lower, held, upper)
    named = {s for p in (lower, held, upper) for s in p.symbols}
    follow = {s: rates.dependent[s] for s in sorted(named, key=str) if s in rates.dependent}
    turns = _find_periodic(bare, follow, given, domain)
    if not follow and not turns.stand_ins:
        return _effects_by_order(bare, {}, given, domain)
    within = Domain({**domain.limits, **dict.fromkeys(turns.stand_ins.values(), TURN)}, domain.spheres)
    told = {**{s: apply_substitution(e, turns.stand_ins) for s, e in follow.items()}, **turns.stand_ins}
    found = _restore_coordinates(_effects_by_order(bare, told, given, within), turns)
    if not found.unknown:
        return found
    by_name = _effects_by_order(bare, {}, given, domain)
    if follow:
        because = f"{_names(follow)} follows {_names(s for e in follow.values() for s in e.symbols)}"
        by_name.unknown += [(f"{because}, and {reason}", box) for reason, box in found.unknown]
    return by_name


def _names(symbols: Iterable[Symbol]) -> str:
    return " and ".join(sorted({str(s) for s in symbols}))


def _effects_by_order(
    bare: Constraint, follow: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> ConstraintEffects:
    found = ConstraintEffects()
    if bare.order:
        found.blocked = find_speed_effect(bare, follow, given, domain, found.unknown)
    else:
        found.kept = find_position_effects(bare, follow, given, domain, found.unknown)
    return found


def _find_periodic(
    bare: Constraint, follow: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> PeriodicCoordinates:
    ends = [apply_substitution(end, follow) for end in (bare.lower, bare.upper)]
    inner = {s for s in bare.expression.symbols if not s.order}
    ends += [apply_substitution(bare.expression, follow)] if bare.order else []
    free = {s for end in ends for s in end.symbols if s.has_derivative and not s.order} - given.keys()
    around = (s for s in sorted(free, key=str) if domain.of(s).is_everything)
    return PeriodicCoordinates(s for s in around if (bare.order or s not in inner) and is_periodic(ends, s))


def _restore_coordinates(found: ConstraintEffects, turns: PeriodicCoordinates) -> ConstraintEffects:
    """Return a reading about the coordinates that go round, not about what stands in for them."""
    blocked = found.blocked
    if blocked is not None:
        for region in (blocked.up, blocked.down, blocked.up_beyond, blocked.down_beyond):
            region.boxes[:] = map(turns.box, region.boxes)
            region.telling[:] = map(turns.box, region.telling)
    kept = [
        replace(
            k,
            where=tuple(map(turns.box, k.where)),
            lower=None if k.lower is None else turns.expression(k.lower),
            upper=None if k.upper is None else turns.expression(k.upper),
        )
        for k in found.kept
    ]
    return ConstraintEffects(blocked, kept, [(reason, turns.box(box)) for reason, box in found.unknown])


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
    UnknownNameError, InvalidValueError
        For values of unknown names, or NaN.
    """
    if not isinstance(model, ModelView):
        raise ExpressionError(
            f"Interlocks are read off a model or a snapshot of one, not off {type(model).__name__!r}."
        )
    constraints = dict(model.constraints.items())
    given = _given_values(constraints, values)
    domain = Domain(constant_limits(constraints), find_orientations(model.rates))
    order = list(constraints)
    found: list[Interlock] = []
    undecided: list[Undecided] = []
    blocked: dict[str, SpeedEffect] = {}
    kept: dict[str, list[PositionEffect]] = {}
    for name, constraint in constraints.items():
        if not _may_lock(constraint):
            continue
        reading = find_effects(constraint, model.rates, given, domain)
        if reading.blocked is not None:
            blocked[name] = reading.blocked
        kept[name] = reading.kept
        for reason in dict.fromkeys(reason for reason, _ in reading.unknown):
            where = merge_boxes(box for other, box in reading.unknown if other == reason)
            undecided.append(Undecided(name, reason, where))
    for name, one in blocked.items():
        found += _speed_interlocks(name, one)
    found += _pair_interlocks(blocked)
    for name, many in kept.items():
        found += [Interlock(k.held, k.hold, (name,), k.where, k.lower, k.upper) for k in many]
    found += _contradicting_ranges(kept)
    found.sort(key=lambda lock: [order.index(name) for name in lock.constraints])
    return Interlocks(found, undecided)


def constant_limits(constraints: Mapping[str, Constraint]) -> dict[Symbol, Interval]:
    """Return between which numbers symbols stay: what constraints on single symbols say by numbers."""
    limits: dict[Symbol, Interval] = {}
    for constraint in constraints.values():
        symbol = to_plain(constraint.expression)
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
        return len(to_plain(constraint.expression).symbols) > 1
    return not float(constraint.lower) < 0 < float(constraint.upper) or not isinstance(
        to_plain(constraint.expression), Symbol
    )


def _given_values(
    constraints: Mapping[str, Constraint], values: Mapping[Symbol | str, float] | None
) -> dict[Symbol, float]:
    symbols = {
        s for c in constraints.values() for p in (c.lower, c.expression, c.upper) for s in to_plain(p).symbols
    }
    given = {s: s.value for s in symbols if s.value is not None}
    if values:
        names = {str(v) for v in values}
        chosen = tuple(sorted((s for s in symbols if str(s) in names), key=lambda s: s.sort_key))
        given |= dict(zip(chosen, map(float, symbol_values(chosen, values)), strict=True))
    return given


def _speed_interlocks(name: str, one: SpeedEffect) -> list[Interlock]:
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


def _pair_interlocks(blocked: Mapping[str, SpeedEffect]) -> list[Interlock]:
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


def _contradicting_ranges(kept: Mapping[str, list[PositionEffect]]) -> list[Interlock]:
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
            where = merge_boxes(intersect_boxes(a.where, b.where))
            if not where or low < high or (low == high and "stands still" in (a.hold, b.hold)):
                continue
            if low > high:
                found.append(Interlock(a.held, "has no value", (first, second), where))
            else:
                bound = a.lower if low == a.range[0] else b.lower
                found.append(Interlock(a.held, "stands still", (first, second), where, bound, bound))
    return found
