"""What one constraint does, told by coordinates that are free."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from kineverse.expressions.expression import Expression
from kineverse.expressions.substitution import apply
from kineverse.model.constraint import Constraint
from kineverse.model.rates import Rates, plain
from kineverse.symbols import Symbol

from .boxes import Box
from .domain import Domain
from .positions import Kept, on_position
from .speeds import Blocked, on_speed
from .turns import TURN, Turns, repeats


@dataclass
class Reading:
    """What a constraint stops or keeps, and with reasons what is unknown about it."""

    blocked: Blocked | None = None
    kept: list[Kept] = field(default_factory=list)
    unknown: list[tuple[str, Box]] = field(default_factory=list)


def read(constraint: Constraint, rates: Rates, given: Mapping[Symbol, float], domain: Domain) -> Reading:
    """Return what a constraint does.

    Conditions on coordinates that follow others are told by those that they follow, and conditions on what
    goes round without limits by an angle within one turn. Where that is not possible they are told by the
    names in the constraint, and that it was not is unknown.
    """
    lower, held, upper = (plain(p) for p in (constraint.lower, constraint.expression, constraint.upper))
    bare = Constraint(lower, held, upper)
    named = {s for p in (lower, held, upper) for s in p.symbols}
    follow = {s: rates.dependent[s] for s in sorted(named, key=str) if s in rates.dependent}
    turns = _turns(bare, follow, given, domain)
    if not follow and not turns.stand_ins:
        return _read(bare, {}, given, domain)
    within = Domain({**domain.limits, **dict.fromkeys(turns.stand_ins.values(), TURN)}, domain.spheres)
    told = {**{s: apply(e, turns.stand_ins) for s, e in follow.items()}, **turns.stand_ins}
    found = _in_full(_read(bare, told, given, within), turns)
    if not found.unknown:
        return found
    by_name = _read(bare, {}, given, domain)
    if follow:
        because = f"{_names(follow)} follows {_names(s for e in follow.values() for s in e.symbols)}"
        by_name.unknown += [(f"{because}, and {reason}", box) for reason, box in found.unknown]
    return by_name


def _names(symbols: Iterable[Symbol]) -> str:
    return " and ".join(sorted({str(s) for s in symbols}))


def _read(
    bare: Constraint, follow: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> Reading:
    found = Reading()
    if bare.order:
        found.blocked = on_speed(bare, follow, given, domain, found.unknown)
    else:
        found.kept = on_position(bare, follow, given, domain, found.unknown)
    return found


def _turns(
    bare: Constraint, follow: Mapping[Symbol, Expression], given: Mapping[Symbol, float], domain: Domain
) -> Turns:
    ends = [apply(end, follow) for end in (bare.lower, bare.upper)]
    inner = {s for s in bare.expression.symbols if not s.order}
    ends += [apply(bare.expression, follow)] if bare.order else []
    free = {s for end in ends for s in end.symbols if s.has_derivative and not s.order} - given.keys()
    around = (s for s in sorted(free, key=str) if domain.of(s).is_everything)
    return Turns(s for s in around if (bare.order or s not in inner) and repeats(ends, s))


def _in_full(found: Reading, turns: Turns) -> Reading:
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
    return Reading(blocked, kept, [(reason, turns.box(box)) for reason, box in found.unknown])
