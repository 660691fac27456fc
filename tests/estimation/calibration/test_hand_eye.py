"""Free mounts: closed form from nonsense, and the whole calibration beside OpenCV's five methods."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_cases import hand_eye, random_pose

import kineverse as kv
from kineverse.estimation import calibrate
from kineverse.estimation.calibration.calibration import _make_blocks, _prepare
from kineverse.estimation.calibration.hand_eye import _align, _average, start_mounts
from kineverse.lie import Array, inverse, pose_difference, retract, transform

MOUNTS = ["mount eye", "mount marker"]
METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")


def test_mounts_of_exact_poses_are_found_from_any_start() -> None:
    rng = np.random.default_rng(1)
    middle = np.stack([random_pose(rng) for _ in range(12)])
    x, y = random_pose(rng), random_pose(rng)
    for found, wanted in zip(_align(x @ middle @ y, middle), (x, y), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-10)
    np.testing.assert_allclose(_average(np.stack([x] * 4))[0], x, atol=1e-12)


def test_gross_errors_hardly_move_the_start() -> None:
    rng = np.random.default_rng(2)
    middle = np.stack([random_pose(rng) for _ in range(40)])
    x, y = random_pose(rng), random_pose(rng)
    seen = retract(x @ middle @ y, rng.normal(0, 0.003, (40, 6)))
    seen[:8] = [random_pose(rng) for _ in range(8)]
    for found, wanted in zip(_align(seen, middle), (x, y), strict=True):
        assert np.abs(pose_difference(found, wanted)).max() < 0.1
    poses = retract(np.stack([x] * 20), rng.normal(0, 0.003, (20, 6)))
    poses[:6] = [random_pose(rng) for _ in range(6)]
    assert np.abs(pose_difference(_average(poses)[0], x)).max() < 0.05


@pytest.mark.parametrize(
    "free", [MOUNTS, MOUNTS[:1], MOUNTS[1:], [MOUNTS[0], "mount marker", "offset *joint4"]]
)
def test_the_start_is_found_wherever_the_mounts_stand(free: list[str]) -> None:
    """One mount or two, before or behind the joints, of the camera (by its inverse) or of the marker."""
    case = hand_eye(np.random.default_rng(3), 12, 1.0)
    truth = case.model.copy()
    calibrate(truth, case.looks, MOUNTS).apply(truth)
    model = truth.copy()
    with model.edit() as edit:
        rng = np.random.default_rng(4)
        for text in free:
            if text.startswith("mount"):
                frame = model.frames[text.removeprefix("mount ")]
                edit.replace(
                    f"frame {text.removeprefix('mount ')}", moved(text, frame.parent, random_pose(rng))
                )
    prepared = _prepare(model, free)
    (block,) = _make_blocks(model, prepared, case.looks)
    inner = [unknown.inner for unknown in prepared.unknowns]
    columns = [inner.index(s) for s in block.parameters]
    mounts = [[inner.index(s) for s in c.symbols] for c in prepared.corrections if c.word == "mount"]
    start = start_mounts([(block, columns)], mounts, np.zeros(len(inner)))
    residual = block.evaluate(start[columns])[0]
    assert np.sqrt(np.mean(residual[:, :3] ** 2)) < 0.006
    assert np.sqrt(np.mean(residual[:, 3:] ** 2)) < 0.02


def moved(text: str, parent: str, pose: Array) -> kv.Operation:
    return kv.model.AddFrame(text.removeprefix("mount "), kv.model.Frame.from_transform(parent, pose))


def hand_eye_errors(seeds: range, count: int, spread: float) -> dict[str, Array]:
    """Return the errors of the camera's pose in the hand by method, (draws, 2) [m], [rad]."""
    cv2 = pytest.importorskip("cv2")
    errors: dict[str, list[tuple[float, float]]] = {method: [] for method in (*METHODS, "ours")}
    for seed in seeds:
        case = hand_eye(np.random.default_rng(seed), count, spread)
        result = calibrate(case.model, case.looks, MOUNTS, held_out=0)
        result.apply(case.model)
        found = {"ours": case.model.frames["eye"].transform({})}
        seen = [look["marker", "eye"] for _, look in case.looks]
        parts = [[m[:3, :3] for m in case.hands], [m[:3, 3] for m in case.hands]]
        parts += [[m[:3, :3] for m in seen], [m[:3, 3] for m in seen]]
        for method in METHODS:
            flag = getattr(cv2, f"CALIB_HAND_EYE_{method}")
            rotation, position = cv2.calibrateHandEye(*parts, method=flag)
            found[method] = transform(rotation, position.ravel())
        for method, pose in found.items():
            difference = pose_difference(np.asarray(pose), case.camera)
            errors[method].append(
                (float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:])))
            )
    return {method: np.array(sizes) for method, sizes in errors.items()}


SETTINGS = [(30, 1.0), (10, 1.0), (30, 0.25), (10, 0.25)]


@pytest.mark.parametrize(("count", "spread"), SETTINGS[:3:2])
def test_hand_eye_beats_opencv_from_any_start(count: int, spread: float) -> None:
    check_hand_eye(range(3), count, spread)


@pytest.mark.long
@pytest.mark.parametrize(("count", "spread"), SETTINGS)
def test_hand_eye_beats_opencv_in_a_hundred_draws(count: int, spread: float) -> None:
    check_hand_eye(range(100, 200), count, spread)


def check_hand_eye(seeds: range, count: int, spread: float) -> None:
    sizes = {
        method: np.sqrt(np.mean(np.square(errors), axis=0))
        for method, errors in hand_eye_errors(seeds, count, spread).items()
    }
    for method in METHODS:
        assert (sizes["ours"] < sizes[method]).all(), (method, sizes)


def test_the_result_does_not_depend_on_the_start() -> None:
    case = hand_eye(np.random.default_rng(6), 15, 0.6)
    poses = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        model = case.model.copy()
        with model.edit() as edit:
            for text in MOUNTS:
                name = text.removeprefix("mount ")
                edit.replace(f"frame {name}", moved(text, model.frames[name].parent, random_pose(rng)))
        calibrate(model, case.looks, MOUNTS).apply(model)
        poses.append(np.asarray(model.frames["eye"].transform({})))
    for pose in poses[1:]:
        assert np.abs(pose_difference(pose, poses[0])).max() < 1e-5


def test_a_single_mount_and_a_marker_of_two_cameras_are_told() -> None:
    """Two cameras see one marker; all three mounts are free, and one of each pair of unknowns is found first."""
    case = hand_eye(np.random.default_rng(7), 15, 0.8)
    model = case.model.copy()
    hand = model.frames["eye"].parent
    rng = np.random.default_rng(8)
    second = random_pose(rng)
    with model.edit() as edit:
        edit.add_frame("second", hand, random_pose(rng))
    looks = []
    for state, seen in case.looks:
        marker = seen["marker", "eye"]
        looks.append((state, {**seen, ("marker", "second"): inverse(second) @ case.camera @ marker}))
    calibrate(model, looks, [*MOUNTS, "mount second"]).apply(model)
    for frame, wanted in (("eye", case.camera), ("second", second)):
        found = np.asarray(model.frames[frame].transform({}))
        assert np.abs(pose_difference(found, wanted)).max() < 0.01
