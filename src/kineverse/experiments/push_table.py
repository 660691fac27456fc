"""Pushes of the papers' Table I: twelve objects of a kitchen and the folding door, by three robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from kineverse.articulations import FoldingDoor
from kineverse.formats import load
from kineverse.manipulation.push_trials import PushTrial, try_push
from kineverse.model import Model
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.spatial import rpy, translation
from kineverse.state import State
from kineverse.worlds import World

OPENED = 0.4
"""Value from which objects are pushed shut [m], [rad]."""
OBJECTS = (
    "fridge_door",
    "oven_door",
    "dishwasher_door",
    "fridge_lower_drawer",
    "oven_left_drawer",
    "oven_middle_lower_drawer",
    "oven_middle_upper_drawer",
    "oven_right_drawer",
    "sink_left_bottom_drawer",
    "sink_left_middle_drawer",
    "sink_left_upper_drawer",
    "sink_trash_drawer",
)
FOLDING_DOOR = "cupboard"
START_POSES = {
    "pr2": {
        "l_elbow_flex_joint": -2.1213,
        "l_shoulder_lift_joint": 1.2963,
        "l_wrist_flex_joint": -1.16,
        "r_shoulder_pan_joint": -1.2963,
        "r_shoulder_lift_joint": 1.2963,
        "r_upper_arm_roll_joint": -1.2,
        "r_elbow_flex_joint": -2.1213,
        "r_wrist_flex_joint": -1.05,
        "r_forearm_roll_joint": 3.14,
        "torso_lift_joint": 0.32,
    },
    "fetch": {
        "shoulder_pan_joint": 0.3,
        "shoulder_lift_joint": 1.4,
        "upperarm_roll_joint": -1.57,
        "elbow_flex_joint": 1.72,
        "forearm_roll_joint": -1.2,
        "wrist_flex_joint": 1.66,
        "torso_lift_joint": 0.2,
    },
    "hsr": {"arm_lift_joint": 0.4},
}
"""The papers' start poses by robot and joint [rad], [m]; the HSR's torso follows its arm."""


def push_world_model(robot: str, what: str) -> tuple[ModelView, State]:
    """Return the model of a shipped robot and an object, and the state with the object open.

    Parameters
    ----------
    robot
        Name of a shipped robot.
    what
        One of :data:`OBJECTS` of the shipped kitchen, or :data:`FOLDING_DOOR`.
    """
    model: Model = load(robot)
    if what == FOLDING_DOOR:
        pose = translation(1.0, 0.0, 0.7) @ rpy(0.0, 0.0, 0.57)
        with model.edit() as edit:
            edit.apply(FoldingDoor(name=what, parent=WORLD, origin=Pose.from_matrix(pose)))
        name = what
    else:
        model.include("kitchen", prefix="kitchen")
        name = f"kitchen/{what}"
    opened = min(OPENED, model.limits(name)[1])
    pose_values = {f"{robot}/{joint}": value for joint, value in START_POSES[robot].items()}
    return model, model.default_state().updated({**pose_values, name: opened})


def push_rows(
    make_world: Callable[[ModelView, str], World],
    robots: Iterable[str] = tuple(START_POSES),
    objects: Iterable[str] = (*OBJECTS, FOLDING_DOOR),
    *,
    seed: int = 0,
    logic: str | None = "and",
) -> Iterator[PushTrial]:
    """Yield the trial of each robot and object: from the papers' start, else from a placed base.

    Parameters
    ----------
    make_world
        Function of a model and the robot's prefix that returns the world.
    robots, objects
        Names of robots and objects.
    seed, logic
        As for :func:`.try_push`.
    """
    for robot in robots:
        for what in objects:
            model, state = push_world_model(robot, what)
            name = what if what == FOLDING_DOOR else f"kitchen/{what}"
            yield try_push(make_world(model, robot), state, name, seed=seed, logic=logic)


def count_shut(trials: Iterable[PushTrial]) -> tuple[int, int]:
    """Return the number of trials that were done within the bars, and that of all."""
    listed = list(trials)
    good = [
        t
        for t in listed
        if t.outcome
        and t.outcome.measures["losses"] <= 1
        and t.penetration[0] <= 5e-4
        and t.violation <= 1e-6
        and math.isfinite(t.outcome.value)
    ]
    return len(good), len(listed)
