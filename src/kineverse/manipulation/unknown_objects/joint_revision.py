"""Revision of a model's joint: it is tested, and a learned one takes its place if it is refuted."""

from __future__ import annotations

import math

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation import PlausibilityMonitor, pose_covariance
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .joint_learning import LearnedJoint
from .part import find_joint, write_joint
from .part_belief import PartBelief, measure_way
from .pull_controllers import place_beside

_DISTANCE, _FLOOR_POSITION, _FLOOR_ORIENTATION = 1.0, 1e-3, 2e-3
"""Distance of the camera, and least standard deviations, for the test of a believed joint [m], [rad]."""
_MOVED, _TURNED = 0.01, math.radians(1.0)
"""Distance [m] and angle [rad] of furniture from where it was believed that are reported."""


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
    words = f"Its joint is {learned.family}, certain after {100 * learned.way:.1f} cm and "
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
