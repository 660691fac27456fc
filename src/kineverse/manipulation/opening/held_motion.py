"""Motion of a held object: one quadratic program over the robot and the object."""

from __future__ import annotations

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.control import Controller, Goal, Hold, Target, same_pose
from kineverse.geometry import Scene
from kineverse.lie import inverse
from kineverse.manipulation.outcome import SkillError, SlipError

from .base_placement import BasePlacement
from .hand_motion import FOLLOWING, HandMotion
from .hand_paths import row_at

_SPEED, _RAMP = 0.3, 0.5
"""Speed of an object along its planned way [m/s], [rad/s], and the time from rest to it [s]."""
_LATE = 0.1
"""Distance from the way at which the reference begins to wait [m], [rad]."""
_MARGIN = 0.002
"""Least distance of bodies while the object moves [m]; placements keep more."""
_SLIPPED, _SIGMAS = 0.008, 4.0
"""Distance of the bar from its place in the hand from which on it has slipped [m], and the standard
deviations of its estimate that are added."""
_STALLED, _PATIENCE, _RESTING = 1e-3, 4.0, 0.5
"""Least progress of the object [m], [rad] in a time [s], and in one at the end of the way."""
_LOCKED, _STANDING = 1.5, 1e-3
"""Time [s] after which an object that has not moved yet is not waited for, if the controller plans no speed
beyond some [m/s], [rad/s] for it either: its own constraints hold it."""
_SETTLED = 10
"""Number of steps for which an estimate is at the target when a motion ends."""


def move_held(motion: HandMotion, placement: BasePlacement, tolerance: float) -> None:
    """Move a held object along the way of a placement."""
    bar, hand = motion.model.fk(motion.handle.frame), motion.model.fk(motion.gripper.hand)
    session, coordinate, grasp = motion.session, motion.handle.coordinate, placement.grasp
    assert grasp is not None
    session.phase = "move"
    state = session.state
    held = inverse(bar(state)) @ hand(state)
    middle = motion.gripper.grasp_pose[:, 3]
    uncertain = [session.deviation(x) for x in ((bar @ held - hand) @ middle)[:3]]
    slipped = _SLIPPED + _SIGMAS * float(np.linalg.norm(uncertain))
    poses = compile([bar, hand], tier="interpreter")  # a call a step
    target = float(placement.values[-1])
    moving = motion.search.moving
    rows = motion.rows(placement.way)
    values = placement.values

    def make() -> tuple[Controller, tuple[Target, Target, Target, Target]]:
        # The initial values are of no run: a controller with others would be compiled for these alone.
        grasped, wanted = Target("grasp/pose", np.eye(4)), Target("opening/object", np.zeros(1))
        posture, arm_speeds, goals = motion.posture()
        hold = Hold(same_pose(bar @ grasped.expression, hand), gain=FOLLOWING, name="grasp")
        goal = Goal(coordinate, wanted.expression[0], gain=FOLLOWING, name="object")
        scene = Scene(motion.model, rules=motion.holding_rules)
        found = motion.controller([hold, goal, *goals], scene=scene, margin=_MARGIN)
        return found, (grasped, wanted, posture, arm_speeds)

    key = "held", motion.handle.frame, coordinate
    controller, (grasped, wanted, posture, arm_speeds) = motion.find_controller(key, make)
    share, speed, length = 0.0, 0.0, abs(target - values[0])
    best, since = 0.0, session.world.time
    controller.set(grasped, held)
    controller.set(arm_speeds, np.zeros(len(moving)))  # the way waits for the arm
    places = np.linspace(values[0], target, len(values)).tolist()
    motion.refer([bar(session.state.updated({coordinate: v})) @ held for v in places])
    within, enough = 0, _SETTLED if session.deviation(coordinate) else 1
    while True:
        rest = abs(session.state[coordinate] - target)
        within = within + 1 if rest <= tolerance / 4 else 0
        if within >= enough:
            return
        motion.check_time()
        with session.timed("open"):
            state = motion.state
            reference = row_at(rows, share)
            value = values[0] + share * (target - values[0])
            controller.set(posture, reference)
            controller.set(wanted, np.array([value]))
            command = controller.step(state)
            # The reference waits for the slowest joint.
            late = max(
                float(np.abs(reference - state.vector(moving)).max(initial=0.0)),
                abs(value - state[coordinate]),
            )
            speed = min(speed + _SPEED / _RAMP * session.dt, _SPEED)
            speed *= min(1.0, max(0.0, 1.5 - late / _LATE))
            share = min(1.0, share + speed * session.dt / length)
            world_T_bar, world_T_hand = poses(state.vector(poses.inputs))
            apart = float(np.linalg.norm(((world_T_bar @ held - world_T_hand) @ middle)[:3]))
        motion.refer_to(share)
        motion.act(command.speeds, command)
        if motion.is_lost() or apart > slipped:
            how = (
                "It is out of the hand."
                if motion.is_lost()
                else f"It moved {1e3 * apart:.0f} mm in the hand."
            )
            raise SlipError(f"The handle slipped at {session.state[coordinate]:.3f} of '{coordinate}'. {how}")
        done = abs(session.state[coordinate] - values[0])
        if done > best + _STALLED:
            best, since = done, session.world.time
        resting = session.world.time - since
        if share == 1.0 and rest < 0.75 * tolerance and resting > _RESTING:
            return
        planned = abs(float(command.speeds.get(coordinate.derivative(), np.inf)))
        held_fast = best == 0.0 and share < 1.0 and planned < _STANDING
        if resting > (_LOCKED if held_fast else _PATIENCE):
            stops = ", ".join(command.active[:3]) or "nothing that the controller knows; it may be locked"
            raise SkillError(
                "collision" if "contact" in stops else "other",
                f"'{coordinate}' does not move on from {session.state[coordinate]:.3f}. In the way: {stops}.",
            )
