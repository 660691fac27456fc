"""Progress of long work: a bar on a terminal, nothing in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")


def progress(items: Iterable[Item], what: str, unit: str = "", total: int | None = None) -> Iterator[Item]:
    """Yield the items, with a bar on standard error if that is a terminal.

    Parameters
    ----------
    items
        What is worked on.
    what
        What is being done, in front of the bar.
    unit
        What is counted.
    total
        How many items there are, if they cannot say so themselves.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm

    if isinstance(items, Sized):
        total = len(items)
    yield from tqdm(items, desc=what, total=total, unit=f" {unit}" if unit else "it", leave=False)


@contextmanager
def doing(what: str) -> Iterator[None]:
    """Say on standard error what is being done, as long as it is; only if that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
