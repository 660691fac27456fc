"""Sequences of inputs, the same for the same seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random

from .targets import Target


def inputs(target: Target, seeds: Sequence[bytes], random: Random) -> Iterator[bytes]:
    """Yield inputs by grammar, seeds, and mutations of both, without end."""
    while True:
        base = random.choice(seeds) if seeds and random.random() < 0.5 else target.generate(random)
        yield base
        yield mutate_input(target, base, seeds, random)


def mutate_input(target: Target, data: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Mutate an input, or return one by grammar, which is valid more often."""
    if random.random() < 0.3:
        return target.generate(random)
    other = random.choice(others) if others and random.random() < 0.5 else target.generate(random)
    return target.mutate(data, other, random)
