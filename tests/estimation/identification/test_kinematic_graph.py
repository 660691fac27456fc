"""Kinematic graphs of known models from noisy poses, and their spanning trees."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import logsumexp
from synthetic_recordings import noisy

import kineverse as kv
from kineverse.estimation import identify_graph, pose_covariance
from kineverse.estimation.identification.kinematic_graph import (
    edge_probabilities,
    orient_tree,
    replacement_probabilities,
    spanning_tree,
    split_tree,
    tree_path,
)

Array = npt.NDArray[np.float64]
POSITION, ORIENTATION = 0.003, 0.008
NOISE = pose_covariance(POSITION, ORIENTATION)
SOME = ("rigid", "prismatic", "revolute", "planar", "free")


def data(model: kv.Model, frames: list[str], count: int, seed: int, reach: float = 1.0) -> dict[str, Array]:
    """Return noisy poses of frames while all coordinates move at random."""
    random, symbols = np.random.default_rng(seed), model.degrees_of_freedom
    points = random.uniform(0.0, reach, (count, len(symbols)))
    return {
        frame: noisy(kv.compile(model.fk(frame), symbols).batch(points), POSITION, ORIENTATION, random)
        for frame in frames
    }


def at(x: float, y: float, z: float) -> kv.model.Pose:
    """Return a place without a turn."""
    return kv.model.Pose.from_matrix(kv.translation(x, y, z)())


@pytest.fixture(scope="module")
def cart() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Planar(name="cart", parent="world", child="cart"))
        edit.apply(
            kv.Prismatic(
                name="drawer", parent="cart", child="drawer", axis=(1, 0, 0), origin=at(0.1, 0.0, 0.5)
            )
        )
        edit.apply(
            kv.Revolute(name="door", parent="cart", child="hinge", axis=(0, 0, 1), origin=at(0.3, 0.2, 0.0))
        )
        edit.add_frame("door", parent="hinge", transform=kv.translation(0.4, 0, 0))
        edit.add_frame("sticker", parent="door", transform=kv.translation(-0.1, 0.02, 0.3))
        edit.apply(kv.Revolute(name="handle", parent="door", child="spindle", axis=(0, 1, 0)))
        edit.add_frame("handle", parent="spindle", transform=kv.translation(0.1, 0.05, 0))
    return model


PARTS = ["handle", "drawer", "door", "sticker", "cart"]


@pytest.fixture(scope="module")
def poses(cart: kv.Model) -> dict[str, Array]:
    return data(cart, PARTS, 40, 0)


def test_identify_graph_finds_the_tree_of_a_cart(poses: dict[str, Array]) -> None:
    counted: list[tuple[int, int]] = []
    graph = identify_graph(
        poses, noise=NOISE, families=SOME, progress=lambda done, total: counted.append((done, total))
    )
    assert counted == [(k, 15) for k in range(16)]
    assert graph.roots == ("world",)
    assert {(e.parent, e.child, e.fit.family) for e in graph.edges} == {
        ("world", "cart", "planar"),
        ("cart", "drawer", "prismatic"),
        ("cart", "door", "revolute"),
        ("door", "handle", "revolute"),
    }
    assert [body.parts for body in graph.bodies if len(body.parts) > 1] == [("door", "sticker")]
    assert graph.loops == ()
    assert "rigid: door = sticker" in str(graph)
    assert "cart -> drawer: prismatic" in str(graph)
    assert all(e.fit.covariance.shape == (len(e.fit.coordinates),) * 2 for e in graph.edges)


def test_model_of_a_graph_moves_as_the_true_model(cart: kv.Model, poses: dict[str, Array]) -> None:
    graph = identify_graph(poses, noise=NOISE, families=SOME, world=False)
    # Two joints each are at the door and at the cart; the door comes first.
    assert graph.roots == ("door",)
    assert [(e.parent, e.child) for e in graph.edges] == [
        ("door", "handle"),
        ("door", "cart"),
        ("cart", "drawer"),
    ]
    model = graph.model(prefix="learned")
    assert {f"learned/{part}" for part in PARTS} <= set(model.frames)
    assert model.articulations["learned/door"].kind == "floating"
    truth = kv.compile([cart.fk("handle", "cart"), cart.fk("sticker", "cart")], cart.degrees_of_freedom)
    points = np.random.default_rng(0).uniform(0.0, 1.0, (40, len(cart.degrees_of_freedom)))
    for k in (0, 17):
        values = {f"learned/{edge.child}": float(edge.fit.joint_values[k, 0]) for edge in graph.edges}
        handle, sticker = truth(points[k])
        assert np.allclose(model.fk("learned/handle", "learned/cart")(kv.State(values)), handle, atol=0.02)
        assert np.allclose(model.fk("learned/sticker", "learned/cart")(kv.State(values)), sticker, atol=0.02)


def linkage() -> kv.Model:
    """Return a crank and a rocker with a coupler between them."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="crank", parent="world", child="crank_pin", axis=(0, 0, 1)))
        edit.add_frame("crank", parent="crank_pin", transform=kv.translation(0.1, 0.02, 0.05))
        edit.add_frame("pin", parent="crank_pin", transform=kv.translation(0.2, 0, 0))
        edit.apply(kv.Revolute(name="coupler", parent="pin", child="coupler_pin", axis=(0, 0, 1)))
        edit.add_frame("coupler", parent="coupler_pin", transform=kv.translation(0.4, 0, 0.02))
        edit.add_frame("coupler_end", parent="coupler_pin", transform=kv.translation(0.8, 0, 0))
        edit.add_frame("stand", parent="world", transform=kv.translation(0.7, 0, 0))
        edit.apply(kv.Revolute(name="rocker", parent="stand", child="rocker_pin", axis=(0, 0, 1)))
        edit.add_frame("rocker", parent="rocker_pin", transform=kv.translation(0.3, 0, 0.02))
        edit.add_frame("rocker_end", parent="rocker_pin", transform=kv.translation(0.6, 0, 0))
        edit.close_loop("coupler_end", "rocker_end", mask=("x", "y"))
    return model


