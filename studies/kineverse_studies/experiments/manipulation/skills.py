"""Skills as the experiments call them: robots, worlds, recordings, and trials of openings and pushes."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from kineverse.errors import FormatError, InvalidValueError, UnknownNameError
from kineverse.grasping import find_handle
from kineverse.manipulation import (
    Belief,
    JudgedOutcome,
    Outcome,
    Session,
    TrackedBelief,
    judge_outcome,
    open_object,
    push,
    stand_at_handle,
)
from kineverse.manipulation.pushing.base_placement import find_push_start
from kineverse.manipulation.pushing.push_controller import Pushing
from kineverse.manipulation.robot_sources import SHIPPED, RobotSource, find_robot
from kineverse.manipulation.skill_run import find_object_coordinate
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.worlds import (
    KinematicWorld,
    MujocoWorld,
    Recorder,
    RunMetrics,
    Sensors,
    SimulatedWorld,
    TrueBelief,
)
from kineverse.worlds.recorder import import_mcap
from kineverse_studies.experiments.registry import BOTH, WORLDS, Options

from .paper_push import push_as_published
from .trials import Failure, Moment, Trial, find_failure

_AUTHORS = {
    "pr2 (authors)": ("pr2", "pr2/pr2_description/robots/pr2.urdf", "r_gripper_palm_link"),
    "fetch (authors)": ("fetch", "fetch/fetch_description/robots/fetch.urdf", "gripper_link"),
    "hsr (authors)": ("hsr", "hsrb/hsrb_description/robots/hsrb.urdf", "hand_palm_link"),
}
DATA_FOLDERS = ("pr2", "fetch", "hsrb", "iai_kitchen")


def check_data(data: Path | None) -> Path | None:
    if data is None:
        return None
    if not data.is_dir():
        raise InvalidValueError(
            f"There is no folder {data} with robots. Leave --data out for the shipped ones."
        )
    if not any((data / name).is_dir() for name in DATA_FOLDERS):
        raise InvalidValueError(
            f"The folder {data} has none of {', '.join(DATA_FOLDERS)}, so nothing of the authors is in it."
        )
    return data


def find_robots(names: Iterable[str] = (), data: Path | None = None) -> tuple[RobotSource, ...]:
    """Return robots by name, the authors' in a folder first; by default these and those that ship."""
    known, own, folder = dict(SHIPPED), dict[str, RobotSource](), check_data(data)
    for name, (like, file, hand) in _AUTHORS.items() if folder is not None else ():
        source = (folder or Path()) / file
        if source.is_file():
            known[name] = own[like] = replace(SHIPPED[like], name=name, source=str(source), hand=hand)
    return tuple(own.get(name) or find_robot(name, known) for name in tuple(names) or known)


SettingOptions = ("world", "noise", "record")  # options of experiments that are read here
_USUAL_STEP = 0.02  # longest step for which the worlds have their own time-outs [s]
_FILM_STEPS = 5  # number of steps from one moment of a film to the next


@dataclass(frozen=True)
class TrialSetting:
    world: str = WORLDS[0]
    noise: str = ""
    record: Path | None = None  # folder of recordings; None for none

    def make_world(
        self, model: Model, robot: str, state: StateLike, seed: int = 0, dt: float = _USUAL_STEP
    ) -> SimulatedWorld:
        """Return the world at a state, in which nothing is held, for steps of a length [s]."""
        kind = MujocoWorld if self.world == "mujoco" else KinematicWorld
        sensors = Sensors.parse(self.noise) if self.noise else None
        # Commands come at least every second step, also where an estimate is a picture old.
        more: dict[str, Any] = {"timeout": 2.0 * dt} if dt > _USUAL_STEP else {}
        world: SimulatedWorld = kind(model, robot, sensors=sensors, seed=seed, **more)
        world.reset(state)
        return world

    def make_belief(self, world: SimulatedWorld) -> Belief:
        """Return the belief on which a skill acts: the truth without noise, else an estimate."""
        if not self.noise:
            return TrueBelief(world)
        return TrackedBelief(world.model, world.robot, Sensors.parse(self.noise))


