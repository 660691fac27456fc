"""Robots with wrong geometry, and looks at them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse.estimation.calibration.corrections import corrected_operation, find_corrections
from kineverse.lie import Array, exp_so3, retract, transform

PALM, CAMERA = "pr2/r_gripper_palm_link", "camera"
ARM = (
    "shoulder_pan",
    "shoulder_lift",
    "upper_arm_roll",
    "elbow_flex",
    "forearm_roll",
    "wrist_flex",
    "wrist_roll",
)
FREE = [*(f"offset pr2/r_{joint}_joint" for joint in ARM), "mount camera"]
JOINTS = [*(f"pr2/r_{joint}_joint" for joint in ARM), "pr2/head_pan_joint", "pr2/head_tilt_joint"]
NOISE = (0.003, float(np.radians(0.5)))  # [m], [rad]

Looks = list[tuple[dict[str, float], dict[tuple[str, str], Array]]]


def pr2_with_camera() -> kv.Model:
    model = kv.load("pr2")
    with model.edit() as edit:
        place = kv.translation(0.1, 0.02, 0.1) @ kv.rpy(-np.pi / 2, 0, -np.pi / 2)
        edit.add_frame(CAMERA, "pr2/head_tilt_link", place)
    return model


def corrected(model: kv.Model, free: Sequence[str], values: Mapping[str, float]) -> kv.Model:
    """Return a copy of a model with corrections by numbers, by name; those without one are 0."""
    result, by_tag = model.copy(), dict[str, list[Any]]()
    for correction in find_corrections(model, free):
        by_tag.setdefault(correction.tag, []).append(correction)
    with result.edit() as edit:
        for tag, group in by_tag.items():
            numbers = [[values.get(str(s), 0.0) for s in one.symbols] for one in group]
            edit.replace(tag, corrected_operation(model.history.operation(tag), group, numbers))
    return result


def wrong_arm(rng: np.random.Generator) -> dict[str, float]:
    """Return offsets of the arm and an error of the camera's mount."""
    values = {f"pr2/r_{joint}_joint/offset": rng.normal(0, 0.03) for joint in ARM}
    values |= {f"camera/d{axis}": rng.normal(0, 0.02) for axis in "xyz"}
    return values | {f"camera/r{axis}": rng.normal(0, 0.05) for axis in "xyz"}


def arm_states(model: kv.Model, count: int, rng: np.random.Generator) -> list[dict[str, float]]:
    states = []
    for _ in range(count):
        limits = {name: np.clip(model.limits(name), -1.5, 1.5) for name in JOINTS}
        states.append({name: float(rng.uniform(*limit)) for name, limit in limits.items()})
    return states


class SimulatedLooks(NamedTuple):
    looks: Looks
    bad: npt.NDArray[np.bool_]  # mask of gross errors


def look_at(
    truth: kv.Model,
    states: Sequence[dict[str, float]],
    rng: np.random.Generator,
    *,
    noise: tuple[float, float] = NOISE,
    bad: float = 0.0,  # share of gross errors
    frame: str = PALM,
    camera: str = CAMERA,
) -> SimulatedLooks:
    pose = kv.compile(truth.fk(frame, camera))
    mask = rng.permutation(len(states)) < round(bad * len(states))
    looks: Looks = []
    for state, is_bad in zip(states, mask, strict=True):
        seen = pose([state[name] for name in pose.names])
        if is_bad:
            seen = random_pose(rng, seen[:3, 3])
        error = np.concatenate([rng.normal(0, noise[0], 3), rng.normal(0, noise[1], 3)])
        looks.append((state, {(frame, camera): retract(seen, error)}))
    return SimulatedLooks(looks, mask)


def random_pose(rng: np.random.Generator, near: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Return a pose with any orientation within half a metre."""
    return transform(exp_so3(rng.normal(size=3) * 2.0), np.asarray(near) + rng.uniform(-0.5, 0.5, 3))


class HandEye(NamedTuple):
    """Camera on the hand of a Panda that sees a marker in the room; both mounts are unknown."""

    model: kv.Model
    looks: Looks
    camera: Array
    hands: list[Array]


HAND, BASE = "panda_link8", "panda_link0"


def hand_eye(rng: np.random.Generator, count: int, spread: float) -> HandEye:
    """Return looks with joints within a spread [rad] of a home, from nonsense mounts."""
    model = kv.load("panda")
    prefix = next(frame for frame in model.frames if frame.endswith(HAND))[: -len(HAND)]
    hand, base = prefix + HAND, prefix + BASE
    truth = model.copy()
    camera = transform(exp_so3(rng.normal(0, 0.3, 3)), np.array([0.05, 0.0, 0.08]) + rng.normal(0, 0.05, 3))
    marker = transform(exp_so3(np.array([0.0, 2.5, 0.0]) + rng.normal(0, 0.5, 3)), rng.uniform(-0.7, 0.7, 3))
    for one, mounts in ((truth, (camera, marker)), (model, (random_pose(rng), random_pose(rng)))):
        with one.edit() as edit:
            edit.add_frame("eye", hand, mounts[0])
            edit.add_frame("marker", base, mounts[1])
    move = kv.compile(model.fk(hand, base))
    home = np.array([0.0, -0.6, 0.3, -1.9, 0.2, 1.6, 0.5])
    states = [
        dict(zip(move.names, (home + rng.uniform(-spread, spread, 7)).tolist(), strict=True))
        for _ in range(count)
    ]
    looks = look_at(truth, states, rng, frame="marker", camera="eye").looks
    return HandEye(model, looks, camera, [move(state) for state in states])
