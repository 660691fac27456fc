"""Files of a calibrated model: documents hold all of it, a URDF its origins and axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import DifferentialDrive
from kineverse.errors import FormatError, InvalidValueError
from kineverse.estimation import Calibration, WheelOdometry, calibrate
from kineverse.formats import operation_to_bytes
from kineverse.formats.reader_warnings import collect_warnings

pin = pytest.importorskip("pinocchio")

FREE = [
    "offsets pr2/r_elbow_flex_joint",
    "axis pr2/r_wrist_flex_joint",
    "mount pr2/r_forearm_joint",
    "mount cup",
]
TIP, HEAD = "pr2/r_gripper_tool_frame", "pr2/head_tilt_link"


@pytest.fixture(scope="module")
def pr2() -> kv.Model:
    model = kv.load("pr2")
    with model.edit() as edit:
        edit.add_frame("cup", parent=TIP)
    return model


@pytest.fixture(scope="module")
def found(pr2: kv.Model) -> Calibration:
    rng = np.random.default_rng(0)
    seen = pr2.fk("cup", relative_to="pr2/torso_lift_link")
    error = (kv.translation(0.01, 0.02, 0) @ kv.rpy(0.02, 0.01, -0.03))()
    looks = []
    for q in rng.uniform(-0.5, 0.5, (15, len(seen.symbols))):
        state = dict(zip(seen.symbols, q.tolist(), strict=True))
        looks.append((state, {("cup", "pr2/torso_lift_link"): error @ seen(state)}))
    return calibrate(pr2, looks, FREE, held_out=0)


def corrected(model: kv.Model, found: Calibration) -> kv.Model:
    result = model.copy()
    found.apply(result)
    return result


def test_a_document_has_all(pr2: kv.Model, found: Calibration, tmp_path: Path) -> None:
    saved = found.save(tmp_path / "pr2.kv.json")
    assert saved.remarks == ()
    again, model = kv.load(saved.path), corrected(pr2, found)
    for tag in model.history.tags:
        assert operation_to_bytes(again, tag) == operation_to_bytes(model, tag)
    assert again.fk("cup").symbols == model.fk("cup").symbols


def test_a_urdf_moves_as_the_corrected_model_in_pinocchio(
    pr2: kv.Model, found: Calibration, tmp_path: Path
) -> None:
    with collect_warnings() as warnings:
        saved = found.save(tmp_path / "pr2.urdf")
    assert saved.remarks == ("'cup' is not corrected: the file has no number for it",)
    assert len(warnings) == 1
    robot = pin.buildModelFromUrdf(str(saved.path))
    data, q = robot.createData(), pin.neutral(robot)
    values = {}
    for name, value in (
        ("r_elbow_flex_joint", -0.7),
        ("r_wrist_flex_joint", -0.4),
        ("r_shoulder_lift_joint", 0.3),
    ):
        q[robot.joints[robot.getJointId(name)].idx_q] = values[f"pr2/{name}"] = value
    pin.framesForwardKinematics(robot, data, q)
    frames = (data.oMf[robot.getFrameId(f.removeprefix("pr2/"), pin.FrameType.BODY)] for f in (HEAD, TIP))
    head, tip = (frame.homogeneous for frame in frames)
    pose = corrected(pr2, found).fk(TIP, relative_to=HEAD)
    state = {symbol: values.get(str(symbol), 0.0) for symbol in pose.symbols}
    assert np.abs(pose(state) - np.linalg.inv(head) @ tip).max() < 1e-12
    assert np.abs(pose(state) - pr2.fk(TIP, relative_to=HEAD)(state)).max() > 1e-3


def test_a_document_of_the_model_knows_its_urdf_if_it_is_said(pr2: kv.Model, tmp_path: Path) -> None:
    pr2.save(tmp_path / "pr2.kv.json")
    model = kv.load(tmp_path / "pr2.kv.json")
    seen = model.fk(TIP, relative_to="pr2/torso_lift_link")
    rng = np.random.default_rng(1)
    states = [dict(zip(seen.symbols, q, strict=True)) for q in rng.uniform(-0.5, 0.5, (5, len(seen.symbols)))]
    looks = [(s, {(TIP, "pr2/torso_lift_link"): seen(s) @ kv.rotation_x(0.1)()}) for s in states]
    again = calibrate(model, looks, "offsets pr2/r_wrist_roll_joint", held_out=0)
    given = again.save(tmp_path / "given.urdf", source="pr2")
    assert given.remarks == ()
    read = kv.load(given.path, prefix="pr2")
    state = dict.fromkeys(seen.symbols, 0.2)
    moved = read.fk(TIP, relative_to="pr2/torso_lift_link")(state)
    assert np.abs(moved - seen(state) @ kv.rotation_x(0.1)()).max() < 1e-9


def test_a_model_that_changed_since_is_refused(pr2: kv.Model, found: Calibration, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="changed since the calibration"):
        found.apply(corrected(pr2, found))
    model = pr2.copy()
    state = dict.fromkeys(model.fk("cup", relative_to=TIP).symbols, 0.2)
    again = calibrate(model, [(state, {("cup", TIP): np.eye(4)})] * 4, "mount cup", held_out=0)
    with model.edit() as edit:
        edit.replace(
            model.history.writers("frames/cup")[0], found.operations[model.history.writers("frames/cup")[0]]
        )
    with pytest.raises(InvalidValueError, match="changed since the calibration"):
        again.save(tmp_path / "pr2.urdf")


def test_wheels_are_in_a_document_only(tmp_path: Path) -> None:
    times = np.arange(0.0, 20.0, 0.5)
    angles = np.stack([5 * times, 5 * times + np.sin(times)])
    readings = {"fetch/l_wheel_joint": angles[0], "fetch/r_wheel_joint": angles[1]}
    turn = 0.06 / 0.3748 * (angles[1] - angles[0])
    forward = np.append(0.0, np.cumsum(0.06 / 2 * np.diff(angles.sum(axis=0))))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 1.01 * forward
    poses[:, 0, 0], poses[:, 1, 1] = np.cos(turn), np.cos(turn)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(turn), -np.sin(turn)
    fetch = kv.load("fetch")
    drive = WheelOdometry("fetch/base", times, readings, times, poses)
    wheels = calibrate(fetch, [drive], "wheels fetch/base", outliers=None, held_out=0)
    with pytest.raises(FormatError, match=r"'fetch/base' is not corrected.*kv\.json"):
        wheels.save(tmp_path / "fetch.urdf")
    assert not (tmp_path / "fetch.urdf").exists()
    saved = wheels.save(tmp_path / "fetch.kv.json")
    base = kv.load(saved.path).history.operation("joint fetch/base").rebuild()
    assert isinstance(base, DifferentialDrive)
    changed = np.array([*base.radii, base.track]) - [0.06, 0.06, 0.3748]
    assert changed == pytest.approx([*wheels.state.values()])