def make_record_folder(folder: Path) -> None:
    import_mcap("mcap.writer")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"--record {folder}: {error.strerror}. Name a folder.") from None


def make_settings(options: Options) -> tuple[TrialSetting, ...]:
    noise = "" if options.noise is None else str(Sensors.parse(options.noise))
    if options.record is not None:
        make_record_folder(options.record)
    worlds = WORLDS if options.world == BOTH else (options.world,)
    return tuple(TrialSetting(world, noise, options.record) for world in worlds)


class TrialWatch(ExitStack):
    def __init__(
        self,
        setting: TrialSetting,
        model: ModelView,
        world: SimulatedWorld | None,
        about: Mapping[str, str],
        *,
        film: bool = False,
    ) -> None:
        super().__init__()
        self._setting, self._model, self._world, self._about = setting, model, world, about
        self._film = film
        self._recorder: Recorder | None = None
        self._watchers: tuple[Callable[[Session], object], ...] = ()
        self.session: Session | None = None
        self.moments: list[Moment] = []
        self.commands: list[tuple[float, dict[str, float]]] = []

    def __enter__(self) -> TrialWatch:
        if self._setting.record is not None:
            name = "-".join(re.sub(r"[^\w]+", "_", word).strip("_") for word in self._about.values())
            path = self._setting.record / f"{name}.mcap"
            recorder = Recorder(path, self._model, self._about, world=self._world)
            self._recorder = self.enter_context(recorder)
        return self

    def open_session(self, dt: float, *watchers: Callable[[Session], object]) -> Session:
        assert self._world is not None
        self._watchers = watchers
        self.moments, self.commands = [], []
        belief = self._setting.make_belief(self._world)
        self.session = Session(self._world, dt=dt, belief=belief, on_step=self._look)
        return self.session

    def write_outcome(self, outcome: Outcome) -> None:
        if self._recorder is not None:
            self._recorder.write_outcome(outcome)

    def _look(self, session: Session) -> None:
        for watch in self._watchers:
            watch(session)
        if self._recorder is not None:
            self._recorder(session)
        if not self._film:
            return
        assert self._world is not None
        begin = session.time - session.dt
        self.commands.append((begin, {str(s): float(v) for s, v in session.commands.items()}))
        if session.steps % _FILM_STEPS == 0:
            values = {str(s): float(v) for s, v in self._world.state.items()}
            self.moments.append(Moment(session.time, session.phase, values, session.vectors))


def list_series(commands: Iterable[tuple[float, Mapping[str, float]]]) -> dict[str, list[float]]:
    """Return commanded speeds as series by name, 0 where a speed is not given, and ``time`` [s]."""
    rows = list(commands)
    names = dict.fromkeys(name for _, speeds in rows for name in speeds)
    return {
        "time": [time for time, _ in rows],
        **{name: [speeds.get(name, 0.0) for _, speeds in rows] for name in names},
    }


DT = 0.02  # control period [s]
_SAMPLES = 200  # of the base placement


@dataclass(frozen=True)
class TrialCase:
    case: str  # kitchen, or name of the set-up
    robot: RobotSource
    what: str  # coordinate of the object
    setting: TrialSetting
    seed: int = 0  # seed of the skill's searches
    film: bool = False  # whether the trial has commanded speeds as series, and a film
    measures: tuple[tuple[str, Any], ...] = ()  # further figures of the trial

    def run(
        self,
        skill: str,
        model: ModelView,
        act: Callable[[TrialWatch], Outcome],
        world: SimulatedWorld | None = None,
    ) -> Trial:
        """Return the trial of a skill. Any error is a failure of the class ``other``, and is named."""
        setting, begin = self.setting, process_time()
        about = {
            "case": self.case,
            "robot": self.robot.name,
            "what": self.what.rpartition("/")[2],
            "skill": skill,
            "world": setting.world,
        }
        with TrialWatch(setting, model, world, about, film=self.film) as watch:
            try:
                outcome = act(watch)
            except Exception as error:  # one of many trials must not end the others
                reason = f"{type(error).__name__}: {error}"
                outcome = Outcome(False, math.nan, reason, setting.world, 0.0, 0, {"failure": "other"})
            watch.write_outcome(outcome)
        session = watch.session
        cpu, wall = ({}, {}) if session is None else (session.cpu, session.wall)
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
            tuple(t for times in cpu.values() for t in times),
            tuple(t for times in wall.values() for t in times),
            {**dict(self.measures), **outcome.measures, "cpu_seconds": process_time() - begin},
            setting.world,
            setting.noise,
            self.robot.count_freedom(model),
            list_series(watch.commands) if self.film else {},
            tuple(watch.moments),
        )

    def fail(self, skill: str, model: ModelView, failure: Failure, reason: str) -> Trial:
        outcome = Outcome(False, math.nan, reason, self.setting.world, 0.0, 0, {"failure": failure})
        return self.run(skill, model, lambda watch: outcome)


