"""Loop closures of known linkages from noisy poses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic_recordings import noisy

import kineverse as kv
from kineverse.estimation import KinematicGraph, identify_graph, pose_covariance
from kineverse.estimation.identification.families import JOINT_FAMILIES, GroupMotion
from kineverse.estimation.identification.kinematic_graph import identify_pair, tree_path
from kineverse.estimation.identification.loop_closures import (
    CONSTRAINED_COMPONENTS,
    ClosureEquations,
    ObservedLoop,
    Ring,
    close_loops,
    resolve,
)
from kineverse.estimation.identification.observations import check_tracks, exact_track

Array = npt.NDArray[np.float64]
POSITION, ORIENTATION = 0.002, 0.006
NOISE = pose_covariance(POSITION, ORIENTATION)
SOME = ("rigid", "prismatic", "revolute", "planar", "free")


def data(model: kv.Model, frames: list[str], values: Array, seed: int) -> dict[str, Array]:
    """Return noisy poses of frames at values (N, n) of the degrees of freedom."""
    random, symbols = np.random.default_rng(seed), model.degrees_of_freedom
    compiled = [kv.compile(model.fk(frame), symbols, tier="interpreter") for frame in frames]
    return {
        frame: noisy(f.batch(values), POSITION, ORIENTATION, random)
        for frame, f in zip(frames, compiled, strict=True)
    }


def left(model: kv.Model, poses: dict[str, Array]) -> float:
    """Return χ² over its degrees of freedom, with the free coordinates that explain each observation best.

    Of every fourth observation; of 180 degrees of freedom in a ring of four, so chance makes it .7 to 1.3 in
    more than 99 % of all cases.
    """
    function = kv.compile([model.fk(frame) for frame in poses], model.degrees_of_freedom, tier="interpreter")
    lower, upper = np.transpose([limits_of(model, str(s)) for s in model.degrees_of_freedom])
    squares, count = 0.0, 0
    for k in range(0, len(next(iter(poses.values()))), 4):
        observed = np.array([track[k] for track in poses.values()])

        def errors(q: Array, observed: Array = observed) -> Array:
            poses = np.array(function(q)).reshape(-1, 4, 4)
            turned = Rotation.from_matrix(np.swapaxes(poses[:, :3, :3], 1, 2) @ observed[:, :3, :3])
            off = (observed[:, :3, 3] - poses[:, :3, 3]) / POSITION
            return np.concatenate([off, turned.as_rotvec() / ORIENTATION]).ravel()

        start = min(np.linspace(lower, upper, 9), key=lambda q: float(np.sum(errors(q) ** 2)))
        squares += 2.0 * least_squares(errors, start, bounds=(lower, upper)).cost
        count += 6 * len(poses) - len(start)
    return squares / count


def limits_of(model: kv.Model, name: str) -> tuple[float, float]:
    limits = model.constraints[f"{name}/position"]
    return float(limits.lower), float(limits.upper)


def connected(graph: KinematicGraph) -> set[frozenset[str]]:
    return {frozenset((e.parent, e.child)) for e in (*graph.edges, *graph.loops)}


def ring(*parts: str) -> set[frozenset[str]]:
    return {frozenset(ends) for ends in zip(parts, (*parts[1:], parts[0]), strict=True)}


def bar(
    edit: kv.model.Edit, name: str, parent: str, x: float, length: float, z: float = 0.0, **limits: float
) -> None:
    """Add a bar on a hinge with its sticker, and a frame at its end."""
    hinge = kv.model.Pose.from_matrix(kv.translation(x, 0, 0)())
    edit.apply(
        kv.Revolute(
            name=f"{name}_hinge", parent=parent, child=f"{name}_bar", origin=hinge, axis=(0, 0, 1), **limits
        )
    )
    sticker = kv.translation(0.4 * length, 0.02, z) @ kv.rpy(0.3, -0.5, 0.7)
    edit.add_frame(name, f"{name}_bar", sticker)
    edit.add_frame(f"{name}_end", f"{name}_bar", kv.translation(length, 0, 0))


def four_bar() -> kv.Model:
    """Return a crank and a rocker with a coupler between them, somewhere in space."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("stand", "world", kv.translation(0.3, -0.2, 0.5) @ kv.rpy(0.4, 1.1, -0.3))
        bar(edit, "crank", "stand", 0.0, 0.2, 0.05)
        bar(edit, "coupler", "crank_end", 0.0, 0.8)
        bar(edit, "rocker", "stand", 0.7, 0.6, 0.1)
        edit.close_loop("coupler_end", "rocker_end", mask=("x", "y"))
    return model


