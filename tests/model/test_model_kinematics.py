"""Poses compose, and Jacobians are what poses do when things move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from random_models import random_pose, random_speeds, random_state, random_tree, twist_between
from scipy.spatial.transform import Rotation

import kineverse as kv

SEEDS = range(4)
x, y = kv.position("x"), kv.position("y")


def numeric(model: kv.Model, frame: str, values: dict[kv.Symbol, float]) -> np.ndarray:
    """Return world_T_frame by multiplying numbers."""
    pose = np.eye(4)
    while frame != "world":
        pose, frame = model.frames[frame].transform(values) @ pose, model.frames[frame].parent
    return pose


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_in_all_directions_equal_products_of_numbers(seed: int) -> None:
    model = random_tree(seed, 11)
    values = random_state(model, seed)
    names = ["world", *model.frames]
    poses = {name: numeric(model, name, values) for name in names}
    for tip in names:
        for base in names[seed % 2 :: 2]:
            expected = np.linalg.inv(poses[base]) @ poses[tip]
            np.testing.assert_allclose(model.fk(tip, base)(values), expected, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_jacobians_are_the_twists_of_poses_along_every_speed(seed: int) -> None:
    model, rng = random_tree(seed, 10), np.random.default_rng(seed)
    state, h = kv.State(random_state(model, seed)), 1e-5
    names = ["world", *model.frames]
    pairs = [(names[-1], "world"), *((names[i], names[j]) for i, j in rng.integers(0, len(names), (5, 2)))]
    speeds = random_speeds(model, seed)
    forth, back = model.integrate(state, speeds, h), model.integrate(state, speeds, -h)
    for tip, base in pairs:
        columns, fk = model.speeds_of(tip, base), model.fk(tip, base)
        pose, before, after = fk(state), fk(back), fk(forth)
        expected = twist_between(before, after, 2 * h)
        velocity = np.array([speeds[s] for s in columns])
        aligned, world, body = (
            model.jacobian(tip, base, form=form) for form in ("world_aligned", "world", "body")
        )
        assert aligned.shape == world.shape == body.shape == (6, len(columns))
        np.testing.assert_allclose(aligned(state) @ velocity, expected, atol=1e-8)
        rotation = np.kron(np.eye(2), pose[:3, :3])
        np.testing.assert_allclose(rotation @ body(state), aligned(state), atol=1e-12)
        spatial = aligned(state).copy()
        spatial[:3] += np.cross(pose[:3, 3], spatial[3:], axisb=0).T if len(columns) else 0
        np.testing.assert_allclose(world(state), spatial, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_jacobians_agree_with_the_gradient_of_the_pose_column_by_column(seed: int) -> None:
    model = random_tree(seed, 10)
    values, names = random_state(model, seed + 50), list(model.frames)
    for tip, base in (
        (names[-1], "world"),
        (names[-1], names[0]),
        (names[3], names[-2]),
        ("world", names[-1]),
    ):
        fk = model.fk(tip, base)
        gradient, columns = fk.gradient(heuristic=False), model.speeds_of(tip, base)
        assert set(gradient) <= set(columns)
        matrix, rotation = model.jacobian(tip, base)(values), fk(values)[:3, :3]
        for i, speed in enumerate(columns):
            entry = gradient[speed](values) if speed in gradient else np.zeros((4, 4))
            spin = entry[:3, :3] @ rotation.T
            expected = [*entry[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]]
            np.testing.assert_allclose(matrix[:, i], expected, atol=1e-12)
            np.testing.assert_allclose(spin, -spin.T, atol=1e-12)


def test_columns_may_be_chosen_by_position_or_speed() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", "world", [kv.translation(x, 0, 0), kv.rotation_z(y)])
    every = model.jacobian("f")
    assert model.speeds_of("f") == (x.derivative(), y.derivative())
    assert model.jacobian("f", symbols=[x, y]) == every
    chosen = model.jacobian("f", symbols=[y.derivative(), kv.position("other"), x])({"x": 0, "y": 0})
    np.testing.assert_array_equal(chosen, [[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]])
    assert model.jacobian("f", symbols=[]).shape == (6, 0)
    assert model.jacobian("world").shape == (6, 0)
    with pytest.raises(kv.errors.ExpressionError):
        model.jacobian("f", symbols=["x"])
    with pytest.raises(kv.errors.UnknownNameError, match="forms are"):
        model.jacobian("f", form="sideways")


def test_heuristic_entries_only_count_when_asked_for() -> None:
    model = kv.Model()
    trend = x.augment({y.derivative(): 2.0}, heuristic=True)
    with model.edit() as edit:
        edit.add_frame("f", "world", kv.translation(trend, 0, 0))
    assert model.jacobian("f").shape == (6, 1)
    assert model.jacobian("f", heuristic=True)({"x": 0, "y": 0})[0].tolist() == [1, 2]


def test_a_fact_that_is_overridden_shows_in_the_jacobian() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("f", "world", [kv.rotation_z(x), kv.translation(y.augment({y.derivative(): x}), 0, 0)])
    at = kv.State({"x": 0.5, "y": 2.0})
    expected = model.fk("f").gradient()[y.derivative()](at)[:2, 3]
    np.testing.assert_allclose(model.jacobian("f")(at)[:2, 1], expected)
    np.testing.assert_allclose(expected, [0.5 * np.cos(0.5), 0.5 * np.sin(0.5)])


# -- the tree of frames --------------------------------------------------------------------------------


def cupboard() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("table", "world", kv.translation(2, 0, 0))
        edit.add_frame("box", "table", kv.translation(0, 0, 1))
        edit.apply(kv.Revolute(name="lid", parent="box", child="box/lid", axis=(0, 1, 0), lower=0, upper=2))
        edit.add_frame("arm", "world", kv.rotation_z(y))
        edit.add_frame("gripper", "arm", kv.translation(1, 0, 0))
    return model


def test_an_attached_frame_keeps_its_articulation() -> None:
    model = cupboard()
    with model.edit() as edit:
        edit.attach("box", "gripper", kv.translation(0, 0, 0.1))
    at = kv.State({"y": 0.4, "lid": 0.7})
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_euler("ZY", [0.4, 0.7]).as_matrix()
    expected[:3, 3] = [np.cos(0.4), np.sin(0.4), 0.1]
    np.testing.assert_allclose(model.fk("box/lid")(at), expected, atol=1e-15)
    assert list(model.constraints_for(model.fk("box/lid"))) == ["lid/position"]
    assert model.history.writers("frames/box") == ["frame box", "attach box to gripper"]
    with model.edit() as edit:
        edit.remove("attach box to gripper")
    assert model.fk("box/lid")(at)[0, 3] == 2


@pytest.mark.parametrize("parent", ["box/lid", "box", "table"])
def test_frames_in_a_circle_are_refused_when_attached(parent: str) -> None:
    model = cupboard()
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match="Cyclic frames"), model.edit() as edit:
        edit.attach("table", parent, np.eye(4))
    assert model.snapshot() == before
    assert model.fk("box/lid")({"lid": 0})[0, 3] == 2


def test_a_cycle_of_frames_is_refused_by_the_edit_that_closes_it() -> None:
    model = cupboard()
    before = model.snapshot()
    with model.edit() as edit:
        edit.attach("table", "gripper", np.eye(4))
    with (
        pytest.raises(kv.errors.EditError, match=r"'attach arm to box': Cyclic frames"),
        model.edit() as edit,
    ):
        edit.attach("arm", "box", np.eye(4))
    with pytest.raises(kv.KineverseError), model.edit() as edit:
        edit.replace("frame table", kv.Fixed(name="t", parent="box", child="table"))
    with model.edit() as edit:
        edit.remove("attach table to gripper")
    assert model.snapshot() == before
    # a circle in between is one, though the next operation would undo it
    with (
        pytest.raises(kv.errors.EditError, match="'attach table to box': Cyclic frames: "),
        model.edit() as edit,
    ):
        edit.attach("table", "box", np.eye(4))
        edit.attach("table", "world", np.eye(4), tag="back")
    assert model.snapshot() == before
    assert model.fk("box")()[:3, 3].tolist() == [2, 0, 1]


def test_a_chain_of_five_thousand_frames() -> None:
    n = 5_000
    step = kv.model.Pose((1, 0, 0, 0, 0, 1, 0, 1e-3, 0, 0, 1, 0))
    model = kv.Model()
    with model.edit() as edit:
        for i in range(n):
            moving = kv.translation(0, kv.position(f"q{i % 5}"), 0)
            edit.add_frame(f"f{i}", f"f{i - 1}" if i else "world", step if i % 100 else moving)
    at = kv.State({f"q{i}": 0.5 for i in range(5)})
    last = f"f{n - 1}"
    expected = 50 * 0.5 + 1e-3 * (n - 50)
    assert model.fk(last)({"q0": 0.5})[1, 3] == pytest.approx(expected)
    assert model.fk("f3", last)(at)[1, 3] == pytest.approx(-expected + 0.5 + 3e-3)
    assert model.jacobian(last)(at)[1].tolist() == [50]
    assert model.speeds_of(last) == (kv.velocity("q0"),)
    with model.edit() as edit:
        edit.replace("frame f0", kv.Fixed(name="f0", parent="world", child="f0"))
    assert model.fk(last)({"q0": 0.5})[1, 3] == pytest.approx(expected - 0.5)
    before = model.version
    with pytest.raises(kv.KineverseError, match="Cyclic frames"), model.edit() as edit:
        edit.attach("f0", last, np.eye(4))
    with pytest.raises(kv.errors.EditError, match="parent of frame 'f2501' is missing"), model.edit() as edit:
        edit.remove("frame f2500")
    assert model.version == before


def test_a_chain_of_thousands_of_moving_frames() -> None:
    n = 1000
    step = kv.model.Pose((1, 0, 0, 1e-3, 0, 1, 0, 0, 0, 0, 1, 0))
    model = kv.Model()
    with model.edit() as edit:
        for i in range(n):
            parent = f"f{i - 1}" if i else "world"
            edit.apply(kv.Revolute(name=f"q{i}", parent=parent, child=f"f{i}", axis=(0, 0, 1), origin=step))
    last = f"f{n - 1}"
    at = kv.State({f"q{i}": 0.0 for i in range(n)})
    assert model.fk(last)(at)[0, 3] == pytest.approx(n * 1e-3)
    jacobian = model.jacobian(last)(at)
    by_name = dict(zip(map(str, model.speeds_of(last)), jacobian.T, strict=True))
    assert by_name["q0:velocity"].tolist() == pytest.approx([0, (n - 1) * 1e-3, 0, 0, 0, 1])


def test_frames_placed_by_several_factors_or_one_matrix_are_the_same() -> None:
    pose, model = random_pose(np.random.default_rng(3)), kv.Model()
    with model.edit() as edit:
        edit.add_frame("product", "world", [pose, kv.rotation_z(x), kv.translation(y, 0, 0), pose])
        edit.add_frame("matrix", "world", model.fk("product"))
        edit.add_frame("rows", "world", [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])
    at = {"x": 0.3, "y": 0.4}
    np.testing.assert_allclose(model.fk("product")(at), model.fk("matrix")(at), atol=1e-15)
    np.testing.assert_allclose(model.jacobian("product")(at), model.jacobian("matrix")(at), atol=1e-14)
    assert model.fk("rows")(at)[:2, 3].tolist() == [0.3, 0.4]
    np.testing.assert_allclose(model.frames["product"].transform(at), model.fk("product")(at), atol=1e-15)


def test_editing_a_joint_changes_only_the_frames_below() -> None:
    model = cupboard()
    arm, lid = model.fk("gripper"), model.fk("box/lid")
    model.jacobian("box/lid")
    with model.edit() as edit:
        edit.replace("joint lid", kv.Prismatic(name="lid", parent="box", child="box/lid", axis=(0, 1, 0)))
    assert model.fk("gripper") == arm
    assert model.fk("box/lid") != lid
    assert model.fk("box/lid")({"lid": 0.5})[1, 3] == 0.5
    assert model.jacobian("box/lid")({"lid": 0.5}).T.tolist() == [[0, 1, 0, 0, 0, 0]]


# -- operations with several frames --------------------------------------------------------------------


@dataclass(frozen=True)
class Chain(kv.Operation):
    """Frames one below the other, in any order."""

    parents: tuple[tuple[str, str], ...]

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(
            frames={name: (above, kv.translation(1, 0, 0)) for name, above in self.parents}
        )


def test_an_operation_may_write_frames_below_its_own() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Chain((("c", "b"), ("b", "a"), ("a", "world"))), tag="chain")
        edit.add_frame("d", parent="c", transform=kv.translation(0, 1, 0))
    assert model.fk("d")()[:3, 3].tolist() == [3, 1, 0]
    with model.edit() as edit:
        edit.attach("b", parent="world", transform=kv.translation(0, 0, 5))
    assert model.fk("d")()[:3, 3].tolist() == [1, 1, 5]
    with model.edit() as edit:
        edit.remove("attach b to world")
        edit.replace("chain", Chain((("c", "world"),)))
    assert sorted(model.frames) == ["c", "d"]


@pytest.mark.parametrize(
    ("parents", "words"),
    [
        ((("a", "b"), ("b", "a")), "Cyclic frames: 'a' would be its own parent"),
        ((("a", "a"),), "Cyclic frames: 'a' would be its own parent"),
        ((("a", "b"), ("b", "c"), ("c", "b")), "Cyclic frames: 'b' would be its own parent"),
        ((("a", "b"), ("b", "nowhere")), "parent of frame 'b' is missing. There is no frame 'nowhere'"),
    ],
)
def test_fk_of_a_detached_frame_is_refused(parents: tuple[tuple[str, str], ...], words: str) -> None:
    model = kv.Model()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(Chain(parents))
    assert not model.frames


def test_a_frame_without_a_transform_is_where_its_parent_is() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("door", "world", kv.translation(1, 2, 3))
        edit.add_frame("handle", parent="door")
    assert np.array_equal(model.fk("handle")(), model.fk("door")())
    assert kv.formats.from_bytes(kv.formats.to_bytes(model)).snapshot() == model.snapshot()
