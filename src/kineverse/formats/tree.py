"""Connectivity of frames: disjoint sets of names, and the path between two frames of a tree."""

from __future__ import annotations

from collections.abc import Mapping


class DisjointSets:
    """Names that belong together."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Return the name that stands for the group of a name."""
        above = self._above
        top = name
        while top in above:
            top = above[top]
        while name != top:
            above[name], name = top, above[name]
        return top

    def unite(self, a: str, b: str) -> bool:
        """Put two groups together; return whether they were two."""
        first, second = self.of(a), self.of(b)
        if first == second:
            return False
        self._above[second] = first
        return True


def path_between(a: str, b: str, parents: Mapping[str, str]) -> list[str]:
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
