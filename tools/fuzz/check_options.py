"""Options with which an input is checked: its prefix, whether loops are closed, and edits."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from random import Random

PREFIXES = (None, "p", "q/ü:%")
EDITS = 3
LOOPS = 8
"""One of so many inputs has its loops closed, which takes a hundred times as long as all other checks."""


@dataclass(frozen=True)
class CheckOptions:
    """Options of one check of an input.

    Attributes
    ----------
    loops
        True if loops are closed.
    prefix
        Prefix of all names.
    seed
        Seed of the edits that are tried; None for no edits.
    """

    loops: bool = True
    prefix: str | None = None
    seed: int | None = 0


def choose_options(data: bytes) -> CheckOptions:
    """Choose the options of an input, the same for equal inputs, so that the search is deterministic."""
    random = Random(zlib.crc32(data))
    prefix = random.choice(PREFIXES) if random.random() < 0.5 else None
    seed = random.randrange(EDITS) if random.random() < 0.5 else None
    return CheckOptions(random.randrange(LOOPS) == 0, prefix, seed)


def all_options() -> Iterator[CheckOptions]:
    """Yield all options, quick ones first."""
    for loops, prefix, seed in product((False, True), PREFIXES, (None, *range(EDITS))):
        yield CheckOptions(loops, prefix, seed)
