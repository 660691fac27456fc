"""Odometry in a calibration: drives of an independent integrator, with noise, slips and gross errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import chi2

import kineverse as kv
from kineverse import lie
from kineverse.articulations import Ackermann, DifferentialDrive, Mecanum, OmniBase
from kineverse.errors import InvalidValueError, KineverseError, ShapeError, UnknownNameError
from kineverse.estimation import WheelOdometry, calibrate
from kineverse.estimation.calibration.calibration import _prepare
from kineverse.estimation.calibration.odometry import integrate_arcs

RADIUS, TRACK = 0.06, 0.3748  # of the shipped Fetch
TRUE = np.array([0.0008, -0.0005, 0.004])
SIZES = np.array([RADIUS, RADIUS, TRACK])


def fetch_drive(
    seed: int,
    seconds: float = 80.0,
    every: float = 2.0,
    noise: float = 1.0,
    slips: int = 0,
    gross: float = 0.0,
) -> tuple[WheelOdometry, np.ndarray]:
    """Return a drive with noise of 3 mm and .5°, and which poses are gross errors."""
    rng = np.random.default_rng(seed)
    frequency, phase, size = (
        rng.uniform(0.02, 0.15, (2, 4)),
        rng.uniform(0, 6, (2, 4)),
        rng.uniform(0.5, 2, (2, 4)),
    )
    left, right = RADIUS + TRUE[:2]
    track = TRACK + TRUE[2]

    def rates(t: float, s: np.ndarray) -> list[float]:
        wl, wr = 5 + (size * np.sin(math.tau * frequency * t + phase)).sum(axis=1)
        v = (left * wl + right * wr) / 2
        return [v * math.cos(s[2]), v * math.sin(s[2]), (right * wr - left * wl) / track, wl, wr]

    times, seen_at = np.arange(0, seconds, 0.04), np.arange(0.33, seconds - 0.1, every)
    solution = solve_ivp(rates, (0, seconds), [1, 2, 0.5, 0, 0], rtol=1e-9, atol=1e-11, dense_output=True).sol
    x, y, angle = solution(seen_at)[:3]
    poses = lie.transform(lie.rotation_z(angle), np.stack([x, y, 0 * x], axis=1))
    for k in rng.choice(np.arange(6, len(seen_at) - 6, 8), slips, replace=False):
        here = lie.translation(poses[k, :3, 3])
        slip = lie.transform(
            lie.rotation_z(np.array(0.1 * rng.normal())), np.append(0.1 * rng.normal(size=2), 0)
        )
        poses[k:] = here @ slip @ lie.inverse(here) @ poses[k:]
    n, bad = len(poses), rng.random(len(poses)) < gross
    for mask, metres, radians in (
        (np.ones(n, bool), 0.003 * noise, math.radians(0.5) * noise),
        (bad, 1.0, 1.0),
    ):
        poses[mask, :3, 3] += metres * rng.normal(size=(mask.sum(), 3))
        turned = lie.exp_so3(radians * rng.normal(size=(mask.sum(), 3)))
        poses[mask, :3, :3] = turned @ poses[mask, :3, :3]
    angles = solution(times)[3:]
    wheels = dict(zip(("fetch/l_wheel_joint", "fetch/r_wheel_joint"), angles, strict=True))
    return WheelOdometry("fetch/base", times, wheels, seen_at, poses), bad


@pytest.fixture(scope="module")
def fetch() -> kv.Model:
    return kv.load("fetch")


@pytest.mark.parametrize("turn", [0.0, 1e-9, 5e-5, 2e-4, 0.3, -3.0])
def test_arcs_are_exponentials_of_twists(turn: float) -> None:
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(6, 3)) * (0.1, 0.1, 0.0) + (0, 0, turn)
    slopes = rng.normal(size=(6, 3, 2))
    path = integrate_arcs(twists, slopes)
    pose = np.eye(3)
    for k, (a, b, c) in enumerate(twists):
        pose = pose @ expm(np.array([[0, -c, a], [c, 0, b], [0, 0, 0]]))
        angle = math.atan2(pose[1, 0], pose[0, 0])
        expected = [pose[0, 2], pose[1, 2], angle]
        assert np.abs(np.exp(1j * path.poses[k + 1, 2]) - np.exp(1j * angle)) < 1e-14
        assert np.abs(path.poses[k + 1, :2] - expected[:2]).max() < 1e-14
    h = 1e-6
    for j in range(2):
        there, back = (integrate_arcs(twists + s * h * slopes[:, :, j], slopes).poses for s in (1, -1))
        assert np.abs((there - back) / (2 * h) - path.slopes[:, :, j]).max() < 2e-9


def test_the_jacobian_is_that_of_the_residuals_with_the_best_starts(fetch: kv.Model) -> None:
    mount = lie.transform(lie.rotation_x(np.array(0.3)), np.array([0.1, 0.2, 0.4]))
    model = fetch.copy()
    with model.edit() as edit:
        edit.add_frame("marker", parent="fetch/torso_lift_link", transform=mount)
    prepared = _prepare(model, ["wheels fetch/base", "mount marker"])
    drive, _ = fetch_drive(1, 40.0, noise=0.0)
    state = {"fetch/torso_lift_joint": 0.1}
    base_T_marker = model.fk("marker", relative_to="fetch/base")(state)
    poses = np.asarray(drive.poses) @ base_T_marker
    drive = WheelOdometry(
        "fetch/base", drive.times, drive.wheels, drive.seen_at, poses, frame="marker", state=state
    )
    block = drive.residual_block(prepared.model, [u.inner for u in prepared.unknowns], 0)
    wheels = dict(zip(("radius_left", "radius_right", "track"), TRUE.tolist(), strict=True))
    at = np.array([wheels.get(str(s).split(":")[0].split("/")[-1], 0.0) for s in block.parameters])
    assert np.count_nonzero(at) == 3
    residual, jacobian = block.evaluate(at)
    assert np.abs(residual).max() < 1e-4
    for k, step in enumerate(1e-5 * np.eye(9)):
        slope = (block.evaluate(at + step)[0] - block.evaluate(at - step)[0]) / 2e-5
        # The derivative of the start lacks terms with residuals, which are next to nothing here.
        assert np.abs(slope - jacobian[..., k]).max() < 1e-3 * np.abs(slope).max() + 1e-4


def test_wheels_of_a_fetch_without_noise(fetch: kv.Model) -> None:
    drive, _ = fetch_drive(0, noise=0.0)
    found = calibrate(fetch, [drive], "wheels fetch/base", held_out=0)
    assert (
        np.abs(np.array([*found.state.values()]) - TRUE).max() < 2e-5
    )  # of the readings at 25 Hz, between which the wheels do not turn evenly
    base = found.operations["joint fetch/base"]
    assert isinstance(base, DifferentialDrive)
    assert np.allclose([*base.radii, base.track], SIZES + TRUE, atol=2e-5, rtol=0)


@pytest.mark.parametrize(
    ("count", "seconds", "every"), [(3, 80.0, 1.0), pytest.param(20, 180.0, 2.0, marks=pytest.mark.long)]
)
def test_wheels_of_a_fetch_to_a_twentieth_of_a_percent(
    fetch: kv.Model, count: int, seconds: float, every: float
) -> None:
    errors, spreads = [], []
    for seed in range(count):
        drive, _ = fetch_drive(seed, seconds, every)
        found = calibrate(fetch, [drive], "wheels fetch/base", held_out=0)
        errors.append(np.array([*found.state.values()]) - TRUE)
        spreads.append(found.covariance)
        assert found.noise["position"] == pytest.approx(0.003, rel=0.15)
        assert found.unobservable == ()
    nees = [e @ np.linalg.solve(c, e) / 3 for e, c in zip(errors, spreads, strict=True)]
    # Of χ² with 3 degrees of freedom for each, exceeded once in a thousand on each side.
    assert chi2.ppf(1e-3, 3 * count) < 3 * np.sum(nees) < chi2.ppf(1 - 1e-3, 3 * count)
    assert np.sqrt(np.square(errors).mean(axis=0) / SIZES**2).max() < 0.0005


def test_slips_and_gross_errors(fetch: kv.Model) -> None:
    for seed in range(2):
        drive, bad = fetch_drive(20 + seed, slips=2, gross=0.1)
        found = calibrate(fetch, [drive], "wheels fetch/base", held_out=0)
        error = np.array([*found.state.values()]) - TRUE
        assert np.abs(error / SIZES).max() < 0.0015
        assert np.sqrt(error**2 / np.diag(found.covariance)).max() < 4.5
        listed = {outlier.look for outlier in found.outliers}
        assert listed >= {int(k) for k in np.flatnonzero(bad)} - {0, 1, 2}


def test_a_drive_that_turns_far_from_where_the_present_wheels_lead(fetch: kv.Model) -> None:
    drive, _ = fetch_drive(5)
    off = fetch.copy()
    base = off.history.operation("joint fetch/base")
    with off.edit() as edit:
        edit.replace("joint fetch/base", replace(base, radius=(0.066, 0.056), track=0.34))
    found = calibrate(off, [drive], "wheels fetch/base", held_out=0)
    changed = off.copy()
    found.apply(changed)
    wheels = changed.history.operation("joint fetch/base")
    assert isinstance(wheels, DifferentialDrive)
    assert np.abs(np.array([*wheels.radii, wheels.track]) / (SIZES + TRUE) - 1).max() < 0.001


def test_one_doubtful_pose_is_no_slip(fetch: kv.Model) -> None:
    drive, _ = fetch_drive(6, noise=0.2)
    poses = np.array(drive.poses)
    poses[20] = poses[20] @ lie.transform(lie.rotation_z(np.array(0.008)), np.array([0.003, -0.003, 0.0]))
    fields = {k: getattr(drive, k) for k in ("base", "times", "wheels", "seen_at")}
    prepared = _prepare(fetch, ["wheels fetch/base"])
    inner = [u.inner for u in prepared.unknowns]
    block = WheelOdometry(**fields, poses=poses).residual_block(prepared.model, inner, 0)
    assert len(block.pieces) == 1
    assert block.kept.sum() >= len(poses) - 2


def test_a_start_is_estimated_anew_where_it_is_wanted(fetch: kv.Model) -> None:
    drive, _ = fetch_drive(3, slips=0)
    fields = {k: getattr(drive, k) for k in ("base", "times", "wheels", "seen_at", "poses")}
    whole = calibrate(fetch, [drive], "wheels fetch/base", held_out=0)
    pieces = calibrate(fetch, [WheelOdometry(**fields, restart=20.0)], "wheels fetch/base", held_out=0)
    assert (np.diag(pieces.covariance) > 1.5 * np.diag(whole.covariance)).all()
    assert (
        np.abs(np.array([*pieces.state.values()]) - TRUE).max()
        < 5 * np.sqrt(np.diag(pieces.covariance)).max()
    )


def test_the_pose_of_a_marker_on_the_base_is_told_but_for_what_the_floor_hides(fetch: kv.Model) -> None:
    drive, _ = fetch_drive(4)
    model = fetch.copy()
    with model.edit() as edit:
        edit.add_frame("marker", parent="fetch/base_link")
    mount = lie.transform(lie.exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.1, 0.05, 0.0]))
    seen = WheelOdometry(
        "fetch/base", drive.times, drive.wheels, drive.seen_at, np.asarray(drive.poses) @ mount, "marker"
    )
    found = calibrate(model, [seen], ["wheels fetch/base", "mount marker"], held_out=0)
    state = {str(k): v for k, v in found.state.items()}
    assert state["marker/dx"] == pytest.approx(0.1, abs=0.002)
    assert state["marker/dy"] == pytest.approx(0.05, abs=0.002)
    assert (
        np.abs(
            np.array([state[f"fetch/base/{n}"] for n in ("radius_left", "radius_right", "track")]) - TRUE
        ).max()
        < 3e-4
    )


def planar_poses(solution: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    x, y, angle = solution(at)[:3]
    return lie.transform(lie.rotation_z(angle), np.stack([x, y, 0 * x], axis=1))


def test_mecanum_wheels_and_a_steered_car() -> None:
    times, seen_at = np.arange(0, 60, 0.01), np.arange(0.5, 59, 0.75)
    signs = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])

    def wheel_speeds(t: float) -> np.ndarray:
        return 3 + 2 * np.sin(np.array([0.7, 0.5, 0.3, 0.9]) * t + np.arange(4))

    def roll(t: float, s: np.ndarray) -> list[float]:
        u, v, w = signs @ wheel_speeds(t) * np.array([0.052 / 4, 0.052 / 4, 0.052 / (2 * 0.9)])
        c, n = math.cos(s[2]), math.sin(s[2])
        return [c * u - n * v, n * u + c * v, w, *wheel_speeds(t)]

    solution = solve_ivp(roll, (0, 60), np.zeros(7), rtol=1e-9, atol=1e-11, dense_output=True).sol
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Mecanum(name="m", parent="world", child="m/base", radius=0.05, track=0.4, wheelbase=0.48))
    wheels = {f"m/{n}_wheel": solution(times)[3 + k] for k, n in
              enumerate(("front_left", "front_right", "rear_left", "rear_right"))}  # fmt: skip
    drive = WheelOdometry("m", times, wheels, seen_at, planar_poses(solution, seen_at))
    found = {str(k): v for k, v in calibrate(model, [drive], "wheels m", held_out=0).state.items()}
    assert found["m/radius"] == pytest.approx(0.002, abs=1e-6)
    assert found["m/geometry"] == pytest.approx(0.02, abs=2e-5)

    def steer(t: float, s: np.ndarray) -> list[float]:
        v, delta = 1 + 0.3 * math.sin(t), 0.3 * math.sin(0.4 * t)
        return [v * math.cos(s[2]), v * math.sin(s[2]), v * math.tan(delta) / 2.6, v]

    solution = solve_ivp(steer, (0, 60), np.zeros(4), rtol=1e-9, atol=1e-11, dense_output=True).sol
    length = kv.parameter("wheelbase", 2.5)
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Ackermann(name="car", parent="world", child="car/rear", wheelbase=length))
    series = {"car/drive": solution(times)[3], "car/steering": 0.3 * np.sin(0.4 * times)}
    drive = WheelOdometry("car", times, series, seen_at, planar_poses(solution, seen_at))
    result = calibrate(model, [drive], [length], held_out=0)
    assert [*result.state.values()] == pytest.approx([2.6], abs=1e-4)


T3 = np.arange(3.0)
WHEELS = {"fetch/l_wheel_joint": T3, "fetch/r_wheel_joint": T3}
POSES = np.tile(np.eye(4), (2, 1, 1))
WRONG: list[tuple[dict[str, Any], type[KineverseError], str]] = [
    ({"base": "fetch/bas"}, UnknownNameError, "no mobile base 'fetch/bas'.*fetch/base"),
    ({"base": "fetch/torso_lift_joint"}, InvalidValueError, "no base on wheels.*fetch/base"),
    ({"wheels": {"fetch/l_wheel_joint": T3}}, UnknownNameError, "'fetch/r_wheel_joint' are missing"),
    ({"wheels": {**WHEELS, "fetch/r_wheel_joint": T3[:2]}}, ShapeError, r"3 numbers, one for each time.*\(2,\)"),
    ({"wheels": {**WHEELS, "fetch/r_wheel_joint": [0, np.nan, 1]}}, InvalidValueError, "number 1 is nan"),
    ({"wheels": {**WHEELS, "fetch/l_wheel_joint": [2, 3, -2.3]}}, InvalidValueError, "l_wheel_joint' begins anew"),
    ({"restart": math.nan}, InvalidValueError, "above 0 s, not nan"),
    ({"restart": "soon"}, InvalidValueError, "above 0 s, not 'soon'"),
    ({"times": [0, 2, 1]}, InvalidValueError, "times increase, but 1 s follows 2 s"),
    ({"seen_at": [0.5, 0.5]}, InvalidValueError, "seen_at increase"),
    ({"seen_at": [0.5, 2.5]}, InvalidValueError, "seen from 0.5 s to 2.5 s.*read from 0 s to 2 s.*Leave out"),
    ({"seen_at": []}, InvalidValueError, "3 readings and 0 poses: too few"),
    ({"poses": POSES[:1]}, ShapeError, r"\(2, 4, 4\) are expected"),
    ({"poses": 2 * POSES}, InvalidValueError, "no rigid transform"),
    ({"poses": "poses.csv"}, ShapeError, "array"),
    ({"frame": "fetch/gripper_link"}, UnknownNameError, "state="),
    ({"frame": "fetch/gripperlink"}, UnknownNameError, "gripper_link"),
    ({"relative_to": "fetch/torso_lift_link"}, InvalidValueError, "does not move"),
    ({"covariance": [-1.0, 1.0]}, InvalidValueError, "positive"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "kind", "message"), WRONG, ids=lambda x: str(x)[:40] if isinstance(x, dict) else ""
)
def test_wrong_recordings(
    fetch: kv.Model, change: dict[str, Any], kind: type[KineverseError], message: str
) -> None:
    given = {
        "base": "fetch/base",
        "times": T3,
        "wheels": WHEELS,
        "seen_at": [0.5, 1.5],
        "poses": POSES,
        **change,
    }
    with pytest.raises(kind, match=f"(?s){message}"):
        calibrate(fetch, [WheelOdometry(**given)], "wheels fetch/base")


def test_a_base_without_wheels() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(OmniBase(name="omni", parent="world", child="omni/base"))
    drive = WheelOdometry("omni", T3, {"omni/x": T3}, [0.5, 1.5], POSES)
    with pytest.raises(InvalidValueError, match="no base on wheels"):
        drive.residual_block(model, [], 0)
