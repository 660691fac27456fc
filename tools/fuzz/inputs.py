"""Inputs one after the other, the same ones for the same seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random

from .targets import Target


def inputs(target: Target, seeds: Sequence[bytes], random: Random) -> Iterator[bytes]:
    """Yield inputs by grammar and mutations of those and of seeds, without end."""
    while True:
        base = random.choice(seeds) if seeds and random.random() < 0.5 else target.generate(random)
        yield base
        yield another(target, base, seeds, random)


def another(target: Target, data: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Return an input made of one that is known, or one by grammar, which is right more often."""
    if random.random() < 0.3:
        return target.generate(random)
    other = random.choice(others) if others and random.random() < 0.5 else target.generate(random)
    return target.mutate(data, other, random)
