"""How many rates lead to one another, which decides what carrying coordinates costs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.model.rates import all_symbols
from kineverse.symbols import Symbol

from .limits import COST_OF_RATE, Budget


def check_coupling(rates: Iterable[tuple[Symbol, Any]], budget: Budget) -> None:
    """Spend what it costs to carry every coordinate, each with all that its rate is made of.

    Raises
    ------
    RefusedError
        If it is too much.
    """
    given = dict(rates)
    leads = {coordinate: _leads_to(entry).intersection(given.keys()) for coordinate, entry in given.items()}
    for coordinate in leads:
        found, waiting = {coordinate}, [coordinate]
        while waiting:
            budget.spend(COST_OF_RATE)
            further = leads[waiting.pop()].difference(found)
            found |= further
            waiting += further


def _leads_to(entry: Any) -> set[Symbol]:
    if isinstance(entry, Expression):
        return all_symbols(entry)
    found = {speed.position for speed, _ in entry}
    return found.union(*(all_symbols(factor) for _, factor in entry))
