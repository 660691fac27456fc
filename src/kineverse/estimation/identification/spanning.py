"""Trees that connect parts, and how sure one is of each connection."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping
from typing import TypeVar

import numpy as np

Node = TypeVar("Node", bound=Hashable)


def spanning_tree(nodes: Iterable[Node], gains: Mapping[frozenset[Node], float]) -> list[frozenset[Node]]:
    """Return the connections of the tree with the largest sum of gains; of several trees, if need be.

    The structure of largest likelihood, if densities are products over connections (Chow and Liu 1968).
    """
    group = {node: {node} for node in nodes}
    chosen = []
    for connection in sorted(gains, key=lambda c: -gains[c]):
        a, b = connection
        if group[a] is group[b]:
            continue
        chosen.append(connection)
        group[a] |= group[b]
        for node in group[b]:
            group[node] = group[a]
    return chosen


def sides(
    connection: frozenset[Node], tree: Iterable[frozenset[Node]]
) -> tuple[frozenset[Node], frozenset[Node]]:
    """Return what is on either side of a connection of a tree."""
    rest = [c for c in tree if c != connection]
    parts = []
    for node in connection:
        reached = {node}
        while new := {n for c in rest if c & reached for n in c} - reached:
            reached |= new
        parts.append(frozenset(reached))
    return parts[0], parts[1]


def alternatives(
    connection: frozenset[Node], tree: Iterable[frozenset[Node]], gains: Mapping[frozenset[Node], float]
) -> dict[frozenset[Node], float]:
    """Return the probability of each connection that could hold both sides together, the rest being as it is.

    The likeliest first; they sum up to 1.
    """
    one, other = sides(connection, tree)
    logs = {c: gain for c, gain in gains.items() if c & one and c & other}
    total = float(np.logaddexp.reduce(list(logs.values())))
    found = {c: math.exp(log - total) for c, log in logs.items()}
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def path(tree: Iterable[frozenset[Node]], start: Node, end: Node) -> list[Node]:
    """Return the nodes from one to another along a tree; nothing if there is no way."""
    connections = list(tree)
    before: dict[Node, Node] = {start: start}
    reached = [start]
    while reached and end not in before:
        node = reached.pop()
        for connection in connections:
            for neighbour in connection - {node} if node in connection else ():
                if neighbour not in before:
                    before[neighbour] = node
                    reached.append(neighbour)
    if end not in before:
        return []
    way = [end]
    while way[-1] != start:
        way.append(before[way[-1]])
    return way[::-1]
