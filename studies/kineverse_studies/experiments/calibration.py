"""``calibration``: errors of calibrated parameters against the Cramér-Rao bound; hand-eye beside OpenCV.

Five recordings are drawn again and again: an arm that a camera sees, the same with gross errors, corners that
a camera sees, and a base on wheels that is seen from time to time, without and with slips. Errors over the
bound are root mean squares over parameters and draws, each error in standard deviations of the bound. Looks
are computed by pinocchio, drives by fine steps, and bounds by differences of these: nothing by Kineverse.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse._extras import STUDIES, install_distribution
from kineverse.articulations import Floating
from kineverse.errors import MissingDependencyError
from kineverse.estimation import Calibration, Look, ObservedPixel, WheelOdometry, calibrate
from kineverse.lie import (
    Array,
    exp_so3,
    inverse,
    log_so3,
    rotation_angle,
    rotation_z,
    rpy,
    to_quaternion,
    transform,
    translation,
)
from kineverse.shipped import FOLDER
from kineverse.symbols import parameter
from kineverse.view.plots import Figure

from .registry import Options, Progress
from .report import Report, ReportTable, format_fixed

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

SEED = 2022
POSITION, ORIENTATION, PIXEL = 0.003, math.radians(0.5), 0.5  # noise of each component [m], [rad], [px]
GROSS = 0.1  # share of gross errors, where there are any
LOOKS = 60
DRAWS, DRIVES, HAND_EYE_DRAWS = 200, 60, 100
QUICK_DRAWS, QUICK_DRIVES, QUICK_HAND_EYE_DRAWS = 10, 1, 5
OPTIONS = ("quick", "seed")
Mask: TypeAlias = npt.NDArray[np.bool_]
_STEP = 1e-6  # of differences [m], [rad]
_FOCAL, _CENTRE = 600.0, (320.0, 240.0)  # of the camera [px]
_VIEW = (0.45, 0.35)  # tangents of half the angles of view, less what offsets and corners take


@dataclass(frozen=True)
class Draw:
    """Result of one draw: errors in standard deviations of the bound, their NEES, and the time."""

    errors: Array  # (p,)
    nees: float  # over the number of parameters, by the covariance that was found
    seconds: float
    relative: Array  # errors over the true sizes of what has one, (k,)


def score(found: Calibration, truth: Array, bound: Array, seconds: float, sizes: Array | None = None) -> Draw:
    """Compare found parameters with true ones; ``bound`` is the covariance of the bound."""
    errors = np.array([*found.state.values()]) - truth
    nees = float(errors @ np.linalg.solve(found.covariance, errors)) / len(errors)
    relative = errors / sizes if sizes is not None else np.zeros(0)
    return Draw(errors / np.sqrt(np.diag(bound)), nees, seconds, relative)


def differences(function: Callable[[Array], Array], at: Array) -> Array:
    """Return the Jacobian (m, p) of a function by central differences."""
    steps = _STEP * np.eye(len(at))
    columns = [(function(at + s) - function(at - s)).ravel() / (2 * _STEP) for s in steps]
    return np.stack(columns, axis=1)


def bound_of(jacobian: Array, deviations: Array) -> Array:
    """Return the Cramér-Rao bound of parameters for independent normal errors."""
    scaled = jacobian / deviations[:, None]
    sizes = np.linalg.norm(scaled, axis=0)  # of pixels and radians
    triangle = np.linalg.inv(np.linalg.qr(scaled / sizes, mode="r"))
    return np.asarray(triangle @ triangle.T / np.outer(sizes, sizes))


# -- an arm that a camera sees -------------------------------------------------------------------------------

ARM = (
    "shoulder_pan",
    "shoulder_lift",
    "upper_arm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
HEAD = ("head_pan", "head_tilt")
_JOINTS = (*(f"r_{n}_joint" for n in ARM), *(f"{n}_joint" for n in HEAD))
_LOWER = np.array([-1.5, -0.4, -2.0, -2.0, -2.0, -1.8, -2.0, -0.6, 0.1])
_UPPER = np.array([0.4, 0.8, 0.5, -0.3, 2.0, -0.2, 2.0, 0.6, 0.9])
# Of the camera in the head.
_NOMINAL = transform(rpy(np.array([-math.pi / 2, 0.0, -math.pi / 2])), np.array([0.07, 0.0, 0.1]))
_CORNERS = 0.05 * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])  # [m]


class SeenArm:
    """Right arm of a PR2 in pinocchio, as seen by a camera on the head."""

    def __init__(self) -> None:
        try:
            import pinocchio as pin
        except ImportError:
            raise _missing("pinocchio") from None
        self._pin = pin
        self._model = pin.buildModelFromUrdf(str(FOLDER / "pr2.urdf"))
        self._data = self._model.createData()
        self._places = [self._model.joints[self._model.getJointId(n)].idx_q for n in _JOINTS]
        self._sizes = [self._model.joints[self._model.getJointId(n)].nq for n in _JOINTS]
        frames = ("r_gripper_tool_frame", "head_tilt_link")
        self._frames = [self._model.getFrameId(name, pin.FrameType.BODY) for name in frames]

    def poses(self, joints: Array) -> Array:
        """Return the poses of the gripper in the head, (N, 4, 4), at joint values (N, 9)."""
        result = np.empty((len(joints), 4, 4))
        q = self._pin.neutral(self._model)
        for k, values in enumerate(joints):
            for place, size, value in zip(self._places, self._sizes, values, strict=True):
                q[place : place + size] = value if size == 1 else (math.cos(value), math.sin(value))
            self._pin.framesForwardKinematics(self._model, self._data, q)
            hand, head = (self._data.oMf[frame].homogeneous for frame in self._frames)
            result[k] = inverse(head) @ hand
        return result

    def seen(self, joints: Array, numbers: Array) -> Array:
        """Return the poses of the gripper in the camera, with offsets of the arm (7,) and its mount (6,)."""
        moved = joints + np.concatenate([numbers[:7], np.zeros(2)])
        return inverse(camera_mount(numbers[7:])) @ self.poses(moved)


def camera_mount(numbers: Array) -> Array:
    """Return the pose of the camera in the head for six numbers."""
    return _NOMINAL @ transform(exp_so3(numbers[3:]), numbers[:3])


def pose_errors(seen: Array, expected: Array) -> Array:
    """Return the errors (N, 6) of poses, in axes of the observing frame."""
    turned = log_so3(seen[:, :3, :3] @ np.swapaxes(expected[:, :3, :3], 1, 2))
    return np.concatenate([seen[:, :3, 3] - expected[:, :3, 3], turned], axis=1)


def noisy(rng: np.random.Generator, poses: Array, wrong: Mask) -> Array:
    """Return poses with noise, and with gross errors where ``wrong`` is True."""
    result = poses.copy()
    for chosen, position, orientation in ((~wrong, POSITION, ORIENTATION), (wrong, 0.3, 1.0)):
        count = int(chosen.sum())
        result[chosen, :3, 3] += position * rng.normal(size=(count, 3))
        turned = exp_so3(orientation * rng.normal(size=(count, 3)))
        result[chosen, :3, :3] = turned @ result[chosen, :3, :3]
    return result


def arm_model() -> kv.Model:
    model = kv.load("pr2")
    with model.edit() as edit:
        edit.add_frame("camera", parent="pr2/head_tilt_link", transform=_NOMINAL)
    return model


def draw_joints(rng: np.random.Generator, arm: SeenArm) -> tuple[Array, Array]:
    """Return joint values (N, 9) at which the camera sees the gripper, and true offsets and mount (13,)."""
    joints = np.empty((0, len(_JOINTS)))
    while len(joints) < LOOKS:
        some = rng.uniform(_LOWER, _UPPER, (LOOKS, len(_JOINTS)))
        places = arm.seen(some, np.zeros(13))[:, :3, 3]
        is_seen = (places[:, 2] > 0.3) & (np.abs(places[:, :2]) < _VIEW * places[:, 2:]).all(axis=1)
        joints = np.concatenate([joints, some[is_seen]])
    joints = joints[:LOOKS]
    sizes = np.concatenate([np.full(7, 0.03), np.full(3, 0.02), np.full(3, 0.05)])
    return joints, sizes * rng.normal(size=13)


def states(joints: Array) -> list[dict[str, float]]:
    return [{f"pr2/{n}": float(v) for n, v in zip(_JOINTS, row, strict=True)} for row in joints]


def calibrate_arm(model: kv.Model, arm: SeenArm, seed: int, gross: float) -> Draw:
    """Calibrate seven offsets and the mount of the camera by the poses of the gripper."""
    rng = np.random.default_rng([SEED, seed])
    joints, truth = draw_joints(rng, arm)
    exact = arm.seen(joints, truth)
    wrong = rng.random(LOOKS) < gross
    poses = noisy(rng, exact, wrong)
    key = "pr2/r_gripper_tool_frame", "camera"
    looks = [Look(state, {key: pose}) for state, pose in zip(states(joints), poses, strict=True)]
    start = time.process_time()
    found = calibrate(model, looks, ["offsets pr2/r_[sufew]*_joint", "mount camera"], held_out=0)
    seconds = time.process_time() - start

    def residual(numbers: Array) -> Array:
        return pose_errors(arm.seen(joints[~wrong], numbers), exact[~wrong])

    deviations = np.tile(np.repeat([POSITION, ORIENTATION], 3), int((~wrong).sum()))
    order = _order(found, arm_names())
    bound = bound_of(differences(residual, truth), deviations)[np.ix_(order, order)]
    return score(found, truth[order], bound, seconds)


def arm_names() -> list[str]:
    mount = [f"camera/{n}" for n in ("dx", "dy", "dz", "rx", "ry", "rz")]
    return [*(f"pr2/r_{n}_joint/offset" for n in ARM), *mount]


def _order(found: Calibration, names: Sequence[str]) -> list[int]:
    return [names.index(str(s)) for s in found.state]


def calibrate_camera(model: kv.Model, arm: SeenArm, seed: int) -> Draw:
    """Calibrate focal lengths, centre and mount of the camera by four corners that the gripper holds."""
    rng = np.random.default_rng([SEED, 1, seed])
    joints, offsets = draw_joints(rng, arm)
    truth = np.concatenate([[620.0, 610.0, 330.0, 235.0], offsets[7:]])

    def image(numbers: Array) -> Array:
        poses = arm.seen(joints, np.concatenate([np.zeros(7), numbers[4:]]))
        points = np.einsum("nij,kj->nki", poses[:, :3, :3], _CORNERS) + poses[:, None, :3, 3]
        return np.asarray(numbers[:2] * points[..., :2] / points[..., 2:] + numbers[2:4])

    exact = image(truth)
    pixels = exact + PIXEL * rng.normal(size=exact.shape)
    names = ("camera/fx", "camera/fy", "camera/cx", "camera/cy")
    start = (_FOCAL, _FOCAL, *_CENTRE)
    symbols = [parameter(name, value) for name, value in zip(names, start, strict=True)]
    focal, centre = (symbols[0], symbols[1]), (symbols[2], symbols[3])
    looks = []
    for state, corners in zip(states(joints), pixels, strict=True):
        seen = [
            ObservedPixel("pr2/r_gripper_tool_frame", "camera", (u, v), tuple(point), focal, centre)
            for (u, v), point in zip(corners.tolist(), _CORNERS.tolist(), strict=True)
        ]
        looks.append(Look(state, seen))
    begun = time.process_time()
    found = calibrate(model, looks, [*symbols, "mount camera"], held_out=0)
    seconds = time.process_time() - begun
    order = _order(found, [*map(str, symbols), *arm_names()[7:]])
    bound = bound_of(differences(image, truth), np.full(exact.size, PIXEL))
    return score(found, truth[order], bound[np.ix_(order, order)], seconds)


# -- a base on wheels ----------------------------------------------------------------------------------------

_WHEELS = np.array([0.06, 0.06, 0.3748])  # radii and track of the shipped Fetch [m]
_SECONDS = 180.0  # of a drive
_READING, _SEEN = 0.02, 2.0  # between readings of the wheels, and between poses [s]
_PLANE = np.array([POSITION, POSITION, ORIENTATION])


@dataclass(frozen=True)
class WheelSpeeds:
    """Smooth speeds of two wheels."""

    frequency: Array  # (2, 4)
    phase: Array
    size: Array

    def at(self, times: Array) -> Array:
        """Return the speeds (N, 2) [rad/s]."""
        waves = self.size * np.sin(math.tau * self.frequency * times[:, None, None] + self.phase)
        return np.asarray(5.0 + waves.sum(axis=2))

    def integral(self, times: Array) -> Array:
        """Return the angles since the start (N, 2) [rad]."""
        rate = math.tau * self.frequency
        waves = self.size / rate * (np.cos(self.phase) - np.cos(rate * times[:, None, None] + self.phase))
        return np.asarray(5.0 * times[:, None] + waves.sum(axis=2))


def integrate_drive(speeds: WheelSpeeds, wheels: Array, start: Array, at: Array) -> Array:
    """Return x, y, angle and wheel angles (N, 5) at some times.

    The angles of the wheels, and with them that of the base, are known in closed form. Its position is
    integrated by Simpson's rule in steps of a millisecond.
    """
    fine = np.linspace(0.0, at[-1], 2 * math.ceil(at[-1] / 0.002) + 1)
    rolled = speeds.integral(fine)
    angle = start[2] + (wheels[1] * rolled[:, 1] - wheels[0] * rolled[:, 0]) / wheels[2]
    forward = speeds.at(fine) @ wheels[:2] / 2
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=1) * forward[:, None]
    steps = (heading[:-2:2] + 4 * heading[1::2] + heading[2::2]) * (fine[1] / 3)
    places = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    # From the last even step to the wanted time, by the middle of what is left.
    even = np.minimum((at / (2 * fine[1])).astype(int), len(steps))
    left = at - fine[2 * even]
    middle = fine[2 * even] + left / 2
    turned = speeds.integral(middle)
    toward = start[2] + (wheels[1] * turned[:, 1] - wheels[0] * turned[:, 0]) / wheels[2]
    ahead = (speeds.at(middle) @ wheels[:2] / 2 * left)[:, None]
    xy = places[even] + ahead * np.stack([np.cos(toward), np.sin(toward)], axis=1)
    wound = speeds.integral(at)
    final = start[2] + (wheels[1] * wound[:, 1] - wheels[0] * wound[:, 0]) / wheels[2]
    return np.concatenate([xy, final[:, None], wound], axis=1)


def calibrate_wheels(model: kv.Model, seed: int, slips: int, gross: float) -> Draw:
    """Calibrate radii and track by poses that were seen along a drive."""
    rng = np.random.default_rng([SEED, 2, seed])
    speeds = WheelSpeeds(
        rng.uniform(0.02, 0.15, (2, 4)), rng.uniform(0, 6, (2, 4)), rng.uniform(0.5, 2, (2, 4))
    )
    changes = np.array([0.001, 0.001, 0.005]) * rng.normal(size=3)
    start = rng.normal(size=3)
    times, seen_at = np.arange(0.0, _SECONDS, _READING), np.arange(0.3, _SECONDS - 0.1, _SEEN)
    wheels = _WHEELS + changes
    angles = integrate_drive(speeds, wheels, start, times)[:, 3:]
    x, y, angle = integrate_drive(speeds, wheels, start, seen_at)[:, :3].T
    poses = transform(rotation_z(angle), np.stack([x, y, 0 * x], axis=1))
    cuts = np.sort(rng.choice(np.arange(10, len(seen_at) - 10, 8), slips, replace=False))
    for k in cuts:
        here = translation(poses[k, :3, 3])
        turned = rotation_z(np.array(0.1 * rng.normal()))
        slip = transform(turned, np.append(0.1 * rng.normal(size=2), 0.0))
        poses[k:] = here @ slip @ inverse(here) @ poses[k:]
    wrong = rng.random(len(poses)) < gross
    readings: dict[Any, Any] = {"fetch/l_wheel_joint": angles[:, 0], "fetch/r_wheel_joint": angles[:, 1]}
    recording = WheelOdometry("fetch/base", times, readings, seen_at, noisy(rng, poses, wrong))
    begun = time.process_time()
    found = calibrate(model, [recording], "wheels fetch/base", held_out=0)
    seconds = time.process_time() - begun
    # Each piece between slips has a start of its own in the bound, as a rigid motion of the whole drive.
    slopes = differences(lambda w: integrate_drive(speeds, w, start, seen_at)[:, :3], wheels).reshape(
        -1, 3, 3
    )
    piece = np.searchsorted(cuts, np.arange(len(seen_at)), side="right")
    begins = np.zeros((len(seen_at), 3, 3 * (slips + 1)))
    for k, n in enumerate(piece):
        begins[k, :, 3 * n : 3 * n + 3] = [[1, 0, -y[k]], [0, 1, x[k]], [0, 0, 1]]
    jacobian = np.concatenate([slopes, begins], axis=2)[~wrong].reshape(-1, 3 + begins.shape[2])
    bound = bound_of(jacobian, np.tile(_PLANE, int((~wrong).sum())))[:3, :3]
    return score(found, changes, bound, seconds, wheels)


# -- hand and eye --------------------------------------------------------------------------------------------

SETTINGS = tuple((looks, spread) for looks in (30, 10) for spread in (1.0, 0.25))
METHODS = ("Tsai", "Park", "Horaud", "Andreff", "Daniilidis")


def hand_eye_model() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Floating(name="hand", parent="world", child="hand"))
        edit.add_frame("marker", parent="hand")
        edit.add_frame("camera", parent="world")
    return model


def compare_hand_eye(model: kv.Model, seed: int, looks: int, spread: float) -> dict[str, tuple[float, float]]:
    """Return errors of the camera's position [m] and orientation [rad], by method; ours first.

    Camera and marker are anywhere, in any orientation: the model begins with both at their parents.
    """
    try:
        import cv2
    except ImportError:
        raise _missing("opencv-python-headless") from None
    rng = np.random.default_rng([SEED, 3, seed, looks, round(100 * spread)])
    camera, marker = (
        transform(exp_so3(rng.uniform(-1.8, 1.8, 3)), size * rng.normal(size=3)) for size in (1.0, 0.1)
    )
    turned = exp_so3(spread * rng.normal(size=(looks, 3))) @ exp_so3(rng.uniform(-1.8, 1.8, 3))
    hands = transform(turned, spread * 0.3 * rng.normal(size=(looks, 3)))
    seen = noisy(rng, inverse(camera) @ hands @ marker, np.zeros(looks, dtype=bool))
    recordings = []
    for hand, pose in zip(hands, seen, strict=True):
        numbers = [*hand[:3, 3], *to_quaternion(hand[:3, :3])]
        names = (f"hand/{n}" for n in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        recordings.append(
            Look(dict(zip(names, map(float, numbers), strict=True)), {("marker", "camera"): pose})
        )
    found = calibrate(model, recordings, ["mount camera", "mount marker"], held_out=0)
    values = {str(s): v for s, v in found.state.items()}
    mount = np.array([values[f"camera/{n}"] for n in ("dx", "dy", "dz", "rx", "ry", "rz")])
    results = {"ours": transform(exp_so3(mount[3:]), mount[:3])}
    back = inverse(hands)
    for method in METHODS:
        flag = getattr(cv2, f"CALIB_HAND_EYE_{method.upper()}")
        given: Any = back[:, :3, :3], back[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3]
        solve: Any = cv2.calibrateHandEye
        rotation, position = solve(*given, method=flag)
        results[method] = transform(np.asarray(rotation), np.asarray(position).ravel())
    return {
        name: (
            float(np.linalg.norm(pose[:3, 3] - camera[:3, 3])),
            float(rotation_angle(pose[:3, :3] @ camera[:3, :3].T)),
        )
        for name, pose in results.items()
    }


# -- report --------------------------------------------------------------------------------------------------


def run(progress: Progress, options: Options) -> Report:
    quick = options.quick
    draws = QUICK_DRAWS if quick else DRAWS
    drives = QUICK_DRIVES if quick else DRIVES
    hands = QUICK_HAND_EYE_DRAWS if quick else HAND_EYE_DRAWS
    return report(*measure(progress, draws, drives, hands, options.seed))


Cases = Mapping[str, tuple[int, list[Draw]]]
HandEye = Mapping[tuple[int, float], list[dict[str, tuple[float, float]]]]


def measure(progress: Progress, draws: int, drives: int, hands: int, seed: int = 0) -> tuple[Cases, HandEye]:
    """Return the draws of each case with its number of parameters, and the errors of hand-eye calibration."""
    arm, pr2, fetch = SeenArm(), arm_model(), kv.load("fetch")
    cases: dict[str, tuple[int, int, Callable[[int], Draw]]] = {
        "arm and camera": (13, draws, lambda k: calibrate_arm(pr2, arm, k, 0.0)),
        "with 10 % gross errors": (13, draws, lambda k: calibrate_arm(pr2, arm, k, GROSS)),
        "camera by corners": (10, draws, lambda k: calibrate_camera(pr2, arm, k)),
        "wheels": (3, drives, lambda k: calibrate_wheels(fetch, k, 0, 0.0)),
        "wheels that slip, 10 % gross errors": (3, drives, lambda k: calibrate_wheels(fetch, k, 3, GROSS)),
    }
    found = {}
    for name, (size, count, case) in cases.items():
        numbers = range(seed, seed + count)
        found[name] = size, [case(k) for k in progress(numbers, name, "draw")]
    model = hand_eye_model()
    compared = {}
    for looks, spread in SETTINGS:
        numbers = range(seed, seed + hands)
        what = f"{looks} looks, {spread:g} rad"
        compared[looks, spread] = [
            compare_hand_eye(model, k, looks, spread) for k in progress(numbers, what, "draw")
        ]
    return found, compared


def report(cases: Cases, compared: HandEye) -> Report:
    rows = []
    for name, (size, draws) in cases.items():
        errors = np.array([draw.errors for draw in draws])
        nees = float(np.mean([draw.nees for draw in draws]))
        worst = 100 * np.sqrt(np.square([draw.relative for draw in draws]).mean(axis=0)).max(initial=0.0)
        rows.append(
            (
                name,
                float(size),
                float(len(draws)),
                format_fixed(float(np.sqrt(np.square(errors).mean()))),
                format_fixed(nees),
                format_fixed(worst, 3) if worst else "-",
                format_fixed(1e3 * float(np.median([draw.seconds for draw in draws])), 1),
            )
        )
    head = ("calibrated", "parameters", "draws", "error / bound", "NEES / dof", "of a wheel [%]", "time [ms]")
    names = ("ours", *METHODS)
    lines = [
        (
            f"{looks} looks, {spread:g} rad",
            what,
            *(format_fixed(scale * _rms([one[name][k] for one in found])) for name in names),
        )
        for (looks, spread), found in compared.items()
        for k, (what, scale) in enumerate((("position [mm]", 1e3), ("rotation [mrad]", 1e3)))
    ]
    return Report(
        name="calibration",
        title="Calibrated parameters against the Cramér-Rao bound, and hand-eye beside OpenCV",
        tables=(
            ReportTable("Errors of calibrated parameters, over the Cramér-Rao bound", head, tuple(rows)),
            ReportTable(
                "Pose of a camera, its marker unknown too", ("looks, spread", "error", *names), tuple(lines)
            ),
        ),
        numbers={
            "seed": SEED,
            "noise": {"position": POSITION, "orientation": ORIENTATION, "pixel": PIXEL},
            "cases": {name: draws for name, (_, draws) in cases.items()},
            "hand_eye": {
                f"{looks} looks, {spread:g} rad": found for (looks, spread), found in compared.items()
            },
        },
        figure=Figure(lambda canvas: draw_hand_eye(canvas, compared), (11.0, 4.0)),
    )


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def draw_hand_eye(canvas: Canvas, compared: HandEye) -> None:
    panels: Any = canvas.subplots(1, 2)
    names = ("ours", *METHODS)
    for k, (axes, title) in enumerate(zip(panels, ("position [mm]", "rotation [mrad]"), strict=True)):
        for n, ((looks, spread), found) in enumerate(compared.items()):
            heights = [1e3 * _rms([one[name][k] for one in found]) for name in names]
            axes.bar(
                np.arange(len(names)) + 0.2 * n - 0.3, heights, 0.2, label=f"{looks} looks, {spread:g} rad"
            )
        axes.set(yscale="log", ylabel=f"root mean square error of {title}")
        axes.set_xticks(range(len(names)), names)
    panels[0].legend()


def _missing(name: str) -> MissingDependencyError:
    return MissingDependencyError(f"This experiment needs {name}: {install_distribution(STUDIES, 'peers')}")
