"""Motion of a held object: one quadratic program over the robot and the object."""

from __future__ import annotations

import numpy as np

from kineverse.control import Goal, Hold, Target, same_pose
from kineverse.control.tasks import Task
from kineverse.geometry import Rule, Scene
from kineverse.lie import inverse

from .hand_motion import HandMotion, row_at
from .outcome import SkillError
from .placement import BasePlacement

_SPEED = 0.3
"""Speed of an object along its planned way [m/s], [rad/s]."""
_FOLLOWING = 5.0
"""Gain of the goals along the way [1/s]."""
_LATE = 0.1
"""Distance from the way at which the reference begins to wait [m], [rad]."""
_MARGIN = 0.002
"""Least distance of bodies while the object moves [m]; placements keep more."""
_SLIPPED = 0.02
"""Distance of the hand from its grasp from which on the handle has slipped [m]."""
_STALLED, _PATIENCE = 1e-3, 4.0
"""Least progress of the object [m], [rad] in a time [s]."""


def move_held(motion: HandMotion, placement: BasePlacement, tolerance: float) -> None:
    """Move a held object along the way of a placement.

    Parameters
    ----------
    motion
        Motions of the hand that holds the object.
    placement
        Values of the object's coordinate, and configurations of the robot there.
    tolerance
        Largest distance from the last value [m], [rad].

    Raises
    ------
    SkillError
        If the object does not move on, slips out of the hand, or the time is up.
    """
    bar, hand = motion.model.fk(motion.handle.frame), motion.model.fk(motion.gripper.hand)
    session, coordinate, grasp = motion.session, motion.handle.coordinate, placement.grasp
    assert grasp is not None
    session.phase = "move"
    state = session.state
    held = inverse(bar(state)) @ hand(state)
    # A parameter: as a constant it would have every grasp compile a controller of its own.
    hold = Hold(same_pose(bar @ Target("grasp/pose", held).expression, hand), name="grasp")
    target = float(placement.values[-1])
    moving = motion.search.moving
    rows = placement.way[:, : len(moving)] + motion.turns
    values = placement.values
    posture, goals = motion.posture(rows[0])
    wanted = Target("opening/object", np.array([values[0]]))
    tasks: list[Task] = [hold, Goal(coordinate, wanted.expression[0], gain=_FOLLOWING, name="object")]
    tasks += goals
    rules = [Rule(b, motion.handle.frame, False, "grasped") for b in motion.gripper.bodies]
    scene = Scene(motion.model, rules=[*motion.search.scene.rules, *rules])
    controller = motion.controller(tasks, scene=scene, margin=_MARGIN)
    share, ends = 0.0, abs(target - values[0])
    best, since = 0.0, session.world.time
    states = [
        session.state.updated({coordinate: v}) for v in np.linspace(values[0], target, len(values)).tolist()
    ]
    motion.refer([bar(state) @ held for state in states])
    while abs(session.state[coordinate] - target) > tolerance / 4:
        motion.check_time()
        with session.timed("open"):
            reference = row_at(rows, share)
            value = values[0] + share * (target - values[0])
            controller.set(posture, reference)
            controller.set(wanted, np.array([value]))
            command = controller.step(session.state)
            # The reference waits for the slowest joint.
            late = max(
                float(np.abs(reference - session.state.vector(moving)).max(initial=0.0)),
                abs(value - session.state[coordinate]),
            )
            share += _SPEED * session.dt / ends * min(1.0, max(0.0, 1.5 - late / _LATE))
            share = min(1.0, share)
        motion.refer_to(share)
        motion.act(command.speeds, command)
        if command.residuals["grasp"] > _SLIPPED:
            raise SkillError("other", "The handle slipped out of the hand.")
        done = abs(session.state[coordinate] - values[0])
        if done > best + _STALLED:
            best, since = done, session.world.time
        elif session.world.time - since > _PATIENCE:
            stops = ", ".join(command.active[:3]) or "nothing that the controller knows; it may be locked"
            raise SkillError(
                "collision" if "contact" in stops else "other",
                f"'{coordinate}' does not move on from {session.state[coordinate]:.3f}. In the way: {stops}.",
            )
    session.reference = None
