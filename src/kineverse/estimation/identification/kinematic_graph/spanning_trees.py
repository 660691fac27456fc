"""Maximum spanning trees and edge probabilities."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from kineverse.lie import Array

NodeT = TypeVar("NodeT", bound=Hashable)


def spanning_tree(
    nodes: Iterable[NodeT], gains: Mapping[frozenset[NodeT], float], leaves: Collection[NodeT] = ()
) -> list[frozenset[NodeT]]:
    """Return the connections of the spanning tree, or forest, with the largest sum of gains.

    It is the structure of largest likelihood if the density is a product over connections (Chow and Liu
    1968). Leaves have one connection at most.
    """
    group = {node: {node} for node in nodes}
    chosen = []
    for connection in sorted(gains, key=lambda c: -gains[c]):
        a, b = connection
        if group[a] is group[b] or any(len(group[leaf]) > 1 for leaf in connection if leaf in leaves):
            continue
        chosen.append(connection)
        group[a] |= group[b]
        for node in group[b]:
            group[node] = group[a]
    return chosen


def split_tree(
    connection: frozenset[NodeT], tree: Iterable[frozenset[NodeT]]
) -> tuple[frozenset[NodeT], frozenset[NodeT]]:
    """Return the nodes on either side of a connection of a tree."""
    rest = [c for c in tree if c != connection]
    parts = []
    for node in connection:
        reached = {node}
        while new := {n for c in rest if c & reached for n in c} - reached:
            reached |= new
        parts.append(frozenset(reached))
    return parts[0], parts[1]


def edge_probabilities(
    nodes: Iterable[NodeT], gains: Mapping[frozenset[NodeT], float], leaves: Collection[NodeT] = ()
) -> dict[frozenset[NodeT], float]:
    """Return the probability of each connection over all maximal spanning forests.

    The probability of a tree is proportional to exp(Σ gains of its connections), with a uniform prior over
    trees. By the matrix-tree theorem (Kirchhoff 1847) a connection ij of weight w is in a tree with
    probability w / c. Here c is the conductance between i and j in a network with these weights. It is
    computed by eliminating all other nodes one by one (star-mesh transform). This only adds and multiplies
    positive numbers, so logarithms lose no digits for gains that differ by orders of magnitude.

    Leaves have one connection at most, so each leaf is independent. The probabilities add up to the number of
    connections of a tree.
    """
    order = {node: k for k, node in enumerate(node for node in nodes if node not in leaves)}
    logs = np.full((len(order), len(order)), -np.inf)
    of_leaf: dict[NodeT, float] = {}
    for connection, gain in gains.items():
        for leaf in connection & {*leaves}:
            of_leaf[leaf] = float(np.logaddexp(of_leaf.get(leaf, -np.inf), gain))
        if connection <= order.keys():
            i, j = (order[node] for node in connection)
            logs[i, j] = logs[j, i] = gain
    found = {}
    for connection, gain in gains.items():
        if connection <= order.keys():
            i, j = (order[node] for node in connection)
            total = _log_conductance(logs, i, j)
        else:
            (leaf,) = connection & {*leaves}
            total = of_leaf[leaf]
        found[connection] = math.exp(min(0.0, gain - total))
    return found


def replacement_probabilities(
    connection: frozenset[NodeT],
    tree: Iterable[frozenset[NodeT]],
    gains: Mapping[frozenset[NodeT], float],
    leaves: Collection[NodeT] = (),
) -> dict[frozenset[NodeT], float]:
    """Return the probabilities of the connections that replace one, in trees without it.

    They connect the two sides of the removed one and are sorted by probability. Their sum is at least the
    probability that the one is absent.
    """
    one, other = split_tree(connection, tree)
    around = {c: gain for c, gain in gains.items() if c <= one | other}
    missing = 1.0 - edge_probabilities(one | other, around, leaves)[connection]
    del around[connection]
    found = edge_probabilities(one | other, around, leaves)
    apart = {*leaves} - connection
    across = {c: missing * p for c, p in found.items() if c & one and c & other and not c & apart}
    return dict(sorted(across.items(), key=lambda pair: -pair[1]))


def _log_conductance(logs: Array, start: int, end: int) -> float:
    """Return the log conductance between two nodes, from the log conductances of all connections."""
    order = [*(k for k in range(len(logs)) if k not in (start, end)), start, end]
    left = logs[np.ix_(order, order)]
    for _ in order[2:]:
        spokes, left = left[0, 1:], left[1:, 1:]
        total = np.logaddexp.reduce(spokes)
        if total > -np.inf:
            left = np.logaddexp(left, spokes[:, None] + spokes - total)
    return float(left[0, 1])


def tree_path(tree: Iterable[frozenset[NodeT]], start: NodeT, end: NodeT) -> list[NodeT]:
    """Return the nodes on the path between two nodes of a tree; an empty list if they are not connected."""
    connections = list(tree)
    before: dict[NodeT, NodeT] = {start: start}
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


def orient_tree(
    first: Iterable[NodeT], nodes: Sequence[NodeT], tree: Iterable[frozenset[NodeT]]
) -> tuple[tuple[NodeT, ...], list[tuple[NodeT, NodeT]]]:
    """Return the roots and the connections directed away from them.

    In each component of the forest, the node that comes first in ``first`` is the root.
    """
    connections = list(tree)
    roots: list[NodeT] = []
    directed: list[tuple[NodeT, NodeT]] = []
    reached: set[NodeT] = set()
    for node in first:
        if node in reached:
            continue
        roots.append(node)
        reached.add(node)
        waiting = [node]
        while waiting:
            parent = waiting.pop(0)
            for child in nodes:
                if child not in reached and frozenset((parent, child)) in connections:
                    directed.append((parent, child))
                    reached.add(child)
                    waiting.append(child)
    return tuple(roots), directed