def open_then_close(
    case: TrialCase, world: SimulatedWorld, start: State, targets: tuple[float, float]
) -> list[Trial]:
    world.reset(start)
    trials: list[Trial] = []
    session: Session | None = None
    for skill, target in zip(("open", "close"), targets, strict=True):

        def act(watch: TrialWatch, target: float = target) -> Outcome:
            nonlocal session
            coordinate, gripper = find_object_coordinate(world.robot, case.what), world.robot.gripper()
            handle = find_handle(world.model, coordinate)
            metrics = RunMetrics(world, coordinate, gripper=gripper, handle=handle.frame, start=start)
            earlier, session = session, watch.open_session(DT, metrics)
            if earlier is not None:
                session.made.extend(earlier.made)
                session.start = earlier.start
            if stand_at_handle(session, world, handle, target, gripper=gripper, seed=case.seed):
                metrics.reset()
            outcome = open_object(
                session, coordinate, target=target, hand=gripper, handle=handle, seed=case.seed
            )
            return judge_outcome(outcome, metrics)

        trials.append(case.run(skill, world.model, act, world))
        if not trials[-1].done:
            break
    return trials


def try_push(
    pushing: Pushing,
    world: SimulatedWorld,
    start: State,
    metrics: RunMetrics,
    open_session: Callable[[], Session],
    *,
    seconds: float = 24.0,
    seed: int = 0,
) -> tuple[JudgedOutcome, int, str]:
    """Push from a start; if that fails, from one that base placement finds.

    Return the outcome, the number of samples of the placement, 0 without any, and why the first push failed.
    """

    def attempt(state: State) -> JudgedOutcome:
        world.reset(state)
        metrics.reset()
        session = open_session()
        outcome = push(session, pushing.coordinate, seconds=seconds, pushing=pushing, plan=False)
        return judge_outcome(outcome, metrics)

    outcome = attempt(start)
    if outcome:
        return outcome, 0, ""
    found = find_push_start(pushing, start, samples=_SAMPLES, seed=seed)
    return attempt(found.state) if found.state is not None else outcome, found.samples, outcome.reason


def run_push_trial(
    case: TrialCase,
    world: SimulatedWorld,
    start: State,
    skill: str,
    *,
    dt: float = DT,
    steps: int = 1200,
    logic: str | None = "and",
    baseline: bool = False,
) -> Trial:
    """Return the trial of a push: from a start, or from one that base placement finds; or as published."""

    def act(watch: TrialWatch) -> Outcome:
        coordinate, gripper = find_object_coordinate(world.robot, case.what), world.robot.gripper()
        try:
            handle = find_handle(world.model, coordinate).frame
        except UnknownNameError:
            handle = None
        world.reset(start)
        metrics = RunMetrics(world, coordinate, gripper=gripper, handle=handle)
        begin = partial(watch.open_session, dt, metrics)
        if baseline:
            outcome = push_as_published(begin(), world, case.robot, coordinate, steps)
            return replace(outcome, measures={**outcome.measures, **metrics.measures, "placed": 0})
        pushing = Pushing(
            world.model, world.robot, coordinate, gripper.bodies, start, target=0.0, dt=dt, logic=logic
        )
        outcome, placed, first = try_push(
            pushing, world, start, metrics, begin, seconds=steps * dt, seed=case.seed
        )
        return replace(outcome, measures={**outcome.measures, "placed": placed, "first": first})

    return case.run(skill, world.model, act, world)
