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
from kineverse.model.rates import Rates, to_plain
from kineverse.symbols import Symbol

from .boxes import Interval, IntervalBox, Region, intersect_boxes, merge_boxes
from .case_split import Case
from .constraint_effects import PositionEffect, SpeedEffect, find_position_effects, find_speed_effect
from .domain import TURN, Domain, PeriodicCoordinates, UnitSphere, is_periodic
from .interlock_records import Hold, Interlock, Interlocks, Undecided


def find_orientations(rates: Rates) -> tuple[UnitSphere, ...]:
    """Return the groups of coordinates whose rates preserve their norm: x·ẋ + y·ẏ + z·ż + w·ẇ = 0."""
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
    """Effects of a constraint on speeds and positions, and unknown regions with their reasons."""

    speed: SpeedEffect | None = None
    positions: list[PositionEffect] = field(default_factory=list)
    unknown: list[tuple[str, IntervalBox]] = field(default_factory=list)


def find_effects(
    constraint: Constraint, rates: Rates, given: Mapping[Symbol, float], domain: Domain
) -> ConstraintEffects:
    """Return the effects of a constraint.

    Conditions on dependent coordinates are expressed by independent ones, and conditions on periodic
    coordinates without limits by an angle within one turn. If that is not possible, they are expressed by the
    coordinates that the constraint names, and the effect counts as unknown.
    """
    lower, held, upper = (to_plain(p) for p in (constraint.lower, constraint.expression, constraint.upper))
    bare = Constraint(lower, held, upper)
    named = {s for p in (lower, held, upper) for s in p.symbols}
    dependent = {s: rates.dependent[s] for s in sorted(named, key=str) if s in rates.dependent}
    periodic = _find_periodic(bare, dependent, given, domain)
    if not dependent and not periodic.wrapped:
        return _effects_by_order(bare, {}, given, domain)
    within = Domain({**domain.limits, **dict.fromkeys(periodic.wrapped.values(), TURN)}, domain.spheres)
    substitutions = {
        **{s: apply_substitution(e, periodic.wrapped) for s, e in dependent.items()},
        **periodic.wrapped,
    }
    result = _restore_coordinates(_effects_by_order(bare, substitutions, given, within), periodic)
    if not result.unknown:
        return result
    by_name = _effects_by_order(bare, {}, given, domain)
    if dependent:
        because = f"{_names(dependent)} follows {_names(s for e in dependent.values() for s in e.symbols)}"
        by_name.unknown += [(f"{because}, and {reason}", box) for reason, box in result.unknown]
    return by_name


def _names(symbols: Iterable[Symbol]) -> str:
    return " and ".join(sorted({str(s) for s in symbols}))


