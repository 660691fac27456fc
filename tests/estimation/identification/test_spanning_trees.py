"""Spanning trees compared with scipy, and edge probabilities with the sum over all trees."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import logsumexp

from kineverse.estimation.identification.kinematic_graph.graph import (
    edge_probabilities,
    orient_tree,
    replacement_probabilities,
    spanning_tree,
    split_tree,
    tree_path,
)

Gains = dict[frozenset[int], float]


def all_gains(count: int, spread: float, seed: int, missing: int = 0) -> Gains:
    """Return gains of all connections but some."""
    random = np.random.default_rng(seed)
    gains = {frozenset(pair): float(random.normal(0.0, spread)) for pair in combinations(range(count), 2)}
    left_out = random.permutation(len(gains))[:missing]
    return {c: gain for k, (c, gain) in enumerate(gains.items()) if k not in left_out}


def all_trees(gains: Gains) -> dict[tuple[frozenset[int], ...], float]:
    """Return the logarithms of the weights of all trees, or forests of as many connections as there can be."""
    nodes = {node for c in gains for node in c}
    most = len(spanning_tree(nodes, gains))
    found = {}
    for chosen in combinations(gains, most):
        if len(spanning_tree(nodes, {c: gains[c] for c in chosen})) == most:
            found[chosen] = sum(gains[c] for c in chosen)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_spanning_tree_agrees_with_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    nodes = list(range(7))
    gains = {frozenset(pair): float(random.uniform(1.0, 9.0)) for pair in combinations(nodes, 2)}
    matrix = np.zeros((7, 7))
    for connection, gain in gains.items():
        a, b = sorted(connection)
        matrix[a, b] = 10.0 - gain
    wanted = minimum_spanning_tree(matrix).tocoo()
    tree = spanning_tree(nodes, gains)
    assert set(tree) == {frozenset(map(int, ends)) for ends in zip(wanted.row, wanted.col, strict=True)}
    one, other = split_tree(tree[2], tree)
    assert one | other == set(nodes)
    way = tree_path(tree, 0, 6)
    assert (way[0], way[-1]) == (0, 6)
    assert all(frozenset(ends) in tree for ends in pairwise(way))


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("spread", [0.1, 3.0, 3000.0])
def test_edge_probabilities_agree_with_the_sum_over_all_trees(count: int, spread: float) -> None:
    gains = all_gains(count, spread, seed=count, missing=count // 4)
    trees = all_trees(gains)
    total = logsumexp(list(trees.values()))
    found = edge_probabilities(range(count), gains)
    assert sum(found.values()) == pytest.approx(len(next(iter(trees))))
    for connection, probability in found.items():
        logs = [log for tree, log in trees.items() if connection in tree]
        assert probability == pytest.approx(np.exp(logsumexp(logs) - total), rel=1e-9, abs=1e-300)


def test_small_edge_probabilities_are_accurate() -> None:
    # A determinant of the Laplacian would have lost them: what is left of 1 is 1e-130.
    gains = {frozenset("ab"): 300.0, frozenset("bc"): 300.0, frozenset("ac"): 0.0}
    found = edge_probabilities("abc", gains)
    assert found[frozenset("ac")] == pytest.approx(2.0 * np.exp(-300.0), rel=1e-12)


def test_spanning_tree_of_an_unconnected_graph_is_a_forest() -> None:
    gains = {frozenset("ab"): -5.0, frozenset("cd"): 1.0, frozenset("de"): 1.0, frozenset("ce"): 1.0}
    found = edge_probabilities("abcdef", gains)
    assert found[frozenset("ab")] == 1.0
    assert [found[frozenset(ends)] for ends in ("cd", "de", "ce")] == pytest.approx([2 / 3] * 3)
    tree = spanning_tree("abcdef", gains)
    assert replacement_probabilities(frozenset("ab"), tree, gains) == {}


@pytest.mark.parametrize("seed", range(5))
def test_replacement_probabilities_agree_with_the_sum_over_all_trees(seed: int) -> None:
    gains = all_gains(5, 1.0, seed)
    trees = all_trees(gains)
    total = logsumexp(list(trees.values()))
    best = spanning_tree(range(5), gains)
    assert set(best) == set(max(trees, key=trees.__getitem__))
    for connection in best:
        one, other = split_tree(connection, best)
        found = replacement_probabilities(connection, best, gains)
        assert set(found) == {c for c in gains if c & one and c & other} - {connection}
        for c, probability in found.items():
            logs = [log for tree, log in trees.items() if c in tree and connection not in tree]
            assert probability == pytest.approx(np.exp(logsumexp(logs) - total))
        assert sum(found.values()) >= 1.0 - edge_probabilities(range(5), gains)[connection] - 1e-12


@pytest.mark.parametrize("seed", range(4))
def test_leaves_have_one_connection(seed: int) -> None:
    gains = all_gains(5, 2.0, seed)
    leaves = (1, 4)
    gains = {c: gain for c, gain in gains.items() if c != {1, 4}}
    trees = {
        tree: log
        for tree, log in all_trees(gains).items()
        if all(sum(leaf in c for c in tree) == 1 for leaf in leaves)
    }
    total = logsumexp(list(trees.values()))
    best = spanning_tree(range(5), gains, leaves)
    assert set(best) == set(max(trees, key=trees.__getitem__))
    found = edge_probabilities(range(5), gains, leaves)
    for connection, probability in found.items():
        logs = [log for tree, log in trees.items() if connection in tree]
        assert probability == pytest.approx(np.exp(logsumexp(logs) - total))
    for connection in best:
        for c, probability in replacement_probabilities(connection, best, gains, leaves).items():
            logs = [log for tree, log in trees.items() if c in tree and connection not in tree]
            assert probability == pytest.approx(np.exp(logsumexp(logs) - total))


def test_orient_tree_lists_parents_before_children() -> None:
    tree = [frozenset("ab"), frozenset("bc"), frozenset("de")]
    roots, directed = orient_tree("bdac", "abcde", tree)
    assert roots == ("b", "d")
    assert directed == [("b", "a"), ("b", "c"), ("d", "e")]
