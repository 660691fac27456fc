"""Residuals of looks: values beside OpenCV and numpy, Jacobians beside finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calibration_cases import corrected

import kineverse as kv
from kineverse.estimation import ObservedExpression, ObservedPixel, ObservedPose, ObservedPosition
from kineverse.estimation.calibration.calibration import _make_blocks, _prepare
from kineverse.lie import Array, exp_so3, pose_difference, retract, transform

FOCAL = kv.parameter("focal", 500.0)
CENTRE = kv.parameter("centre", 320.0)
REACH = kv.parameter("reach", 0.4)
WORDS = ["offset *", "mount camera", "length upper", "axis elbow"]
FREE = [*WORDS, REACH]


def arm() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.Revolute(name="shoulder", parent="world", child="lower", axis=(0, 0, 1), lower=-2, upper=2)
        )
        edit.apply(
            kv.Fixed(name="upper", parent="lower", child="upper", origin=kv.translation(0.3, 0.1, 0.2))
        )
        edit.apply(kv.Revolute(name="elbow", parent="upper", child="fore", axis=(0, 1, 1), lower=-2, upper=2))
        edit.add_frame("tip", "fore", kv.translation(REACH, 0, 0.1))
        edit.add_frame("camera", "lower", kv.translation(0.1, 0.2, -1.5) @ kv.rpy(0.1, -0.1, 0.3))
    return model


MODEL = arm()
STATE = {"shoulder": 0.4, "elbow": -0.7}
SEEN = retract(
    np.asarray(MODEL.fk("tip", "camera")({**{kv.position(k): v for k, v in STATE.items()}, REACH: 0.4})),
    np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.15]),
)
PIXEL = ObservedPixel("tip", "camera", (100.0, 50.0), (0.01, 0.02, -0.03), (FOCAL, FOCAL), (CENTRE, 240.0))
OBSERVED: dict[str, Any] = {
    "pose": {("tip", "camera"): SEEN},
    "pose from the camera": {("camera", "tip"): np.linalg.inv(SEEN)},
    "position": {ObservedPosition("tip", (0.1, 0.2, 0.3), relative_to="camera"): SEEN[:3, 3]},
    "pixel": [PIXEL],
    "expression": [(ObservedExpression("dial", MODEL.fk("tip")[:2, 3], [1e-4, 1e-4]), [0.1, 0.2])],
}


def block_of(observations: Any) -> Any:
    free = [*FREE, FOCAL, CENTRE] if isinstance(observations, list) and PIXEL in observations else FREE
    (block,) = _make_blocks(MODEL, _prepare(MODEL, free), [(STATE, observations)])
    return block


@pytest.mark.parametrize("kind", OBSERVED)
def test_jacobians_equal_finite_differences(kind: str) -> None:
    block = block_of(OBSERVED[kind])
    rng = np.random.default_rng(4)
    values = np.array([s.value or rng.normal(0, 0.1) for s in block.parameters])
    jacobian = block.evaluate(values)[1][0]
    for k, symbol in enumerate(block.parameters):
        step = np.zeros(len(values))
        step[k] = 1e-5 * (symbol.value or 1.0)
        slope = (block.evaluate(values + step)[0] - block.evaluate(values - step)[0])[0] / (2 * step[k])
        # The Jacobian of large orientation residuals is a series.
        np.testing.assert_allclose(jacobian[:, k], slope, rtol=1e-3, atol=2e-4)
    assert jacobian.any(axis=0).all()


def test_residuals_are_those_of_the_corrected_model() -> None:
    prepared, rng = _prepare(MODEL, FREE), np.random.default_rng(5)
    values = {str(u.outer): float(rng.normal(0, 0.1)) for u in prepared.unknowns if u.unit}
    model = corrected(MODEL, WORDS, values)

    def value(expression: kv.Expression) -> Array:
        return np.asarray(expression({**{kv.position(k): v for k, v in STATE.items()}, REACH: 0.4}))

    def residual(kind: str) -> Array:
        block = block_of(OBSERVED[kind])
        result: Array = block.evaluate(np.array([values.get(str(s), s.value) for s in block.parameters]))[0][
            0
        ]
        return result

    pose = value(model.fk("tip", "camera"))
    np.testing.assert_allclose(residual("pose"), pose_difference(SEEN, pose), atol=1e-12)
    back = pose_difference(np.linalg.inv(SEEN), np.linalg.inv(pose))
    np.testing.assert_allclose(residual("pose from the camera"), back, atol=1e-12)
    np.testing.assert_allclose(
        residual("position"), SEEN[:3, 3] - (pose @ [0.1, 0.2, 0.3, 1])[:3], atol=1e-12
    )
    cv2 = pytest.importorskip("cv2")
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    image = cv2.projectPoints(np.array([PIXEL.point]), turn, pose[:3, 3], matrix, None)[0].ravel()
    np.testing.assert_allclose(residual("pixel"), np.array(PIXEL.pixel) - image, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.11, 3.0])
def test_a_mount_has_the_right_derivative_for_every_rotation(angle: float) -> None:
    """The chart of a mount is exp: at zero, and near it, the derivative is that of small rotations."""
    axis = np.array([0.6, -0.64, 0.48])
    block = block_of({("tip", "camera"): SEEN})
    names = [str(s) for s in block.parameters]
    values = np.array([s.value or 0.0 for s in block.parameters])
    columns = [names.index(f"camera/r{one}") for one in "xyz"]
    values[columns] = angle * axis
    twists = block.twists(values, block.poses(values))[0][:, columns]
    for k in range(3):
        step = np.zeros(len(values))
        step[columns[k]] = 1e-6
        slope = pose_difference(block.poses(values + step)[0], block.poses(values - step)[0]) / 2e-6
        np.testing.assert_allclose(twists[:, k], slope, atol=2e-8)


def test_looks_of_one_kind_share_a_block_and_missing_ones_are_left_out() -> None:
    looks = [(STATE, {("tip", "camera"): SEEN, "fore": np.eye(4)}), (STATE, {("tip", "camera"): SEEN})]
    blocks = {b.label: b for b in _make_blocks(MODEL, _prepare(MODEL, FREE), looks)}
    assert {label: b.looks.tolist() for label, b in blocks.items()} == {"tip in camera": [0, 1], "fore": [0]}


def test_stated_covariances_are_a_block_of_their_own() -> None:
    stated = ObservedPose("tip", relative_to="camera", covariance=(0.01, 0.02))
    looks = [(STATE, {stated: SEEN}), (STATE, {("tip", "camera"): SEEN})]
    blocks = _make_blocks(MODEL, _prepare(MODEL, FREE), looks)
    np.testing.assert_allclose(blocks[0].covariance, [np.diag([1e-4] * 3 + [4e-4] * 3)])
    assert blocks[1].covariance is None
    assert blocks[0].kernel is not None


NAN = np.full((4, 4), np.nan)
SHEAR = transform(exp_so3(np.zeros(3)) + 0.1, np.zeros(3))
BAD: list[tuple[Any, type[Exception], str]] = [
    (3, kv.errors.InvalidValueError, "Look 0 is a pair"),
    ((STATE, {}), kv.errors.InvalidValueError, "Look 0 has no observations"),
    ((STATE, 3), kv.errors.InvalidValueError, "are a mapping"),
    ((STATE, ["tip"]), kv.errors.InvalidValueError, "a pair \\(what, value\\)"),
    ((3, {"tip": SEEN}), kv.errors.InvalidValueError, "The state of look 0"),
    ((STATE, {"tp": SEEN}), kv.errors.UnknownNameError, "Did you mean 'tip'"),
    ((STATE, {("tip", "camra"): SEEN}), kv.errors.UnknownNameError, "Did you mean 'camera'"),
    ((STATE, {"tip": NAN}), kv.errors.InvalidValueError, "'tip' in look 0 is not finite"),
    ((STATE, {"tip": SHEAR}), kv.errors.InvalidValueError, "no rigid transform"),
    ((STATE, {"tip": [1, 2, 3]}), kv.errors.ShapeError, "A point is seen by ObservedPosition"),
    ((STATE, {"tip": "x"}), kv.errors.ShapeError, "no array of numbers"),
    ((STATE, {3: SEEN}), kv.errors.InvalidValueError, "observes names of frames"),
    ((STATE, {ObservedPosition("tip"): [1, 2]}), kv.errors.ShapeError, "three numbers"),
    ((STATE, {ObservedPosition("tip"): [1, 2, np.inf]}), kv.errors.InvalidValueError, "not finite"),
    ((STATE, [ObservedPixel("tip", "camera", (1, 2, 3))]), kv.errors.ShapeError, "pixel=\\(u, v\\)"),
    ((STATE, [ObservedPixel("tip", "camera", (1, np.nan))]), kv.errors.InvalidValueError, "not finite"),
    (({"shoulder": 1.0}, {"tip": SEEN}), kv.errors.UnknownNameError, "Look 0 has no value for 'elbow'"),
    (({**STATE, "elbw": 1.0}, {"tip": SEEN}), kv.errors.UnknownNameError, "Did you mean 'elbow'"),
    (({**STATE, "elbow": np.nan}, {"tip": SEEN}), kv.errors.InvalidValueError, "'elbow' is NaN"),
    (({**STATE, "elbow": np.inf}, {"tip": SEEN}), kv.errors.InvalidValueError, "not finite"),
    (({**STATE, "elbow": "x"}, {"tip": SEEN}), kv.errors.InvalidValueError, "not a number"),
]  # fmt: skip


@pytest.mark.parametrize(("look", "kind", "words"), BAD)
def test_wrong_looks_say_which_and_why(look: Any, kind: type[Exception], words: str) -> None:
    with pytest.raises(kind, match=words):
        _make_blocks(MODEL, _prepare(MODEL, FREE), [look])
