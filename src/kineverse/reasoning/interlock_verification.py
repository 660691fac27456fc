"""Independent check of interlocks by evaluation at points, without code of the search for interlocks."""

import math
import random
from collections.abc import Iterator

from kineverse.expressions.expression import Expression
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .boxes import IntervalBox
from .constraint_evaluation import default_point, is_inside, settle_point, value_at
from .interlock_records import Interlock, Interlocks

_Point = dict[Symbol, float]
_Range = tuple[float, float]
_Limits = dict[Expression, _Range]
TINY, ANY, BOTH_SIDES = 1e-12, (-math.inf, math.inf), ("stands still", "has no value")


def contradictions(model: ModelView, found: Interlocks, points: int = 20, seed: int = 0) -> list[str]:
    """Return claims that are wrong at a sample point, inside or outside of the boxes, and missing locks.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> kv.reasoning.contradictions(model, kv.reasoning.interlocks(model))
    []
    """
    given = model.constraints.items()
    rows = {n: Constraint(to_plain(c.lower), to_plain(c.expression), to_plain(c.upper)) for n, c in given}
    limits: _Limits = {}
    for c in rows.values():
        if not c.lower.symbols and not c.upper.symbols:
            low, high = limits.get(c.expression, ANY)
            limits[c.expression] = (max(low, float(c.lower)), min(high, float(c.upper)))
    symbols = {s for c in rows.values() for s in c.symbols} | {*model.symbols, *model.rates.dependent}
    chance, wrong, home = random.Random(seed), dict[str, None](), default_point(model)
    known = {n for k in found for n in k.constraints} | {u.constraint for u in found.undecided}
    unmet = {c.expression for n, c in rows.items() if n not in known and not c.order} & limits.keys()
    claimed = [box for item in found for box in item.when] + [box for u in found.undecided for box in u.where]
    boxes = [IntervalBox({})] * 5 + list(dict.fromkeys(claimed))
    for box in boxes:
        for _ in range(min(points, 1 + 50 * points // len(boxes))):
            point = _point(sorted(symbols, key=str), box, limits, chance)
            if settle_point(model, point):
                unmet -= {e for e in unmet if any(_is_in(value_at(e, p), limits[e]) for p in (home, point))}
                wrong |= dict.fromkeys(_compare(rows, found, limits, point))
    return [*wrong, *(f"{e} is never within its limits" for e in sorted(unmet, key=str))]


def _compare(rows: dict[str, Constraint], found: Interlocks, limits: _Limits, point: _Point) -> Iterator[str]:
    unknown = {u.constraint for u in found.undecided if any(is_inside(box, point) for box in u.where)}
    rooms: dict[Expression, dict[str, _Range]] = {}
    for name, c in rows.items():
        about = {s for s in c.expression.symbols if s.order == c.order}
        claimed = {k.held for k in found if name in k.constraints}
        whole = c.expression in claimed or (c.order > 0 and len(about) > 1)
        for held in {c.expression} if whole else about | claimed:
            rooms.setdefault(held, {})[name] = _room(c, held, point)
    for held, of in rooms.items():
        claims = [k for k in found if k.held == held and any(is_inside(box, point) for box in k.when)]
        limit = ANY if (speed := any(s.order for s in held.symbols)) else limits.get(held, ANY)
        for names in {k.constraints for k in claims} | {(n,) for n in of.keys() - unknown}:
            lows, highs = zip(limit, *(of.get(n, ANY) for n in names), strict=True)
            room = max(lows), min(highs)
            own = [k for k in claims if k.constraints == names]
            wrong = [k.hold for k in own if not _fits(k, limit, room, point)]
            yield from (f"{held} {hold}: not so by {', '.join(names)}" for hold in wrong)
            for direction, end in (("decrease", -room[0]), ("increase", room[1])) if speed else ():
                free = end > TINY or not unknown.isdisjoint(names)
                if not (free or any(k.hold in (f"cannot {direction}", *BOTH_SIDES) for k in claims)):
                    yield f"{held} cannot {direction}"
            if not (own or speed or _same(limit, room, True)):
                yield f"{held} is kept in {room} by {', '.join(names)}"


def _room(c: Constraint, held: Expression, point: _Point) -> _Range:
    low, here, high = (value_at(e, point) for e in (c.lower, c.expression, c.upper))
    if isinstance(held, Symbol):
        zero, one, two = (value_at(c.expression, {**point, held: x}) for x in (0.0, 1.0, 2.0))
        free = one == zero or not abs(two - 2 * one + zero) <= TINY * (1 + abs(two))  # or not just added
        sides = ANY if free else ((low - zero) / (one - zero), (high - zero) / (one - zero))
        return sides if free or one > zero else sides[::-1]
    back = value_at(c.expression, {s: -x if s.order else x for s, x in point.items()})
    if c.order and min(here, back) > 0 >= low:
        low = 0.0 if high <= 0 else -math.inf
    return low, high


def _fits(lock: Interlock, limit: _Range, room: _Range, point: _Point) -> bool:
    if lock.lower is None or lock.upper is None:
        void = room[0] > room[1] or not (lock.held in point or _is_in(value_at(lock.held, point), room))
        ends = {"increase": room[1] <= TINY, "decrease": room[0] >= -TINY, "value": void}
        return ends.get(lock.hold.split()[-1], max(map(abs, room)) <= TINY)
    low, high = value_at(lock.lower, point), value_at(lock.upper, point)
    return _same((max(low, limit[0]), min(high, limit[1])), room)


def _same(a: _Range, b: _Range, finite: bool = False) -> bool:
    near = (x == y or abs(x - y) <= 1e-6 * (1 + abs(x)) for x, y in zip(a, b, strict=True))
    return all(n or (finite and math.isinf(x)) for n, x in zip(near, a, strict=True))


def _is_in(x: float, room: _Range) -> bool:
    return room[0] - TINY <= x <= room[1] + TINY


def _point(symbols: list[Symbol], box: IntervalBox, limits: _Limits, chance: random.Random) -> _Point:
    point, ends = dict[Symbol, float](), dict[Symbol, _Range]()
    for s in symbols:
        low, high = limits.get(s, ANY)
        low, high = ends[s] = (low + 1e-5, high - 1e-5) if high - low > 1e-4 else (low, high)
        a, b = max(low, -9.0), min(high, 9.0)
        point[s] = s.value or chance.choice((a, b, chance.uniform(a, b), chance.uniform(a, b)))
    for axis, side in box.items():
        symbol, faces = axis.symbols[0], [float(x) for x in (side.lower, side.upper) if math.isfinite(x)]
        near = [chance.uniform(max(float(side.lower), -9.0), min(float(side.upper), 9.0))]
        near += [x + e * (1 + abs(x)) for x in faces for e in (-0.5, -1e-4, 1e-4, 0.5)]
        zero, one = (value_at(axis, {**point, symbol: x}) for x in (0.0, 1.0))
        point[symbol] = sorted([*ends[symbol], (chance.choice(near) - zero) / (one - zero)])[1]
    return point
