"""The ways in which an input is looked at: below which prefix, with its loops closed or not."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from random import Random

PREFIXES = (None, "p", "q/ü:%")
EDITS = 3
LOOPS = 8
"""Of so many inputs one has its loops closed, which takes a hundred times as long as all the rest."""


@dataclass(frozen=True)
class Way:
    """How an input is looked at.

    Attributes
    ----------
    loops
        Whether loops are closed, or left open.
    prefix
        Which names get.
    seed
        Of the edits that are tried, None for none.
    """

    loops: bool = True
    prefix: str | None = None
    seed: int | None = 0


def way_of(data: bytes) -> Way:
    """Return one way, the same one for equal inputs: the search believes that they do the same."""
    random = Random(zlib.crc32(data))
    prefix = random.choice(PREFIXES) if random.random() < 0.5 else None
    seed = random.randrange(EDITS) if random.random() < 0.5 else None
    return Way(random.randrange(LOOPS) == 0, prefix, seed)


def all_ways() -> Iterator[Way]:
    """Yield all of them, what is quick first."""
    for loops, prefix, seed in product((False, True), PREFIXES, (None, *range(EDITS))):
        yield Way(loops, prefix, seed)