def test_identify_graph_finds_the_loop_of_a_linkage() -> None:
    poses = data(linkage(), ["crank", "coupler", "rocker"], 40, 1, reach=2.0)
    graph = identify_graph(poses, noise=NOISE, families=SOME)
    connected = {frozenset((e.parent, e.child)) for e in (*graph.edges, *graph.loops)}
    ring = ["world", "crank", "coupler", "rocker", "world"]
    assert connected == {frozenset(ends) for ends in pairwise(ring)}
    assert len(graph.loops) == 1
    assert "loop: " in str(graph)


@pytest.mark.parametrize("seed", range(3))
def test_a_telescope_is_connected_by_small_motions_and_few_poses_are_ambiguous(seed: int) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="inner", parent="world", child="inner", axis=(1, 0, 0)))
        edit.apply(kv.Prismatic(name="outer", parent="inner", child="outer", axis=(1, 0, 0)))
    sure, unsure = (
        identify_graph(data(model, ["inner", "outer"], count, seed, reach=0.3), noise=NOISE, families=SOME)
        for count in (40, 4)
    )
    assert [(e.parent, e.child) for e in sure.edges] == [("world", "inner"), ("inner", "outer")]
    assert all(e.probability > 0.99 for e in sure.edges)
    assert any(e.probability < 0.99 for e in unsure.edges)
    for graph in (sure, unsure):
        # A tree of three parts has two connections.
        assert sum(graph.connections.values()) == pytest.approx(2.0)
        assert list(graph.connections.values()) == sorted(graph.connections.values(), reverse=True)
    for edge in unsure.edges:
        assert graph.connections[edge.parent, edge.child] == edge.probability
        assert edge.probability + sum(edge.alternatives.values()) > 0.9
        assert all(f"or {a} -> {b}" in str(edge) for a, b in edge.alternatives)


