"""Connectivity of frames: disjoint sets of names, and the path between two frames of a tree."""

from __future__ import annotations

from collections.abc import Mapping


class DisjointSets:
    """Disjoint sets of names (union-find with path compression)."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}

    def find(self, name: str) -> str:
        """Return the representative of the set that a name is in."""
        parents = self._parents
        root = name
        while root in parents:
            root = parents[root]
        while name != root:
            parents[name], name = root, parents[name]
        return root

    def union(self, a: str, b: str) -> bool:
        """Merge the sets of two names; return True if they were different."""
        first, second = self.find(a), self.find(b)
        if first == second:
            return False
        self._parents[second] = first
        return True


def path_between(a: str, b: str, parents: Mapping[str, str]) -> list[str]:
    """Return the frames on the path between two frames, without their lowest common ancestor.

    First from ``a`` upwards, then from ``b`` upwards. Roots have no parent.
    """
    chains: list[list[str]] = []
    for end in (a, b):
        chain: list[str] = []
        while end in parents:
            chain.append(end)
            end = parents[end]
        chains.append(chain)
    first, second = chains
    common = set(first) & set(second)
    return [name for name in (*first, *second) if name not in common]