def _effects_by_order(
    bare: Constraint, dependent: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> ConstraintEffects:
    result = ConstraintEffects()
    if bare.order:
        result.speed = find_speed_effect(bare, dependent, given, domain, result.unknown)
    else:
        result.positions = find_position_effects(bare, dependent, given, domain, result.unknown)
    return result


def _find_periodic(
    bare: Constraint, dependent: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> PeriodicCoordinates:
    ends = [apply_substitution(end, dependent) for end in (bare.lower, bare.upper)]
    inner = {s for s in bare.expression.symbols if not s.order}
    ends += [apply_substitution(bare.expression, dependent)] if bare.order else []
    free = {s for end in ends for s in end.symbols if s.has_derivative and not s.order} - given.keys()
    unlimited = (s for s in sorted(free, key=str) if domain.limits_of(s).is_everything)
    allowed = (s for s in unlimited if bare.order or s not in inner)
    return PeriodicCoordinates(s for s in allowed if is_periodic(ends, s))


def _restore_coordinates(found: ConstraintEffects, periodic: PeriodicCoordinates) -> ConstraintEffects:
    speed = found.speed
    if speed is not None:
        blocks = speed.blocks_increase, speed.blocks_decrease
        for region in (*blocks, speed.forces_decrease, speed.forces_increase):
            region.boxes[:] = map(periodic.restore_box, region.boxes)
            region.reported[:] = map(periodic.restore_box, region.reported)
    positions = [
        replace(
            k,
            boxes=tuple(map(periodic.restore_box, k.boxes)),
            lower=None if k.lower is None else periodic.restore_expression(k.lower),
            upper=None if k.upper is None else periodic.restore_expression(k.upper),
        )
        for k in found.positions
    ]
    unknown = [(reason, periodic.restore_box(box)) for reason, box in found.unknown]
    return ConstraintEffects(speed, positions, unknown)


def interlocks(model: ModelView, values: Mapping[Symbol | str, float] | None = None) -> Interlocks:
    """Return the interlocks of a model, derived from its constraints alone.

    An interlock is a restriction of a coordinate that is active in certain intervals of other coordinates.
    The bounds of constraints are split into cases by the signs of the operands of ``less``, ``where``,
    minima, maxima, splines and products of truth values. Each case is a box of intervals. The sign of a bound
    on a speed, and the range left to a position, follow by exact arithmetic for polynomial bounds and by
    interval arithmetic otherwise. Nothing is sampled. Undecidable cases are listed as ``undecided``, with the
    constraint, the reason and the region.

    All statements hold for configurations within the constant limits of coordinates. Ordinary limits of
    positions and speeds are no interlocks, and neither is a limit of one orientation, such as a cone.
    Conditions on dependent coordinates of a closed loop are expressed by the independent ones, and conditions
    on periodic coordinates without limits by the angle within a turn, ``crank mod 2π``. Conditions that would
    need several independent coordinates at once are expressed by the coordinates that the constraint names,
    and are listed as undecided. Coordinates of wheeled bases are named as in the constraints.

    Parameters
    ----------
    model
        A model or a snapshot.
    values
        Numbers for coordinates and parameters that are taken as given. Other parameters have their default
        values.

    Raises
    ------
    ExpressionError
        If ``model`` is no model.
    UnknownNameError, InvalidValueError
        If a value has an unknown name, or is NaN.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.GarageDoor(name="garage", parent="world"))
    'garage door garage'
    >>> kv.reasoning.interlocks(model)
    <Interlocks: 1 found, 0 undecided>
    """
    if not isinstance(model, ModelView):
        raise ExpressionError(
            f"Interlocks are read off a model or a snapshot of one, not off {type(model).__name__!r}."
        )
    constraints = dict(model.constraints.items())
    given = _given_values(constraints, values)
    domain = Domain(constant_limits(constraints), find_orientations(model.rates))
    order = list(constraints)
    result: list[Interlock] = []
    undecided: list[Undecided] = []
    speed_effects: dict[str, SpeedEffect] = {}
    position_effects: dict[str, list[PositionEffect]] = {}
    for name, constraint in constraints.items():
        if not _may_lock(constraint):
            continue
        effects = find_effects(constraint, model.rates, given, domain)
        if effects.speed is not None:
            speed_effects[name] = effects.speed
        position_effects[name] = effects.positions
        for reason in dict.fromkeys(reason for reason, _ in effects.unknown):
            where = merge_boxes(box for other, box in effects.unknown if other == reason)
            undecided.append(Undecided(name, reason, where))
    for name, one in speed_effects.items():
        result += _speed_interlocks(name, one)
    result += _pair_interlocks(speed_effects)
    for name, many in position_effects.items():
        result += [Interlock(k.held, k.hold, (name,), k.boxes, k.lower, k.upper) for k in many]
    result += _contradicting_ranges(position_effects)
    result.sort(key=lambda lock: [order.index(name) for name in lock.constraints])
    return Interlocks(result, undecided)


def constant_limits(constraints: Mapping[str, Constraint]) -> dict[Symbol, Interval]:
    """Return the limits of symbols from constraints on single symbols with constant bounds."""
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
    """Return True unless a constraint limits one coordinate by numbers, or one speed by numbers around 0."""
    if constraint.lower.symbols or constraint.upper.symbols:
        return True
    if not constraint.order:
        return len(to_plain(constraint.expression).symbols) > 1
    around_zero = float(constraint.lower) < 0 < float(constraint.upper)
    return not (around_zero and isinstance(to_plain(constraint.expression), Symbol))


def _given_values(
    constraints: Mapping[str, Constraint], values: Mapping[Symbol | str, float] | None
) -> dict[Symbol, float]:
    parts = (p for c in constraints.values() for p in (c.lower, c.expression, c.upper))
    symbols = {s for p in parts for s in to_plain(p).symbols}
    given = {s: s.value for s in symbols if s.value is not None}
    if values:
        names = {str(v) for v in values}
        chosen = tuple(sorted((s for s in symbols if str(s) in names), key=lambda s: s.sort_key))
        given |= dict(zip(chosen, map(float, symbol_values(chosen, values)), strict=True))
    return given


def _speed_interlocks(name: str, one: SpeedEffect) -> list[Interlock]:
    both = one.blocks_increase & one.blocks_decrease
    void = (one.forces_decrease & one.blocks_decrease) | (one.blocks_increase & one.forces_increase)
    regions: dict[Hold, Region] = {
        "stands still": both - void,
        "cannot increase": one.blocks_increase - both,
        "cannot decrease": one.blocks_decrease - both,
        "has no value": void,
    }
    result = {hold: region.cover() for hold, region in regions.items()}
    return [Interlock(one.held, hold, (name,), where) for hold, where in result.items() if where]


def _pair_interlocks(speed_effects: Mapping[str, SpeedEffect]) -> list[Interlock]:
    """Return the interlocks of two constraints that together block or contradict each other."""
    result: list[Interlock] = []
    names = list(speed_effects)
    for first in names:
        for second in names:
            a, b = speed_effects[first], speed_effects[second]
            if first == second or a.held != b.held:
                continue
            pair = tuple(sorted((first, second), key=names.index))
            void = (a.forces_decrease & b.blocks_decrease) | (a.blocks_increase & b.forces_increase)
            both = (a.blocks_increase & b.blocks_decrease) - (
                (a.blocks_increase & a.blocks_decrease) | (b.blocks_increase & b.blocks_decrease)
            )
            regions: dict[Hold, Region] = {"stands still": both - void, "has no value": void}
            holds = {hold: region.cover() for hold, region in regions.items()}
            result += [Interlock(a.held, hold, pair, where) for hold, where in holds.items() if where]
    return result


def _contradicting_ranges(position_effects: Mapping[str, list[PositionEffect]]) -> list[Interlock]:
    """Return the interlocks of two constraints whose constant ranges leave one position, or none."""
    every = [(name, k) for name, many in position_effects.items() for k in many if k.range is not None]
    result = []
    for i, (first, a) in enumerate(every):
        for second, b in every[i + 1 :]:
            assert a.range is not None
            assert b.range is not None
            if first == second or a.held != b.held or "has no value" in (a.hold, b.hold):
                continue
            low, high = max(a.range[0], b.range[0]), min(a.range[1], b.range[1])
            where = merge_boxes(intersect_boxes(a.boxes, b.boxes))
            if not where or low < high or (low == high and "stands still" in (a.hold, b.hold)):
                continue
            if low > high:
                result.append(Interlock(a.held, "has no value", (first, second), where))
            else:
                bound = a.lower if low == a.range[0] else b.lower
                result.append(Interlock(a.held, "stands still", (first, second), where, bound, bound))
    return result
