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
from kineverse.manipulation import Outcome
from kineverse.manipulation.pushing import Pushing
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import World

from .skills import PushJudge, TrialCase, TrialWatch
from .trials import Trial

CONTACT = 0.01  # gap below which the object may move, ε of the 2020 paper [m]
_FAR, _ANY, _TOLERANCE = 20.0, 1e3, 0.02


class PaperPush:
    def __init__(self, model: Model, what: Symbol, link: str, handle: str, dt: float) -> None:
        self.touching = False
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
        self.touching = near.distance < CONTACT
        return self.controller.step(state)


def run_paper_push(
    case: TrialCase, model: Model, world: World, start: State, skill: str, *, dt: float, steps: int
) -> Trial:
    """Return the trial of the papers' controller in a world."""

    def act(watch: TrialWatch) -> Outcome:
        what, robot = model.symbol(case.what), case.robot
        link = f"{robot.prefix}/{robot.push_link}"
        pushing = Pushing(model, what, link, start, target=0.0, robot=robot.prefix, dt=dt)
        push = PaperPush(model, what, link, find_handle(model, what).frame, dt)
        judge = PushJudge(pushing, world, watch)
        world.reset(start)
        session = watch.open_session(world, dt, judge)
        while session.steps < steps and abs(world.state[what]) >= _TOLERANCE:
            with session.timed("push"):
                command = push.step(session.state)
            judge.touching = push.touching
            session.act(command.speeds)
        value = world.state[what]
        done = abs(value) < _TOLERANCE
        reason = "shut" if done else "not shut in time"
        measures = judge.measures if done else judge.measures | {"failure": "time"}
        return Outcome(done, value, reason, world.name, world.time, session.steps, measures)

    return case.run(skill, model, act)