def test_independent_drawers_and_doors_close_no_loop() -> None:
    kitchen = kv.load("kitchen")
    frames = ["kitchen/fridge_door_handle", "kitchen/oven_left_drawer", "kitchen/oven_right_drawer"]
    graph = identify_graph(data(kitchen, frames, 40, 2, reach=0.4), noise=NOISE, families=SOME)
    assert {(e.parent, e.child) for e in graph.edges} == {("world", frame) for frame in frames}
    assert graph.loops == ()


def test_parts_never_observed_together_are_not_connected(poses: dict[str, Array]) -> None:
    some = {part: poses[part].copy() for part in ("cart", "drawer", "handle", "door")}
    for part in ("cart", "drawer"):
        some[part][:20] = np.nan
    for part in ("handle", "door"):
        some[part][20:] = np.nan
    graph = identify_graph(some, noise=NOISE, families=SOME, world=False)
    assert len(graph.roots) == 2
    assert {frozenset((e.parent, e.child)) for e in graph.edges} == {
        frozenset(("cart", "drawer")),
        frozenset(("door", "handle")),
    }
    assert "connected to nothing" in str(graph)
    assert set(graph.model().frames) == set(some)


def test_points_are_children_of_other_parts(cart: kv.Model, poses: dict[str, Array]) -> None:
    some = {part: poses[part] for part in ("cart", "door")}
    some |= {part: poses[part][:, :3, 3].copy() for part in ("drawer", "sticker", "handle")}
    some["drawer"][[3, 8]] = np.nan
    graph = identify_graph(some, noise=NOISE, families=SOME, world=False)
    assert graph.points == ("drawer", "sticker", "handle")
    assert graph.roots == ("cart",)
    assert {(e.parent, e.child, e.fit.family) for e in graph.edges} == {
        ("cart", "door", "revolute"),
        ("cart", "drawer", "prismatic"),
        ("door", "handle", "revolute"),
    }
    assert [body.parts for body in graph.bodies if len(body.parts) > 1] == [("door", "sticker")]
    model = graph.model()
    truth = kv.compile(
        [cart.fk(part, "cart")[:3, 3] for part in ("drawer", "handle", "sticker")], cart.degrees_of_freedom
    )
    points = np.random.default_rng(0).uniform(0.0, 1.0, (40, len(cart.degrees_of_freedom)))
    for k in (0, 17):
        values = {e.child: float(e.fit.joint_values[np.searchsorted(e.times, k), 0]) for e in graph.edges}
        for part, position in zip(("drawer", "handle", "sticker"), truth(points[k]), strict=True):
            assert np.allclose(model.fk(part, "cart")[:3, 3](kv.State(values)), position, atol=0.02)


def test_a_free_point_is_a_sliding_point() -> None:
    random = np.random.default_rng(0)
    places = {"fly": random.uniform(-1.0, 1.0, (30, 3)), "ant": random.uniform(-1.0, 1.0, (30, 3))}
    places["ant"][:, 2] = 0.3
    data = {part: place + random.normal(0.0, POSITION, place.shape) for part, place in places.items()}
    graph = identify_graph(data, noise=NOISE, families=SOME)
    assert {(e.parent, e.child, e.fit.family) for e in graph.edges} == {
        ("world", "fly", "free"),
        ("world", "ant", "planar"),
    }
    model = graph.model()
    assert {str(s) for s in model.degrees_of_freedom} == {"fly/x", "fly/y", "fly/z", "ant/x", "ant/y"}
    for edge in graph.edges:
        values = dict(zip((f"{edge.child}/{c}" for c in "xyz"), edge.fit.joint_values[7], strict=False))
        assert np.allclose(model.fk(edge.child)[:3, 3](values), places[edge.child][7], atol=5.0 * POSITION)
        everywhere = {str(x): value for x, value in model.default_state().items()} | values
        assert not model.violations(everywhere)


