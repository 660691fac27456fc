"""Trials of skills: what came out, why not, and how long a step took."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from kineverse.manipulation.outcome import Outcome

Failure: TypeAlias = Literal["", "collision", "reach", "time", "other"]
FAILURES: tuple[Failure, ...] = get_args(Failure)

_NO_DATA = ("cpu", "wall", "series", "film")

PLACEMENTS = 200
"""Number of placements that prove that an object is out of reach."""
MOST_EXCUSED = 0.1
"""Largest share of a robot's objects that may be out of reach without being failures."""

# A reason says several things; the first class that it speaks of counts.
_PATTERNS: Mapping[Failure, str] = {
    "collision": r"collision|collides|touch|in the way|penetrat|blocked|jammed",
    "reach": r"reach|no placement|placements|inverse kinematics|too far|too high|too low|no handle|too wide",
    "time": r"time|steps|seconds|too slow|did not arrive|not open yet|stuck|no progress",
}


@dataclass(frozen=True, slots=True)
class StepTimeStatistics:
    """CPU and wall times of control steps [ms]."""

    count: int = 0
    mean: float = math.nan
    deviation: float = math.nan
    median: float = math.nan
    p99: float = math.nan
    worst: float = math.nan
    wall: float = math.nan

    @staticmethod
    def from_seconds(cpu: Sequence[float], wall: Sequence[float] = ()) -> StepTimeStatistics:
        """Return the statistics of durations [s]; ``wall`` is the mean wall time."""
        if not len(cpu):
            return StepTimeStatistics()
        ms = 1e3 * np.asarray(cpu, dtype=float)
        return StepTimeStatistics(
            len(ms),
            float(ms.mean()),
            float(ms.std()),
            float(np.median(ms)),
            float(np.quantile(ms, 0.99)),
            float(ms.max()),
            1e3 * float(np.mean(wall)) if len(wall) else math.nan,
        )


@dataclass(frozen=True, slots=True)
class Moment:
    """One time of a trial."""

    time: float  # time in the world [s]
    phase: str
    values: Mapping[str, float]  # true values of all coordinates by name
    # vectors of the controller by name, each with its origin in the world (3,)
    vectors: Mapping[str, tuple[Any, Any]]


@dataclass(frozen=True, slots=True)
class Trial:
    """One skill of one robot at one object."""

    case: str  # kitchen, or name of the set-up
    robot: str  # names of the robot, the coordinate and the skill
    what: str
    skill: str
    done: bool  # whether it was done
    value: float  # value of the coordinate at the end [m], [rad]
    failure: Failure  # class of the failure, empty if it was done; and the words of the skill
    reason: str
    seconds: float  # time in the world [s], and number of control steps
    steps: int
    cpu: tuple[float, ...] = ()  # CPU times of the steps [s]
    wall: tuple[float, ...] = ()  # wall times of the steps [s]
    measures: Mapping[str, Any] = field(default_factory=dict)
    world: str = "kinematic"  # name of the world; noise of the sensors, empty if the skill acted on the truth
    noise: str = ""
    dof: int = 0  # number of degrees of freedom of the robot, its base included
    series: Mapping[str, Sequence[float]] = field(default_factory=dict)
    film: Sequence[Moment] = ()

    @property
    def out_of_reach(self) -> bool:
        """True if so many placements were tried that the object counts as out of reach."""
        return self.failure == "reach" and self.measures.get("placements", 0) >= PLACEMENTS

    def as_data(self) -> dict[str, Any]:
        """Return the trial as JSON data."""
        data = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NO_DATA}
        step_ms = asdict(StepTimeStatistics.from_seconds(self.cpu, self.wall))
        return {key: as_json(value) for key, value in {**data, "step_ms": step_ms}.items()}


def find_failure(outcome: Outcome) -> Failure:
    """Return the class of a failure: the measure ``failure``, or what the reason's words say."""
    if outcome.done:
        return ""
    stated = outcome.measures.get("failure")
    if stated in FAILURES and stated:
        return stated  # type: ignore[no-any-return]  # one of the literals
    found = {k: m.start() for k, p in _PATTERNS.items() if (m := re.search(p, outcome.reason, re.IGNORECASE))}
    return min(found, key=found.__getitem__) if found else "other"


class ObjectCount(NamedTuple):
    """Success at objects: one counts as done if all trials of it are."""

    objects: int  # number of objects, and of those that were done
    done: int
    excused: int

    @property
    def rate(self) -> float:
        """Share of the objects within reach that were done; NaN without objects."""
        counted = self.objects - self.excused
        return self.done / counted if counted else math.nan


def count_objects(trials: Iterable[Trial]) -> ObjectCount:
    """Return the success of one robot in one world."""
    by_object = group_trials(trials, "case", "what")
    done = sum(all(t.done for t in group) for group in by_object.values())
    far = sum(any(t.out_of_reach for t in group) for group in by_object.values())
    return ObjectCount(len(by_object), done, min(far, math.floor(MOST_EXCUSED * len(by_object) + 1e-9)))


def group_trials(trials: Iterable[Trial], *names: str) -> dict[tuple[Any, ...], list[Trial]]:
    """Return the trials by the values of some of their attributes, in their order."""
    found: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        found.setdefault(tuple(getattr(trial, name) for name in names), []).append(trial)
    return found


def as_json(value: Any) -> Any:
    """Return a value as JSON data: numbers that are not finite are null, what is no data is its text."""
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [as_json(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, str) else str(value)
