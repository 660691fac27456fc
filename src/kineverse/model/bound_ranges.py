"""Ranges of bounds over all states, by interval arithmetic."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise, product

from kineverse.expressions.expression import Expression
from kineverse.intervals.arithmetic import REALS, RealInterval, interval_hull
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import TermGraph
from kineverse.symbols import Symbol

_PIECES = {1: 64, 2: 8, 3: 4}
"""Pieces into which the range of each of so many symbols is divided: smooth bounds get tighter by it."""


def enclose_bound(bound: Expression, box: Mapping[Symbol, RealInterval]) -> RealInterval:
    """Return the range of a scalar where its symbols are in a box, to 14 digits and rather too wide.

    Symbols that the box lacks are anywhere. The range is infinite if nothing is known about it.
    """
    terms = TermGraph({s: s.value for s in bound.symbols if s.value is not None})
    root, enclosures = terms.term(bound), Enclosures(terms)
    symbols = [s for s in bound.symbols if s.value is None]
    sides = [box.get(s, REALS) for s in symbols]
    count = _PIECES.get(len(symbols), 1)
    found: RealInterval | None = None
    for piece in product(*(_divide(side, count) for side in sides)):
        (((low, high), *_),) = enclosures.enclose(
            [root], {s: (x,) for s, x in zip(symbols, piece, strict=True)}
        )
        here = -math.inf if math.isnan(low) else low, math.inf if math.isnan(high) else high
        found = here if found is None else interval_hull(found, here)
        if found == REALS:
            break
    assert found is not None
    # Enclosures are rounded outwards by single digits, which nobody wants to see.
    return float(f"{found[0]:.14g}"), float(f"{found[1]:.14g}")


def _divide(side: RealInterval, count: int) -> list[RealInterval]:
    low, high = side
    if not (math.isfinite(high - low) and high > low):
        return [side]
    ends = [low + (high - low) * k / count for k in range(count)] + [high]
    return list(pairwise(ends))
