"""Setting of trials: the world, the noise of its sensors, and recordings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from kineverse.errors import FormatError
from kineverse.manipulation import Belief, Outcome, Session, TrackedBelief, TrueBelief
from kineverse.manipulation.pushing.nearest_pair import PushView
from kineverse.model.model import Model
from kineverse.state import StateLike
from kineverse.worlds import KinematicWorld, MujocoWorld, Recorder, Sensors, World
from kineverse.worlds.recorder import import_mcap
from kineverse_studies.experiments.registry import BOTH, WORLDS, Options

from .trials import Moment

SettingOptions = ("world", "noise", "record")
"""Options of experiments that are read here."""

_USUAL_STEP = 0.02
"""Longest step for which the worlds have their own time-outs [s]."""
_FILM_STEPS = 5
"""Number of steps from one moment of a film to the next."""


@dataclass(frozen=True)
class TrialSetting:
    """World of a trial, and what is known of it."""

    world: str = WORLDS[0]
    noise: str = ""
    record: Path | None = None  # folder of recordings; None for none

    def make_world(
        self, model: Model, robot: str, state: StateLike, seed: int = 0, dt: float = _USUAL_STEP
    ) -> World:
        """Return the world at a state, in which nothing is held, for steps of a length [s]."""
        kind = MujocoWorld if self.world == "mujoco" else KinematicWorld
        sensors = Sensors.parse(self.noise) if self.noise else None
        # Commands come at least every second step, also where an estimate is a picture old.
        more: dict[str, Any] = {"timeout": 2.0 * dt} if dt > _USUAL_STEP else {}
        world: World = kind(model, robot, sensors=sensors, seed=seed, **more)
        world.reset(state)
        return world

    def make_belief(self, world: World) -> Belief:
        """Return the belief on which a skill acts: the truth without noise, else an estimate."""
        if not self.noise:
            return TrueBelief()
        return TrackedBelief(world.model, world.robot, Sensors.parse(self.noise))


def make_record_folder(folder: Path) -> None:
    """Make the folder of recordings."""
    import_mcap("mcap.writer")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"--record {folder}: {error.strerror}. Name a folder.") from None


def make_settings(options: Options) -> tuple[TrialSetting, ...]:
    """Return the settings that options ask for, one for each world."""
    noise = "" if options.noise is None else str(Sensors.parse(options.noise))
    if options.record is not None:
        make_record_folder(options.record)
    worlds = WORLDS if options.world == BOTH else (options.world,)
    return tuple(TrialSetting(world, noise, options.record) for world in worlds)


class TrialWatch:
    """Session of a trial that is recorded and filmed, where that is wanted; a context."""

    def __init__(
        self, setting: TrialSetting, model: Model, about: Mapping[str, str], *, film: bool = False
    ) -> None:
        self._setting, self._model, self._about, self._film = setting, model, about, film
        self._stack = ExitStack()
        self._recorder: Recorder | None = None
        self._watchers: tuple[Callable[[Session], object], ...] = ()
        self.session: Session | None = None
        self.moments: list[Moment] = []
        self.commands: list[tuple[float, dict[str, float]]] = []
        self.view: PushView | None = None

    def __enter__(self) -> TrialWatch:
        if self._setting.record is not None:
            name = "-".join(re.sub(r"[^\w]+", "_", word).strip("_") for word in self._about.values())
            recorder = Recorder(self._setting.record / f"{name}.mcap", self._model, self._about)
            self._recorder = self._stack.enter_context(recorder)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def open_session(self, world: World, dt: float, *watchers: Callable[[Session], object]) -> Session:
        """Return a new session in a world."""
        self._watchers, self.view = watchers, None
        self.moments, self.commands = [], []
        belief = self._setting.make_belief(world)
        self.session = Session(world, dt=dt, belief=belief, on_step=self._look)
        return self.session

    def write_outcome(self, outcome: Outcome) -> None:
        """Record the outcome."""
        if self._recorder is not None:
            self._recorder.write_outcome(outcome)

    def _look(self, session: Session) -> None:
        for watch in self._watchers:
            watch(session)
        if self.view is not None:
            session.vectors = name_vectors(self.view)
        if self._recorder is not None:
            self._recorder(session)
        if not self._film:
            return
        now, state = session.world.time, session.world.state
        self.commands.append((now - session.dt, {str(s): float(v) for s, v in session.commands.items()}))
        if session.steps % _FILM_STEPS == 0:
            values = {str(s): float(v) for s, v in state.items()}
            self.moments.append(Moment(now, session.phase, values, session.vectors))


def name_vectors(view: PushView) -> dict[str, tuple[Any, Any]]:
    """Return the vectors of a push by name, each with its origin: n, push and tangent at p, and r - p."""
    found = {"n": view.n, "push": view.push, "tangent": view.tangent, "r - p": view.r - view.p}
    return {name: (view.p, vector) for name, vector in found.items()}


def list_series(commands: Iterable[tuple[float, Mapping[str, float]]]) -> dict[str, list[float]]:
    """Return commanded speeds as series by name, 0 where a speed is not given, and ``time`` [s]."""
    rows = list(commands)
    names = dict.fromkeys(name for _, speeds in rows for name in speeds)
    return {
        "time": [time for time, _ in rows],
        **{name: [speeds.get(name, 0.0) for _, speeds in rows] for name in names},
    }