def test_identify_graph_refuses_points_only(poses: dict[str, Array]) -> None:
    points = {part: poses[part][:, :3, 3] for part in ("cart", "door")}
    with pytest.raises(kv.errors.InvalidValueError, match="Only positions were observed"):
        identify_graph(points, noise=NOISE, world=False)
    with pytest.raises(kv.errors.InvalidValueError, match="say as_point=True"):
        identify_graph(points, noise=NOISE).edges[0].fit.operation("cart", "world")
    # A point that was never observed together with a pose floats by itself.
    apart = {"cart": poses["cart"].copy(), "door": points["door"].copy()}
    apart["cart"][:20], apart["door"][20:] = np.nan, np.nan
    graph = identify_graph(apart, noise=NOISE, families=SOME, world=False)
    assert graph.roots == ("cart", "door")
    assert graph.edges == ()


def test_identify_graph_is_invariant_to_the_order_of_parts_and_times(poses: dict[str, Array]) -> None:
    parts = ["cart", "drawer", "door"]
    first = identify_graph({p: poses[p] for p in parts}, noise=NOISE, families=SOME)
    order = np.random.default_rng(3).permutation(40)
    second = identify_graph({p: poses[p][order] for p in parts[::-1]}, noise=NOISE, families=SOME)
    assert {(e.parent, e.child) for e in first.edges} == {(e.parent, e.child) for e in second.edges}
    axes = [np.asarray({e.child: e for e in g.edges}["door"].fit.parameters["axis"]) for g in (first, second)]
    assert np.allclose(*axes, atol=1e-5)


def test_identify_graph_refuses_invalid_input(poses: dict[str, Array]) -> None:
    with pytest.raises(kv.errors.InvalidValueError, match="at least two"):
        identify_graph({"cart": poses["cart"]}, noise=NOISE, world=False)
    with pytest.raises(kv.errors.InvalidValueError, match="at least two"):
        identify_graph({}, noise=NOISE)
    with pytest.raises(kv.errors.DuplicateNameError, match="world"):
        identify_graph({"world": poses["cart"], "cart": poses["cart"]}, noise=NOISE)
    with pytest.raises(kv.errors.InvalidValueError, match="noise of 'cart' is unknown"):
        identify_graph({"cart": poses["cart"]})
    with pytest.raises(kv.errors.ShapeError, match="different numbers of times"):
        identify_graph({"cart": poses["cart"], "door": poses["door"][:3]}, noise=NOISE)
    with pytest.raises(kv.errors.UnknownNameError, match="family"):
        identify_graph({"cart": poses["cart"]}, noise=NOISE, families=["hinge"])
    broken = poses["cart"].copy()
    broken[5, 1, 1] = np.inf
    with pytest.raises(kv.errors.InvalidValueError, match="Pose 5"):
        identify_graph({"cart": broken}, noise=NOISE)


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
    result = {}
    for chosen in combinations(gains, most):
        if len(spanning_tree(nodes, {c: gains[c] for c in chosen})) == most:
            result[chosen] = sum(gains[c] for c in chosen)
    return result


