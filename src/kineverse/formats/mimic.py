"""Mimic chains, resolved to the joints that move independently.

Of a chain ``c = m2 b + o2``, ``b = m1 a + o1`` remains ``c = (m2 m1) a + (m2 o1 + o2)``. Each follower is
resolved once, so that chains of any length take linear time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

from msgspec import Struct

from .xml_reader import quote
from .xml_values import LARGEST, SMALLEST

K = TypeVar("K", bound=Hashable)


class MimicRelation(Struct, Generic[K], frozen=True):
    """Position as an affine function of another one: ``multiplier * leader + offset``."""

    leader: K
    multiplier: float = 1.0
    offset: float = 0.0


def resolve_mimic_chains(
    following: Mapping[K, MimicRelation[K]],
    refuse: Callable[[K, str], None],
    check: Callable[[K, K], bool] | None = None,
) -> dict[K, MimicRelation[K]]:
    """Return the relation of each follower to the independent end of its chain, with composed factors."""
    resolved: dict[K, MimicRelation[K]] = {}
    free: set[K] = set()
    for start in following:
        chain: dict[K, MimicRelation[K]] = {}
        last = start
        while last in following and last not in resolved and last not in free:
            step = chain[last] = following[last]
            if step.leader in chain:
                circle = " -> ".join(quote(str(name)) for name in list(chain)[:8])
                refuse(
                    last,
                    "it mimics itself"
                    + (f", by way of {circle}" if len(chain) > 1 else "")
                    + ". One of them has to move by itself: remove its <mimic>.",
                )
            if step.leader in chain or (check is not None and not check(last, step.leader)):
                del chain[last]
                free.add(last)
                break
            last = step.leader
        end = resolved.get(last, MimicRelation(last))
        for follower in reversed(chain):
            step = chain[follower]
            multiplier, offset = step.multiplier * end.multiplier, step.multiplier * end.offset + step.offset
            if not (is_valid_factor(multiplier) and abs(offset) <= LARGEST):
                refuse(
                    follower,
                    f"the factors of its chain of <mimic> come to {multiplier:g} and {offset:g}: positions "
                    f"or limits overflow. Multipliers are 0 or from {SMALLEST:g} to {LARGEST:g}.",
                )
                end = MimicRelation(follower)
                free.add(follower)
                continue
            end = resolved[follower] = MimicRelation(end.leader, multiplier, offset)
    return resolved


def is_valid_factor(factor: float) -> bool:
    """Return True if positions and limits times a factor stay finite."""
    return not factor or SMALLEST <= abs(factor) <= LARGEST
