"""Clip of the README: a robot opens an oven, a fridge and a drawer, by one controller for all joints."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.control import Controller, Goal, Hold, Keep, same_pose
from kineverse.manipulation import place_robot
from kineverse.view import Camera
from kineverse.view.clips import ClipMoment, draw_clip

TOUR = {"kitchen/oven_door": 1.35, "kitchen/fridge_door": 1.35, "kitchen/sink_left_upper_drawer": 0.38}
"""Coordinates that are opened, and how far [rad], [m]."""

EYE = Camera((-2.3, -2.9, 2.6), (0.55, 0.0, 0.75), field_of_view=0.72)
SIZE, COUNT, REST = (860, 480), 88, 12  # of the pictures [pixels], their number, and that of the last one
PERIOD, LONGEST = 0.04, 400  # of the controller [s], and most steps of a phase
FINGERS, OPEN, HOLDING, FINGER_SPEED = "hsr/hand_motor_joint", 1.0, 0.15, 1.5  # [rad], [rad/s]


def open_everything() -> tuple[kv.Model, list[kv.State]]:
    """Return the kitchen with the robot, and the states in which it opens one object after the other."""
    model = kv.load("kitchen")
    robot = place_robot(model, "hsr")
    state = robot.start_state(model)
    hand, fingers = model.fk("hsr/hand_palm_link"), model.symbol(FINGERS)
    objects = [s for s in model.degrees_of_freedom if str(s).startswith("kitchen/")]
    states = [state]

    def follow(goal: Goal | Hold, free: str, near: float, grip: float, *more: Goal) -> None:
        """Move the hand until its task is done to ``near``; of the kitchen, only ``free`` may move."""
        still = [Keep(0, s.derivative(), 0, name=str(s)) for s in objects if str(s) != free]
        fist = Goal(fingers, grip, speed=FINGER_SPEED, name="fingers")
        controller = Controller(model, [goal, fist, *more, *still], dt=PERIOD)
        for _ in range(LONGEST):
            command = controller.step(states[-1])
            states.append(model.integrate(states[-1], command.speeds, PERIOD))
            last = more[-1] if more else goal
            if command.residuals[last.name] < near and command.residuals["fingers"] < 0.1:
                return
        raise RuntimeError(f"{goal.name} is not reached")

    for name, opened in TOUR.items():
        grasp = model.fk(f"{name}_handle") @ kv.rpy(np.pi / 2, 0, np.pi)
        before = grasp @ kv.translation(-0.15, 0, 0)
        phases = (
            (Goal(same_pose(before, hand), name="before", gain=1.5, speed=0.6), "", 0.02, OPEN),
            (Goal(same_pose(grasp, hand), name="grasp", gain=3, speed=0.3), "", 0.004, OPEN),
            (Goal(same_pose(grasp, hand), name="close", gain=3), "", 0.004, HOLDING),
            (
                Hold(same_pose(hand, grasp), name="hold"),
                name,
                0.02,
                HOLDING,
                Goal(model.symbol(name), opened, speed=0.4, name="open"),
            ),
            (Goal(same_pose(grasp, hand), name="release", gain=3), "", 0.004, OPEN),
            (Goal(same_pose(before, hand), name="back", gain=2, speed=0.4), "", 0.03, OPEN),
        )
        for phase in phases:
            follow(*phase)
    return model, states


def draw_tour() -> list[np.ndarray]:
    """Return the pictures of the clip."""
    model, states = open_everything()
    chosen = [states[k] for k in np.linspace(0, len(states) - 1, COUNT).astype(int)]
    pictures = list(draw_clip(model, [ClipMoment(state) for state in chosen], SIZE, EYE))
    return pictures + [pictures[-1]] * REST
