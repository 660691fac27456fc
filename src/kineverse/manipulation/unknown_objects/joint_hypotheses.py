"""Hypotheses about a joint: hinges that fit the shape of a part, and the test of the joint of a model."""

from __future__ import annotations

import math

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation import PlausibilityMonitor, pose_covariance
from kineverse.grasping.graspable_features import find_parts
from kineverse.lie import Array, adjoint, exp_se3
from kineverse.manipulation.opening import BasePlacement, PlacementSearch
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.state import State

from .joint_learning import LearnedJoint
from .part_belief import PartBelief, measure_way
from .pull_controllers import place_beside
from .unmodelled_joint import UnknownPart, find_joint, write_joint

_LEAST_RADIUS = 0.15  # distance of a bar from an edge of its part from which on a hinge may be there [m]
_STEP = 0.05  # distance of the handle between two poses of an arm [m]


def guess_hinges(unknown: UnknownPart, search: PlacementSearch, state: State) -> list[Array]:
    """Return the twists (6,) of hinges along the bar at the far edges of a part, in its axes.

    A door has its handle far from its hinge, and along it. A bar in the middle of a narrow front, as of a
    drawer, has none.
    """
    model, handle = unknown.model, unknown.handle
    search.scene.update(state)
    world_T_bar = model.fk(handle.frame)(state) @ handle.pose
    rigid = {b for b in search.others if not model.fk(b, unknown.frame).symbols}
    parts = [part for part in find_parts(search.scene) if part.body in rigid]
    x, y = world_T_bar[:3, 0], world_T_bar[:3, 1]
    extents = np.array([part.extent(np.array([-x, y, -y])) for part in parts]).max(axis=0)
    back, left, right = extents - np.array([-x, y, -y]) @ world_T_bar[:3, 3]
    twists = []
    for side, radius in ((1.0, left), (-1.0, right)):
        if radius > _LEAST_RADIUS:
            axis = np.array([0.0, 0.0, side])
            pivot = np.array([-back, side * radius, 0.0])
            twist = np.concatenate([-np.cross(axis, pivot), axis])
            twists.append(adjoint(unknown.frame_T_handle @ handle.pose) @ twist)
    return twists


def least_share(
    unknown: UnknownPart,
    search: PlacementSearch,
    placement: BasePlacement,
    state: State,
    twists: list[Array],
    distance: float,
    turn: float,
) -> float:
    """Return the least share of possible motions along which the arm of a placement holds the handle."""
    assert placement.grasp is not None
    world_T_part = np.asarray(unknown.model.fk(unknown.frame)(state))
    part_T_hand = unknown.frame_T_handle @ placement.grasp.pose
    count = len(search.moving)
    arm, base = placement.path[:1, :count], placement.path[:1, count:]
    shares = [(placement.values[-1] - placement.values[0]) / distance]
    for twist in twists:
        radius = float(np.linalg.norm(twist[:3] + np.cross(twist[3:], unknown.point)))
        angles = np.linspace(0.0, turn, max(2, round(radius * turn / _STEP) + 1))
        hands = np.array([world_T_part @ exp_se3(q * twist) @ part_T_hand for q in angles])
        _, reached = search.paths.follow(arm, base, hands[None])
        shares.append(max(0.0, float(reached[0]) - 1.0) / (len(angles) - 1))
    return float(min(shares))


_DISTANCE, _FLOOR_POSITION, _FLOOR_ORIENTATION = 1.0, 1e-3, 2e-3
"""Distance of the camera, and least standard deviations, for the test of a believed joint [m], [rad]."""
_MOVED, _TURNED = 0.01, math.radians(1.0)  # motion of furniture that is reported [m], [rad]


def watch_joint(model: Model, belief: PartBelief) -> PlausibilityMonitor | None:
    """Return a test of the joint that a model has for a part; None if it has none."""
    if find_joint(model, belief.unknown.frame) is None:
        return None
    sensors = belief.sensors
    position = float(sensors.position_noise(np.asarray(_DISTANCE)))
    noise = pose_covariance(max(position, _FLOOR_POSITION), max(sensors.orientation, _FLOOR_ORIENTATION))
    frames = [name for name in belief.seen if name in model.frames]
    return PlausibilityMonitor(model, frames, noise=noise, outliers=sensors.outliers > 0.0 or None)


def judge_believed_joint(model: Model, belief: PartBelief) -> str:
    """Return the verdict on a model's joint: nothing, explains, cannot tell or refuted."""
    if belief.monitor is None:
        return "nothing"
    tag = model.history.writers(f"frames/{belief.unknown.frame}")[-1]
    report = belief.monitor.report()
    if tag in {verdict.tag for verdict in report.implausible}:
        return "refuted"
    certain = any(verdict.explains for verdict in report.verdicts if verdict.tag == tag)
    return "explains" if certain else "cannot tell"


def revise_joint(model: Model, belief: PartBelief, learned: LearnedJoint) -> tuple[str, str]:
    """Write a learned joint into a model that had another one or none, and return the verdict and a text.

    Furniture that stands elsewhere than the model has it is put where it was seen.
    """
    words = f"Its joint is {learned.family}, certain after {100 * learned.distance:.1f} cm and "
    words += f"{math.degrees(learned.turn):.1f}°."
    if belief.beside != WORLD:
        before = np.asarray(model.fk(belief.beside)({}))
        away, turned = measure_way(before, belief.reference_pose, np.zeros(3))
        if away > _MOVED or turned > _TURNED:
            place_beside(model, belief)
            words += f" '{belief.beside}' stands {100 * away:.0f} cm from where it was believed."
    verdict = judge_believed_joint(model, belief)
    if verdict == "explains":
        return verdict, f"{words} The model's joint explains what was seen, and stays."
    if verdict == "cannot tell":
        return verdict, f"{words} What was seen does not refute the model's joint, which stays."
    if verdict == "refuted":
        words += " It is not as the model had it."
    try:
        write_joint(model, belief.unknown.frame, learned.fit, belief.beside)
    except KineverseError as error:
        return verdict, f"{words} It could not be written: {error}"
    return verdict, f"{words} It is in the model now."
