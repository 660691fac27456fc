"""The way from one frame of a tree to another."""

from __future__ import annotations

from collections.abc import Mapping


def way_between(a: str, b: str, parents: Mapping[str, str]) -> list[str]:
    """Return what lies on the way between two frames, below the last frame that both hang below.

    First from ``a`` upwards, then from ``b`` upwards. Roots have no parent.
    """
    ways: list[list[str]] = []
    for end in (a, b):
        way: list[str] = []
        while end in parents:
            way.append(end)
            end = parents[end]
        ways.append(way)
    first, second = map(set, ways)
    return [name for name in ways[0] if name not in second] + [name for name in ways[1] if name not in first]
