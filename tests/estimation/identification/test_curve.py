"""Motions along a curve that no joint family has, and joint values that lie on one curve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from synthetic_recordings import noisy, recording, transform

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.estimation import Identifier, identify, pose_covariance
from kineverse.estimation.identification.curve import CurveMotion, NaturalSpline, whiten_path
from kineverse.lie import log_so3

Array = npt.NDArray[np.float64]
POSITION, ORIENTATION = 0.004, 0.015
COVARIANCE = pose_covariance(POSITION, ORIENTATION)


def cosine(count: int, random: np.random.Generator) -> Array:
    """A part that follows one period of a cosine without turning."""
    t = np.sort(random.uniform(0.0, 1.0, count))
    places = np.stack([0.6 * t, 0.1 * np.cos(2.0 * np.pi * t), 0.0 * t], axis=1)
    return transform(Rotation.identity(count), places)


def garage_window(count: int, random: np.random.Generator) -> Array:
    """A window near the upper edge of a garage door: its point moves along an ellipse while it turns."""
    length, height, a = 2.0, 1.6, np.sort(random.uniform(0.1, 1.5, count))
    places = np.stack([height * np.sin(a), 0.3 + 0.0 * a, length + (height - length) * np.cos(a)], axis=1)
    return transform(Rotation.from_rotvec(a[:, None] * [0.0, 1.0, 0.0]), places)


def free_hand(count: int, random: np.random.Generator) -> Array:
    """A smooth random path of a hand, in the order of time."""
    waves = np.stack([np.cos(np.pi * k * np.linspace(0.0, 1.0, count)) / k for k in (1, 2, 3)], axis=1)
    rotations = Rotation.from_rotvec(waves @ random.normal(0.0, 0.4, (3, 3)))
    return transform(rotations, waves @ random.normal(0.0, 0.3, (3, 3)))


PATHS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "cosine": cosine,
    "garage window": garage_window,
    "free hand": free_hand,
}


def poses_along(path: str, seed: int, rows: int, count: int = 36) -> Array:
    random = np.random.default_rng(seed)
    poses = noisy(PATHS[path](count, random), POSITION, ORIENTATION, random)
    return poses if rows == 6 else poses[:, :3, 3]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("rows", [6, 3], ids=["poses", "positions"])
@pytest.mark.parametrize("path", PATHS)
def test_a_curve_is_never_identified_as_a_joint(path: str, rows: int) -> None:
    identified = identify(None, poses_along(path, 0, rows, count=24), noise=COVARIANCE)
    assert identified.is_ambiguous or identified.best.family == "curve"
    if path != "garage window":  # whose ellipse is nearly a circle
        assert identified.best.family == "curve"


@pytest.mark.parametrize(("path", "rows"), [("cosine", 3), ("free hand", 3)])
def test_a_curve_by_unknown_noise_is_never_identified_as_a_joint(path: str, rows: int) -> None:
    identified = identify(None, poses_along(path, 2, rows, count=16))
    assert identified.is_ambiguous or identified.best.family == "curve"


def test_identify_of_few_poses_along_a_curve_is_ambiguous() -> None:
    for path in ("cosine", "free hand"):
        identified = identify(None, poses_along(path, 2, 6, count=9), noise=COVARIANCE)
        assert identified.is_ambiguous or identified.best.family == "curve"


def test_a_curve_is_found_in_any_order_and_any_unit() -> None:
    data = poses_along("cosine", 3, 6, count=24)
    shuffled = np.random.default_rng(0).permutation(data)
    identified = identify(None, shuffled, noise=COVARIANCE)
    assert (identified.best.family, identified.is_ambiguous) == ("curve", False)
    assert identified.misfit == pytest.approx(1.0, abs=0.2)
    longer = shuffled.copy()
    longer[:, :3, 3] *= 100.0
    fit = identify(None, longer, noise=pose_covariance(100.0 * POSITION, ORIENTATION)).best
    np.testing.assert_allclose(fit.poses[:, :3, 3], longer[:, :3, 3], atol=4 * 100.0 * POSITION)
    np.testing.assert_allclose(np.ptp(fit.range), 100.0 * np.ptp(identified.best.range), rtol=0.05)


def test_a_curve_is_found_among_outliers() -> None:
    data, wrong = poses_along("cosine", 4, 6, count=20), [3, 11, 16]
    data[wrong, :3, 3] += [0.7, -0.5, 0.6]
    identified = identify(None, data, noise=COVARIANCE, outliers=True)
    assert identified.best.family == "curve"
    assert identified.best.outliers == tuple(wrong)


@pytest.mark.parametrize("rows", [6, 3])
def test_operation_of_a_curve_moves_as_its_fit(rows: int) -> None:
    fit = identify(None, poses_along("garage window", 5, rows), noise=COVARIANCE, families="curve").best
    model, open_model = kv.Model(), kv.Model()
    for made, limits in ((model, True), (open_model, False)):
        with made.edit() as edit:
            operation = fit.operation("door", "world", "window", as_point=True, limits=limits)
            edit.apply(operation, tag="learned")
    copy = kv.formats.from_bytes(kv.formats.to_bytes(model))
    for k in (0, 17, 35):
        values = {"door": float(fit.joint_values[k, 0])}
        np.testing.assert_allclose(model.fk("window")(values), fit.poses[k], atol=1e-9)
        np.testing.assert_allclose(copy.fk("window")(values), fit.poses[k], atol=1e-9)
        assert not model.violations(values)
    ((_, high),) = fit.range
    assert model.violations({"door": high + 0.1})
    assert not open_model.violations({"door": high + 0.1})
    if rows == 3:
        with pytest.raises(InvalidValueError, match="as_point"):
            fit.operation("door", "world", "window")


@pytest.mark.parametrize("rows", [6, 3])
def test_derivatives_of_a_curve_are_those_of_its_poses(rows: int) -> None:
    random = np.random.default_rng(6)
    turns = Rotation.from_rotvec(np.cumsum(random.normal(0.0, 0.4, (5, 3)), axis=0))
    quaternions = turns.as_quat() if rows == 6 else np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    quaternions *= np.where(np.sum(quaternions * quaternions[0], axis=1) < 0.0, -1.0, 1.0)[:, None]
    places = np.cumsum(random.normal(0.15, 0.1, (5, 3)), axis=0)
    whitening = whiten_path(transform(Rotation.from_quat(quaternions), places), rows)
    motion = CurveMotion.through(rows, NaturalSpline(0.3, 0.25, 5), places, quaternions, whitening)
    values = np.array([[0.1], [0.3], [0.5], [0.9], [1.3], [1.5]])
    linear, little = motion.linearise(values), 1e-6

    def difference(poses: Array) -> Array:
        moved = poses[:, :3, 3] - linear.pose[:, :3, 3]
        turned = log_so3(poses[:, :3, :3] @ np.swapaxes(linear.pose[:, :3, :3], 1, 2))
        return np.concatenate([moved, turned], axis=1)[:, :rows] / little

    by_joint = difference(motion.linearise(values + little).pose)
    np.testing.assert_allclose(by_joint, linear.by_joints[:, :, 0], atol=1e-4)
    for i in range(motion.size):
        moved = motion.retract(little * np.eye(motion.size)[i])
        np.testing.assert_allclose(
            difference(moved.linearise(values).pose), linear.by_parameters[:, :, i], atol=1e-4
        )


def test_other_families_keep_their_odds_beside_the_curve() -> None:
    data = recording("revolute", count=12, position=0.02, orientation=0.05, seed=5)
    families = ["rigid", "prismatic", "revolute", "screw", "cylindrical", "spherical", "planar", "free"]
    with_curve = identify(data.parent, data.child, noise=data.covariance).probabilities
    without = identify(data.parent, data.child, noise=data.covariance, families=families).probabilities
    for name in families:
        assert with_curve[name] / with_curve["revolute"] == pytest.approx(without[name] / without["revolute"])


def test_a_curve_takes_five_poses() -> None:
    data = poses_along("cosine", 7, 6, count=4)
    with pytest.raises(InvalidValueError, match="5 poses"):
        identify(None, data, noise=COVARIANCE, families="curve")
    assert "curve" not in identify(None, data, noise=COVARIANCE).probabilities
    with pytest.raises(InvalidValueError, match="not equal"):
        identify(None, np.tile(data[:1], (8, 1, 1)), families="curve")


def test_identifier_finds_the_curve_of_identify() -> None:
    data = np.random.default_rng(0).permutation(poses_along("cosine", 8, 6, count=22))
    identifier = Identifier(noise=COVARIANCE)
    for k, pose in enumerate(data, start=1):
        identifier.add(None, pose)
        if k in (20, 22):
            identified = identifier.result
            assert identified.best.family == "curve"
            assert len(identified.best.joint_values) == k
    whole = identify(None, data, noise=COVARIANCE)
    np.testing.assert_allclose(identified.best.poses[:, :3, 3], whole.best.poses[:, :3, 3], atol=3 * POSITION)
