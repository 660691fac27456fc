"""The papers' push controller (2020 paper, eq. 5-11), a baseline for :mod:`kineverse.manipulation.pushing`.

It follows the nearest points r of one link and p of the handle, with the normal n from p to r, which are
numbers in each step. As in the authors' code, other parts that will move are not avoided.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.control import Command, Controller, Goal, Keep, Target
from kineverse.control.tasks import Task
from kineverse.expressions.functions import sqrt
from kineverse.geometry import Scene
from kineverse.grasping import find_handle
from kineverse.lie import inverse
from kineverse.logic import less
from kineverse.manipulation import Outcome, Session
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import PlannedContact, SimulatedWorld

CONTACT = 0.01  # gap below which the object may move, ε of the 2020 paper [m]
_FAR, _ANY, _TOLERANCE = 20.0, 1e3, 0.02


class PaperPush:
    def __init__(self, model: ModelView, what: Symbol, link: str, handle: str, dt: float) -> None:
        self.contact = PlannedContact((link,), (), False)  # nothing but a handle may be penetrated
        self._scene, self._link, self._frames = Scene(model), link, (model.fk(link), model.fk(handle))
        self._nearest = self._scene.watch(link, handle, _FAR)
        self._numbers = Target("push/contact", np.zeros((3, 3)))
        *points, n = self._numbers.expression
        r, p = (frame[:3, :3] @ x + frame[:3, 3] for frame, x in zip(self._frames, points, strict=True))
        d, slope, speed = (r - p) @ n, p.jacobian([what])[:, 0], what.derivative()
        v = np.cross(np.cross(-slope / sqrt(slope @ slope + 1e-9), n), n)
        allowed = _ANY * less(d, CONTACT)
        tasks: list[Task] = [
            Goal(what, 0.0, name="object"),
            Goal(p + d * v - r, 0.0, name="reach"),
            Keep(0.0, d, math.inf, name="impenetrable"),
            Keep(-math.inf, (slope @ n) * speed, 0.0, name="push, never pull"),
            Keep(-allowed, speed, allowed, name="still unless touched"),
        ]
        self.controller = Controller(model, tasks, dt=dt)

    def step(self, state: State) -> Command:
        self._scene.update(state)
        near = self._nearest()[0]
        near = near if near.a == self._link else near.swap()
        points = zip(self._frames, (near.point_a, near.point_b), strict=True)
        inside = [(inverse(np.asarray(frame(state))) @ [*point, 1.0])[:3] for frame, point in points]
        self.controller.set(self._numbers, [*inside, -near.normal])
        self.contact = self.contact._replace(touching=near.distance < CONTACT)
        return self.controller.step(state)


def push_as_published(
    session: Session, world: SimulatedWorld, robot: RobotSource, what: Symbol, steps: int
) -> Outcome:
    """Push an object to 0 by the papers' controller alone, in at most so many steps."""
    model, link = session.model, f"{robot.prefix}/{robot.push_link}"
    push = PaperPush(model, what, link, find_handle(model, what).frame, session.dt)
    while session.steps < steps and abs(world.state[what]) >= _TOLERANCE:
        with session.timed("push"):
            command = push.step(session.state)
        session.contact = push.contact
        session.act(command.speeds, command)
    value = world.state[what]
    done = abs(value) < _TOLERANCE
    reason = f"'{what}' is at {value:.3g}" if done else f"Out of time at {value:.3g}."
    return Outcome(done, value, reason, world.name, session.time, session.steps)
