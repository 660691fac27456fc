"""Every articulation against its formula, written out in numpy."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from articulation_checks import ORIGIN, WHERE, homogeneous, model_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.articulations import Joint, OneDofJoint

INF = float("inf")
AXES = [
    (0, 0, 1),
    (0, -1, 0),
    (2.0, 0, 0),
    (1, 2, 3),
    (-1e-9, 0, -1e-9),
    (0.1, -5, 0.3),
    (0, 1e-200, 0),
    (1e200, 1e200, 0),
]
numbers = st.floats(-4, 4)


def pose(operation: kv.Operation, **values: float) -> np.ndarray:
    at = {f"j/{name}" if name != "j" else name: value for name, value in values.items()}
    return model_of(operation).fk("c")(at)


def unit(axis: Any) -> np.ndarray:
    scaled = np.array(axis, dtype=float) / np.abs(axis).max()
    return scaled / np.linalg.norm(scaled)


def test_fixed_joint_pose() -> None:
    np.testing.assert_allclose(pose(kv.Fixed(**WHERE)), ORIGIN, atol=1e-15)
    model = model_of(kv.Fixed(**WHERE))
    assert not model.constraints
    assert model.symbols == ()
    assert model.articulations["j"].coordinates == ()


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("kind", [kv.Revolute, kv.Continuous])
def test_revolute_and_continuous_joint_pose(axis: Any, kind: type[kv.Revolute]) -> None:
    for q in (0.0, 0.7, -2.0, np.pi, 9.0):
        expected = ORIGIN @ homogeneous(Rotation.from_rotvec(unit(axis) * q))
        np.testing.assert_allclose(pose(kind(**WHERE, axis=axis), j=q), expected, atol=1e-14)


@pytest.mark.parametrize("axis", AXES)
def test_prismatic_joint_pose(axis: Any) -> None:
    for q in (0.0, 0.7, -2.0):
        expected = ORIGIN @ homogeneous(position=unit(axis) * q)
        np.testing.assert_allclose(pose(kv.Prismatic(**WHERE, axis=axis), j=q), expected, atol=1e-14)


@given(st.tuples(numbers, numbers, numbers).filter(lambda v: max(map(abs, v)) > 1e-3), numbers)
@settings(max_examples=attempts(40), derandomize=True)
def test_joint_pose_about_any_axis(axis: Any, q: float) -> None:
    expected = homogeneous(Rotation.from_rotvec(unit(axis) * q))
    where = {"name": "j", "parent": "world", "child": "c"}
    np.testing.assert_allclose(pose(kv.Revolute(**where, axis=axis), j=q), expected, atol=1e-13)
    np.testing.assert_allclose(pose(kv.Prismatic(**where, axis=axis), j=q)[:3, 3], unit(axis) * q, atol=1e-13)


@pytest.mark.parametrize(
    "axis", [*AXES, (0, 0, -1), (1e-8, 0, -1), (0, 1e-5, -1), (1e-13, 1e-13, -1), (1e-5, 0, 1)]
)
def test_planar_joint_pose(axis: Any) -> None:
    n, turn = unit(axis), np.diag([1.0, -1.0, -1.0])
    if n[:2].any() or n[2] > 0:
        # The smallest rotation from z to n.
        v = np.cross([0, 0, 1], n)
        angle = np.arctan2(np.linalg.norm(v), n[2])
        turn = Rotation.from_rotvec(v / np.linalg.norm(v) * angle if v.any() else v).as_matrix()
    for x, y, angle in ((0, 0, 0), (0.5, -2, 0.3), (1, 1, 4)):
        inside = homogeneous(Rotation.from_rotvec(n * angle), turn @ [x, y, 0])
        found = pose(kv.Planar(**WHERE, axis=axis), x=x, y=y, angle=angle)
        np.testing.assert_allclose(found, ORIGIN @ inside, atol=1e-13)


@given(
    st.tuples(numbers, numbers, numbers),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1),
)
@settings(max_examples=attempts(40), derandomize=True)
def test_floating_joint_pose(xyz: Any, q: Any) -> None:
    values = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*xyz, *q), strict=True))
    expected = ORIGIN @ homogeneous(Rotation.from_quat(q), xyz)
    np.testing.assert_allclose(pose(kv.Floating(**WHERE), **values), expected, atol=1e-13)


def test_floating_joint_angular_velocity_is_in_child_axes() -> None:
    model = model_of(kv.Floating(name="j", parent="world", child="c"))
    q = Rotation.from_euler("xyz", [0.4, 1.1, -2.0])
    at = {
        "j/x": 1,
        "j/y": 2,
        "j/z": 3,
        **dict(zip(("j/qx", "j/qy", "j/qz", "j/qw"), q.as_quat(), strict=True)),
    }
    speeds = [str(s) for s in model.speeds_of("c")]
    body = model.jacobian("c", form="body")(kv.State(at))
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(body[3:, speeds.index(f"j/w{name}:velocity")], np.eye(3)[axis], atol=1e-15)
        np.testing.assert_allclose(
            body[:3, speeds.index(f"j/{name}:velocity")], q.as_matrix()[axis], atol=1e-15
        )
    record = model.articulations["j"]
    assert (len(record.coordinates), len(record.speeds)) == (7, 6)
    assert record.home == (0, 0, 0, 0, 0, 0, 1)
    rate = [
        sum(row(kv.State(at)) * v for row, v in zip(model.rates[c].values(), (0.3, -0.7, 0.2), strict=True))
        for c in record.coordinates[3:]
    ]
    half = Rotation.from_rotvec(np.array([0.3, -0.7, 0.2]) * 1e-6)
    np.testing.assert_allclose(((q * half).as_quat() - q.as_quat()) / 1e-6, rate, atol=1e-6)


@pytest.mark.parametrize(
    "base",
    [kv.articulations.OmniBase(**WHERE), kv.articulations.DifferentialDrive(**WHERE, radius=0.1, track=0.5)],
)
def test_base_pose(base: Joint) -> None:
    for x, y, angle in ((0, 0, 0), (1, -2, 0.7), (3, 1, -4)):
        expected = ORIGIN @ homogeneous(Rotation.from_euler("z", angle), (x, y, 0))
        np.testing.assert_allclose(pose(base, x=x, y=y, angle=angle), expected, atol=1e-14)


def test_differential_drive_rates() -> None:
    r, b = 0.1, 0.5
    model = model_of(
        kv.articulations.DifferentialDrive(
            **{**WHERE, "origin": kv.model.Pose()}, radius=r, track=b, left="l", right="r", wheel_speed=3
        )
    )
    assert [str(s) for s in model.speeds] == ["l:velocity", "r:velocity"]
    angle = 0.8
    columns = model.jacobian("c")(kv.State({"j/x": 4, "j/y": 5, "j/angle": angle}))
    forward = [r / 2 * np.cos(angle), r / 2 * np.sin(angle), 0, 0, 0]
    np.testing.assert_allclose(columns.T, [[*forward, -r / b], [*forward, r / b]], atol=1e-15)
    assert [model.limits(s) for s in model.speeds] == [(-3, 3), (-3, 3)]


def test_omni_base_speed_limit_holds_in_every_direction() -> None:
    model = model_of(kv.articulations.OmniBase(name="j", parent="world", child="c", speed=1.0, turn=0.5))
    still = {"j/x": 30.0, "j/y": -40.0, "j/angle": 0.0}
    for direction in np.linspace(0, 6, 7):
        for speed, broken in ((0.99, []), (1.01, ["j/speed"])):
            moving = {"j/x:velocity": speed * np.cos(direction), "j/y:velocity": speed * np.sin(direction)}
            found = model.violations({**still, **moving, "j/angle:velocity": 0.4})
            assert [v.name for v in found] == broken
    assert model.limits("j/angle:velocity") == (-0.5, 0.5)
    assert not model_of(
        kv.articulations.OmniBase(name="j", parent="world", child="c", speed=None, turn=None)
    ).constraints


# -- limits --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kv.Revolute, kv.Continuous, kv.Prismatic])
def test_limits_become_position_and_velocity_constraints(kind: type[OneDofJoint]) -> None:
    def limits(**given: Any) -> dict[str, tuple[Any, ...]]:
        constraints = model_of(kind(**WHERE, **given)).constraints
        return {name: (c.lower, c.expression, c.upper) for name, c in constraints.items()}

    q = kv.position("j")
    assert limits() == {}
    assert limits(lower=-1, upper=2) == {"j/position": (-1, q, 2)}
    assert limits(lower=-1) == {"j/position": (-1, q, INF)}
    assert limits(upper=2, velocity=3) == {"j/position": (-INF, q, 2), "j/velocity": (-3, q.derivative(), 3)}
    assert limits(velocity=INF) == {}
    bolt = kv.position("bolt")
    assert limits(lower=bolt, upper=1 - bolt) == {"j/position": (bolt, q, 1 - bolt)}
    mimicked = limits(position=2 * bolt + 1, lower=-1, upper=2, velocity=3)
    assert mimicked == {"j/position": (-1, 2 * bolt + 1, 2), "j/velocity": (-3, 2 * bolt.derivative(), 3)}
    assert limits(position=kv.Expression(0.5), lower=0, upper=1, velocity=1) == {}


def test_mimic_joint_has_no_coordinate_of_its_own() -> None:
    bolt = kv.position("bolt")
    model = model_of(kv.Revolute(**WHERE, axis=(0, 0, 1), position=bolt**2))
    assert model.symbols == (bolt,)
    assert model.articulations["j"].coordinates == ()
    expected = ORIGIN @ homogeneous(Rotation.from_euler("z", 0.49))
    np.testing.assert_allclose(model.fk("c")({"bolt": 0.7}), expected, atol=1e-14)
    assert model_of(kv.Prismatic(**WHERE, position=bolt)).articulations["j"].coordinates == ()


def test_planar_joint_limits() -> None:
    model = model_of(kv.Planar(**WHERE, lower=-1, upper=2, velocity=3))
    assert model.limits("j/x") == model.limits("j/y") == (-1, 2)
    assert model.limits("j/x:velocity") == model.limits("j/y:velocity") == (-3, 3)
    assert model.limits("j/angle") == (-INF, INF)


# -- bad input -----------------------------------------------------------------------------------------

BROKEN: list[tuple[type[Joint], dict[str, Any], str]] = [
    *(
        (kind, {"axis": axis}, words)
        for kind in (kv.Revolute, kv.Continuous, kv.Prismatic, kv.Planar)
        for axis, words in (
            ((0, 0, 0), "length zero"),
            ((0, 0), "three numbers"),
            ((0, 0, float("nan")), "no direction"),
            ((0, float("inf"), 1), "no direction"),
            ("xyz", "three numbers"),
            (None, "three numbers"),
            (1.0, "three numbers"),
        )
    ),
    (kv.Revolute, {"lower": 1, "upper": -1}, "No value lies between"),
    (kv.Revolute, {"lower": float("nan")}, "NaN"),
    (kv.Revolute, {"velocity": -1}, "negative"),
    (kv.Revolute, {"velocity": float("nan")}, "negative"),
    (kv.Revolute, {"name": ""}, "path"),
    (kv.Revolute, {"name": "a//b"}, "empty part"),
    (kv.Fixed, {"name": "a//b"}, "not a name"),
    (kv.Fixed, {"child": "world"}, "root of everything"),
    (kv.Fixed, {"child": "/c"}, "not a name"),
    (kv.Fixed, {"child": ""}, "The child of the fixed 'j' is a path"),
    (kv.Fixed, {"child": 3}, "path like .*, not 3"),
    (kv.Fixed, {"parent": "nowhere"}, "There is no frame 'nowhere'"),
    (kv.Fixed, {"parent": "c"}, "Cyclic frames"),
    (kv.Fixed, {"parent": None}, "The parent of the fixed 'j' is a path"),
    (kv.Fixed, {"parent": ["world"]}, "path like .*, not .'world'"),
    (kv.Fixed, {"origin": np.zeros((4, 4))}, "rigid"),
    (kv.Fixed, {"origin": np.full((4, 4), np.nan)}, "rigid"),
    (kv.Fixed, {"origin": np.diag([1.0, 1, -1, 1])}, "rigid"),
    (kv.Fixed, {"origin": np.diag([2.0, 2, 2, 1])}, "rigid"),
    (kv.Fixed, {"origin": np.eye(3)}, "The origin of the fixed 'j' is not a pose. .* 4×4"),
    (kv.Fixed, {"origin": kv.position("x")}, "The origin of the fixed 'j' is not a pose. .* 4×4"),
    (kv.Planar, {"lower": 1, "upper": 0}, "No value lies between"),
    (
        kv.articulations.OmniBase,
        {"speed": -1.0},
        "'speed' of the omni base 'j' is -1.0; it cannot be negative",
    ),
    (kv.articulations.OmniBase, {"turn": -1.0}, "negative"),
    (kv.articulations.OmniBase, {"turn": float("nan")}, "is nan; it cannot be negative"),
    (
        kv.articulations.DifferentialDrive,
        {"radius": 0, "track": 1},
        "radius of the differential drive 'j' is a positive",
    ),
    (
        kv.articulations.DifferentialDrive,
        {"radius": 1, "track": float("nan")},
        "track .* is a positive, finite number, not nan",
    ),
    (kv.articulations.DifferentialDrive, {"radius": 1, "track": 1, "wheel_speed": -1}, "negative"),
]


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_joint_raises_and_leaves_the_model_unchanged(
    kind: type[Joint], given: dict[str, Any], words: str
) -> None:
    model = model_of(kv.Fixed(name="old", parent="world", child="old"))
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(kind(**{**WHERE, **given}))
    assert model.snapshot() == before


# -- values --------------------------------------------------------------------------------------------

EVERY = [
    kv.Fixed(**WHERE),
    kv.Revolute(**WHERE, axis=(1, 2, 3), lower=0, upper=kv.position("bolt"), velocity=1),
    kv.Continuous(**WHERE),
    kv.Prismatic(**WHERE, position=2 * kv.position("bolt")),
    kv.Planar(**WHERE, axis=(0, 1, 0)),
    kv.Floating(**WHERE),
    kv.articulations.OmniBase(**WHERE),
    kv.articulations.DifferentialDrive(**WHERE, radius=0.1, track=0.5),
]


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
def test_articulations_are_hashable_values(operation: Any) -> None:
    for other in (copy.copy(operation), copy.deepcopy(operation), pickle.loads(pickle.dumps(operation))):
        assert other == operation
        assert hash(other) == hash(operation)
    assert operation.default_tag() == "joint j"
    with pytest.raises(AttributeError):
        operation.name = "k"
    assert [o for o in EVERY if o == operation] == [operation]
    model = model_of(operation)
    record = model.articulations["j"]
    assert record.kind == type(operation).__name__.lower()
    assert (record.parent, record.child) == ("world", "c")
    assert set(record.coordinates) <= set(model.degrees_of_freedom)
    assert set(record.speeds) <= set(model.speeds)
    assert pickle.loads(pickle.dumps(model)).snapshot() == model.snapshot()


def test_axes_and_origins_given_as_arrays_are_hashable() -> None:
    given = kv.Revolute(name="j", parent="world", child="c", axis=np.array([0, 0, 2]), origin=ORIGIN)
    assert given == kv.Revolute(
        name="j", parent="world", child="c", axis=(0.0, 0.0, 2.0), origin=kv.model.Pose.from_matrix(ORIGIN)
    )
    assert hash(given) == hash(pickle.loads(pickle.dumps(given)))


def test_custom_articulation_in_ten_lines() -> None:
    class Door(kv.Operation):
        """A garage door: its lower edge rises while it turns."""

        name = "garage"

        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            q = kv.position(self.name)
            lift = kv.translation(0, 0, 2 - q) @ kv.rotation_y(np.arccos(q / 2))
            return kv.model.Writes(
                frames={self.name: ("world", lift)}, constraints={f"{self.name}/range": (0, q, 2)}
            )

    model = model_of(Door())
    assert model.history.tags == ["door garage"]
    np.testing.assert_allclose(model.fk("garage")({"garage": 1.0})[:3, 3], [0, 0, 1])
    assert list(model.constraints_for(model.fk("garage"))) == ["garage/range"]