@pytest.mark.parametrize("seed", range(4))
def test_spanning_tree_agrees_with_scipy(seed: int) -> None:
    random, nodes = np.random.default_rng(seed), list(range(7))
    gains = {frozenset(pair): float(random.uniform(1.0, 9.0)) for pair in combinations(nodes, 2)}
    matrix = np.zeros((7, 7))
    for connection, gain in gains.items():
        a, b = sorted(connection)
        matrix[a, b] = 10.0 - gain
    wanted, tree = minimum_spanning_tree(matrix).tocoo(), spanning_tree(nodes, gains)
    assert set(tree) == {frozenset(map(int, ends)) for ends in zip(wanted.row, wanted.col, strict=True)}
    one, other = split_tree(tree[2], tree)
    assert one | other == set(nodes)
    directed = orient_tree([3], nodes, tree)[1]
    for end in nodes[1:]:
        way = tree_path(directed, 0, end)
        assert (way[0], way[-1]) == (0, end)
        assert len({*way}) == len(way)
        assert all(frozenset(ends) in tree for ends in pairwise(way))
    assert tree_path(directed[:0], 0, 6) == []


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("spread", [0.1, 3.0, 3000.0])
def test_edge_probabilities_agree_with_the_sum_over_all_trees(count: int, spread: float) -> None:
    gains = all_gains(count, spread, seed=count, missing=count // 4)
    trees = all_trees(gains)
    total, result = logsumexp(list(trees.values())), edge_probabilities(range(count), gains)
    assert sum(result.values()) == pytest.approx(len(next(iter(trees))))
    for connection, probability in result.items():
        logs = [log for tree, log in trees.items() if connection in tree]
        assert probability == pytest.approx(np.exp(logsumexp(logs) - total), rel=1e-9, abs=1e-300)


def test_small_edge_probabilities_are_accurate() -> None:
    # A determinant of the Laplacian would lose them: the rest of 1 is 1e-130.
    gains = {frozenset("ab"): 300.0, frozenset("bc"): 300.0, frozenset("ac"): 0.0}
    result = edge_probabilities("abc", gains)
    assert result[frozenset("ac")] == pytest.approx(2.0 * np.exp(-300.0), rel=1e-12)


def test_spanning_tree_of_an_unconnected_graph_is_a_forest() -> None:
    gains = {frozenset("ab"): -5.0, frozenset("cd"): 1.0, frozenset("de"): 1.0, frozenset("ce"): 1.0}
    result = edge_probabilities("abcdef", gains)
    assert result[frozenset("ab")] == 1.0
    assert [result[frozenset(ends)] for ends in ("cd", "de", "ce")] == pytest.approx([2 / 3] * 3)
    tree = spanning_tree("abcdef", gains)
    assert replacement_probabilities(frozenset("ab"), tree, gains) == {}


@pytest.mark.parametrize("seed", range(5))
def test_replacement_probabilities_agree_with_the_sum_over_all_trees(seed: int) -> None:
    gains = all_gains(5, 1.0, seed)
    trees = all_trees(gains)
    total, best = logsumexp(list(trees.values())), spanning_tree(range(5), gains)
    assert set(best) == set(max(trees, key=trees.__getitem__))
    for connection in best:
        one, other = split_tree(connection, best)
        result = replacement_probabilities(connection, best, gains)
        assert set(result) == {c for c in gains if c & one and c & other} - {connection}
        for c, probability in result.items():
            logs = [log for tree, log in trees.items() if c in tree and connection not in tree]
            assert probability == pytest.approx(np.exp(logsumexp(logs) - total))
        assert sum(result.values()) >= 1.0 - edge_probabilities(range(5), gains)[connection] - 1e-12


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
    total, best = logsumexp(list(trees.values())), spanning_tree(range(5), gains, leaves)
    assert set(best) == set(max(trees, key=trees.__getitem__))
    for connection, probability in edge_probabilities(range(5), gains, leaves).items():
        logs = [log for tree, log in trees.items() if connection in tree]
        assert probability == pytest.approx(np.exp(logsumexp(logs) - total))
    for connection in best:
        for c, probability in replacement_probabilities(connection, best, gains, leaves).items():
            logs = [log for tree, log in trees.items() if c in tree and connection not in tree]
            assert probability == pytest.approx(np.exp(logsumexp(logs) - total))


def test_orient_tree_lists_parents_before_children() -> None:
    roots, directed = orient_tree("bdac", "abcde", [frozenset("ab"), frozenset("bc"), frozenset("de")])
    assert roots == ("b", "d")
    assert directed == [("b", "a"), ("b", "c"), ("d", "e")]
