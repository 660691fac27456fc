"""Skills as the experiments call them: trials of openings and of pushes in a world."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

from kineverse.errors import KineverseError
from kineverse.grasping import find_gripper, find_handle
from kineverse.manipulation import Outcome, Session, open_object
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.pushing.trials import try_push
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.worlds import Judge, World

from .setting import TrialSetting, TrialWatch, list_series
from .trials import Failure, Trial, find_failure

DT = 0.02
"""Control period [s]."""
_PLANS = ("plan", "place", "placement")
"""Computations that are no control steps, by the first word of their names in a session."""


@dataclass(frozen=True)
class TrialCase:
    """One robot at one object, in one setting."""

    case: str  # kitchen, or name of the set-up
    robot: RobotSource
    what: str  # coordinate of the object
    setting: TrialSetting
    seed: int = 0  # seed of the skill's searches
    film: bool = False  # whether the trial has commanded speeds as series, and a film
    measures: tuple[tuple[str, Any], ...] = ()  # further figures of the trial

    def run(self, skill: str, model: Model, act: Callable[[TrialWatch], Outcome]) -> Trial:
        """Return the trial of a skill. Any error is a failure of the class ``other``, and is named."""
        setting, begin = self.setting, process_time()
        about = {
            "case": self.case,
            "robot": self.robot.name,
            "what": self.what.rpartition("/")[2],
            "skill": skill,
            "world": setting.world,
        }
        with TrialWatch(setting, model, about, film=self.film) as watch:
            try:
                outcome = act(watch)
            except Exception as error:  # one of many trials must not end the others
                reason = f"{type(error).__name__}: {error}"
                outcome = Outcome(False, math.nan, reason, setting.world, 0.0, 0, {"failure": "other"})
            watch.write_outcome(outcome)
        session = watch.session
        cpu, wall = ({}, {}) if session is None else (session.cpu, session.wall)
        names = [name for name in cpu if not name.startswith(_PLANS)]
        return Trial(
            self.case,
            self.robot.name,
            self.what,
            skill,
            outcome.done,
            float(outcome.value),
            find_failure(outcome),
            outcome.reason,
            float(outcome.seconds),
            int(outcome.steps),
            tuple(t for name in names for t in cpu[name]),
            tuple(t for name in names for t in wall[name]),
            {**dict(self.measures), **outcome.measures, "cpu_seconds": process_time() - begin},
            setting.world,
            setting.noise,
            self.robot.count_freedom(model),
            list_series(watch.commands) if self.film else {},
            tuple(watch.moments),
        )

    def fail(self, skill: str, model: Model, failure: Failure, reason: str) -> Trial:
        """Return the trial of a skill that was not begun."""
        outcome = Outcome(False, math.nan, reason, self.setting.world, 0.0, 0, {"failure": failure})
        return self.run(skill, model, lambda watch: outcome)


def open_then_close(
    case: TrialCase, model: Model, world: World, start: State, targets: tuple[float, float]
) -> list[Trial]:
    """Return the trials of opening an object in a world and, if that was done, of closing it.

    Closing knows the ways on which the object was opened.
    """
    world.reset(start)
    trials: list[Trial] = []
    session: Session | None = None
    for skill, target in zip(("open", "close"), targets, strict=True):

        def act(watch: TrialWatch, target: float = target) -> Outcome:
            nonlocal session
            earlier = session
            session = watch.open_session(world, DT)
            if earlier is not None:
                session.made.extend(earlier.made)
                session.start = earlier.start
            return open_object(session, case.what, target=target, seed=case.seed)

        trials.append(case.run(skill, model, act))
        if not trials[-1].done:
            break
    return trials


def run_push_trial(
    case: TrialCase,
    model: Model,
    world: World,
    start: State,
    skill: str,
    *,
    dt: float = DT,
    steps: int = 1200,
    logic: str | None = "and",
) -> Trial:
    """Return the trial of a push in a world: from a start, or from one that base placement finds."""

    def act(watch: TrialWatch) -> Outcome:
        judge = PushJudge(model, world, case.what, watch)
        found = try_push(
            world,
            start,
            case.what,
            dt=dt,
            steps=steps,
            seed=case.seed,
            logic=logic,
            open_session=lambda world, look: watch.open_session(world, dt, look, judge),
            on_step=judge.watch_controller,
        )
        own = {"placed": found.placed, "first": found.first, "pressed": found.pressed}
        return replace(found.outcome, measures={**found.outcome.measures, **judge.measures, **own})

    return case.run(skill, model, act)


class PushJudge:
    """Judge of a push, which is called after each step of its session."""

    def __init__(self, model: Model, world: World, what: str, watch: TrialWatch) -> None:
        try:
            handle = find_handle(model, what).frame
        except KineverseError:
            handle = None
        gripper = find_gripper(model, world.robot)
        self._judge = Judge(model, world.robot, gripper, handle)
        self._watch, self._pushing, self._force = watch, False, 0.0
        self._session: Session | None = None

    def watch_controller(self, pushing: Pushing) -> None:
        """Note whether the controller pushes, and what it sees."""
        self._pushing, self._watch.view = pushing.touching, pushing.view

    def __call__(self, session: Session) -> None:
        """Judge a step."""
        if session is not self._session:
            self._session, self._pushing, self._force = session, False, 0.0
            self._judge.reset()
        world = session.world
        self._judge.update(world.state, session.commands, held=world.held, pushing=self._pushing)
        self._force = max(self._force, getattr(world, "peak_force", math.nan))

    @property
    def measures(self) -> dict[str, Any]:
        """Measures of the judge; ``peak_force`` [N] in a world that has it."""
        return {**self._judge.measures, "peak_force": self._force or math.nan}