def slider_crank() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("stand", "world", kv.translation(0.3, -0.2, 0.5) @ kv.rpy(-0.4, 0.6, 0.8))
        bar(edit, "crank", "stand", 0.0, 0.2, 0.05)
        bar(edit, "rod", "crank_end", 0.0, 0.7)
        rail = kv.model.Pose.from_matrix(kv.translation(0.6, 0.05, 0)())
        edit.apply(
            kv.Prismatic(name="slide", parent="stand", child="block", origin=rail, lower=-0.5, upper=0.5)
        )
        edit.add_frame("slider", "block", kv.translation(0.1, 0, 0.05) @ kv.rpy(1.0, 0.2, 0.1))
        edit.close_loop("rod_end", "block", mask=("x", "y"), home={"crank_hinge": 1.0, "rod_hinge": -0.3})
    return model


def two_cylinders() -> kv.Model:
    """Return a crank with two rods, each with a slider on another rail."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", 0.0, 0.2, 0.05)
        for side, angle in (("left", 0.5), ("right", -0.9)):
            edit.add_frame(f"{side}_pin", "crank_bar", kv.rotation_z(angle) @ kv.translation(0.2, 0, 0))
            bar(edit, f"{side}_rod", f"{side}_pin", 0.0, 0.7)
            rail = kv.model.Pose.from_matrix((kv.rotation_z(angle) @ kv.translation(0.6, 0, 0))())
            slide = kv.Prismatic(
                name=f"{side}_slide", parent="world", child=side, origin=rail, lower=-0.5, upper=0.5
            )
            edit.apply(slide)
            edit.close_loop(
                f"{side}_rod_end", side, mask=("x", "y"), home={f"{side}_rod_hinge": 0, "crank_hinge": 0.3}
            )
    return model


def test_a_four_bar_is_closed_and_saved(tmp_path: Path) -> None:
    truth = four_bar()
    values = np.random.default_rng(0).uniform(0.0, 2.5, (40, 1))
    poses = data(truth, ["crank", "coupler", "rocker"], values, 1)
    graph = identify_graph(poses, noise=NOISE, families=SOME)
    assert connected(graph) == ring("world", "crank", "coupler", "rocker")
    # The joint that closes the loop is listed next to the tree, and leaves no doubt about it.
    assert all(edge.probability > 0.99 and not edge.alternatives for edge in graph.edges)
    model = kv.Model()
    with model.edit() as edit:
        for operation in graph.operations("learned"):
            edit.apply(operation)
    assert len(model.degrees_of_freedom) == 1
    assert 0.7 < left(model, {f"learned/{part}": track for part, track in poses.items()}) < 1.3
    assert len(graph.model(close=False).degrees_of_freedom) == 3
    model.save(tmp_path / "linkage.kv.json")
    again = kv.load(tmp_path / "linkage.kv.json")
    q = {str(again.degrees_of_freedom[0]): 0.2}
    assert np.array_equal(again.fk("learned/coupler")(q), model.fk("learned/coupler")(q))


def test_a_slider_crank_is_closed() -> None:
    values = np.random.default_rng(1).uniform(-3.1, 3.1, (40, 1))
    poses = data(slider_crank(), ["crank", "rod", "slider"], values, 2)
    graph = identify_graph(poses, noise=NOISE, families=SOME)
    assert connected(graph) == ring("world", "crank", "rod", "slider")
    model = graph.model()
    assert len(model.degrees_of_freedom) == 1
    assert 0.7 < left(model, poses) < 1.3


def test_a_loop_can_be_closed_at_each_of_its_joints() -> None:
    """Here it is a slider, which holds other components than a hinge."""
    values = np.random.default_rng(1).uniform(-1.2, 1.2, (40, 1))
    poses = data(slider_crank(), ["crank", "rod", "slider"], values, 2)
    known = {"world": exact_track(40), **check_tracks(poses, NOISE)}
    ends = [("world", "slider"), ("world", "crank"), ("crank", "rod"), ("rod", "slider")]
    closing, *others = (identify_pair(known, *both, SOME) for both in ends)
    assert closing is not None
    tree = {frozenset((joint.parent, joint.child)): joint for joint in others if joint is not None}
    directed = [("world", "crank"), ("crank", "rod"), ("rod", "slider")]
    way = [tree[frozenset(ends)] for ends in pairwise(tree_path(directed, "world", "slider"))]
    assert len(way) == 3
    ((_, plan),) = close_loops([ObservedLoop(closing, way)], way)
    assert plan is not None
    assert len(plan.mask) == 2
    model = kv.Model()
    with model.edit() as edit:
        for joint in tree.values():
            edit.apply(joint.result.best.operation(joint.child, joint.parent))
        for operation in plan.operations(str):
            edit.apply(operation)
    assert len(model.degrees_of_freedom) == 1
    assert 0.7 < left(model, poses) < 1.3


def test_loops_with_a_common_crank_are_both_closed() -> None:
    truth = two_cylinders()
    values = np.random.default_rng(2).uniform(0.7, 2.6, (50, 1))
    poses = data(truth, ["crank", "left_rod", "left", "right_rod", "right"], values, 3)
    graph = identify_graph(poses, noise=NOISE, families=SOME)
    assert connected(graph) == ring("world", "crank", "left_rod", "left") | ring(
        "world", "crank", "right_rod", "right"
    )
    model = graph.model()
    assert len(model.degrees_of_freedom) == 1
    assert 0.7 < left(model, poses) < 1.3


@pytest.mark.parametrize("family", sorted(CONSTRAINED_COMPONENTS))
def test_constrained_components_are_those_without_motion(family: str) -> None:
    random = np.random.default_rng(0)
    motion = GroupMotion(JOINT_FAMILIES[family], 6, np.eye(4), np.eye(4))
    poses = motion.linearise(random.normal(0.0, 0.5, (50, motion.joints))).pose
    turned = 0.5 * (poses - np.swapaxes(poses, 1, 2))
    components = [*poses[:, :3, 3].T, turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]]
    still = tuple(k for k, component in enumerate(components) if np.allclose(component, 0.0))
    assert still == CONSTRAINED_COMPONENTS[family]


def test_a_loop_of_balls_is_reported_and_left_open() -> None:
    truth = kv.Model()
    with truth.edit() as edit:
        bar(edit, "crank", "world", 0.0, 0.2)
        edit.add_frame("stand", "world", kv.translation(0.6, 0.2, 0.3) @ kv.rpy(1.3, 0.3, 0.2))
        bar(edit, "rocker", "stand", 0.0, 0.5)
        edit.apply(kv.articulations.Universal(name="ball", parent="crank_end", child="rod_bar"))
        edit.add_frame("rod", "rod_bar", kv.translation(0.3, 0.01, 0.02))
        edit.add_frame("rod_end", "rod_bar", kv.translation(0.6, 0, 0))
        edit.close_loop(
            "rod_end", "rocker_end", within={"crank_hinge": (-1.5, 1.5)}, home={"rocker_hinge": 1.5}
        )
    values = np.random.default_rng(0).uniform(-1.4, 1.4, (60, 1))
    poses = data(truth, ["crank", "rod", "rocker"], values, 0)
    graph = identify_graph(poses, noise=NOISE, families=("rigid", "revolute", "spherical", "planar", "free"))
    assert connected(graph) == ring("world", "crank", "rod", "rocker")
    with pytest.raises(kv.errors.ModelError, match="cannot depend on others, as those of a ball"):
        graph.model()
    assert {"crank", "rod", "rocker"} == set(graph.model(close=False).frames)


def test_coordinates_of_linked_loops_are_resolved() -> None:
    """Speeds that obey the equations of other loops give the same twist per independent coordinate."""
    random, times = np.random.default_rng(0), np.arange(7)

    def ring(names: str, some: Array) -> Ring:
        return Ring(
            np.eye(4), np.eye(4), "rigid", (*names,), some, random.normal(size=(len(some), 6, len(names)))
        )

    def closed(names: str, dependent: str, some: Array) -> ClosureEquations:
        return ClosureEquations(ring(names, some), [0], [*names], [dependent], some[0], some)

    # Half of it was observed only at some of the times, and another loop shares no coordinate.
    loops = [closed("abc", "b", times), closed("cda", "c", times[2:]), closed("xy", "x", times[:1])]
    one = ring("abcd", times)
    names, when, twists = resolve(one, loops)
    assert names == ["a", "d"]
    assert np.array_equal(when, times[2:])
    for k, time in enumerate(when):
        speeds = dict(zip("ad", random.normal(size=2), strict=True))
        rows = {x: np.zeros(4) for x in "bc"}
        for each, x in zip(loops, "bc", strict=False):
            at = np.searchsorted(each.times, time)
            rows[x][["abcd".index(y) for y in each.ring.names]] = each.ring.equations()[at, 0]
        a = np.array([*rows.values()])
        speeds |= dict(
            zip("bc", np.linalg.solve(a[:, 1:3], -a[:, [0, 3]] @ [speeds["a"], speeds["d"]]), strict=True)
        )
        assert np.allclose(
            one.twists[time] @ [speeds[x] for x in "abcd"], twists[k] @ [speeds["a"], speeds["d"]]
        )
