"""Trials of skills, and their tables and figures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from kineverse.manipulation.outcome import Outcome
from kineverse.view.plots import Figure
from kineverse_studies.experiments.report import ReportTable, as_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Failure: TypeAlias = Literal["", "collision", "reach", "time", "other"]
FAILURES: tuple[Failure, ...] = get_args(Failure)
_NO_DATA = ("cpu", "wall", "series", "film")
PLACEMENTS = 200  # number of placements that prove that an object is out of reach
MOST_EXCUSED = 0.1  # largest share of a robot's objects that may be out of reach without being failures

# A reason says several things; the first class that it speaks of counts.
_PATTERNS: Mapping[Failure, str] = {
    "collision": r"collision|collides|touch|in the way|penetrat|blocked|jammed",
    "reach": r"reach|no placement|placements|inverse kinematics|too far|too high|too low|no handle|too wide",
    "time": r"time|steps|seconds|too slow|did not arrive|not open yet|stuck|no progress",
}


@dataclass(frozen=True, slots=True)
class StepTimeStatistics:
    count: int = 0
    mean: float = math.nan
    deviation: float = math.nan
    median: float = math.nan
    p99: float = math.nan
    worst: float = math.nan
    wall: float = math.nan

    @staticmethod
    def from_seconds(cpu: Sequence[float], wall: Sequence[float] = ()) -> StepTimeStatistics:
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
    time: float  # time in the world [s]
    phase: str
    values: Mapping[str, float]  # true values of all coordinates by name
    # vectors of the controller by name, each with its origin in the world (3,)
    vectors: Mapping[str, tuple[Any, Any]]


@dataclass(frozen=True, slots=True)
class Trial:
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
        data = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NO_DATA}
        found: dict[str, Any] = as_json(
            {**data, "step_ms": StepTimeStatistics.from_seconds(self.cpu, self.wall)}
        )
        return found


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
    by_object = group_trials(trials, "case", "what")
    done = sum(all(t.done for t in group) for group in by_object.values())
    far = sum(any(t.out_of_reach for t in group) for group in by_object.values())
    return ObjectCount(len(by_object), done, min(far, math.floor(MOST_EXCUSED * len(by_object) + 1e-9)))


def group_trials(trials: Iterable[Trial], *names: str) -> dict[tuple[Any, ...], list[Trial]]:
    found: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        found.setdefault(tuple(getattr(trial, name) for name in names), []).append(trial)
    return found


@dataclass(frozen=True)
class Column:
    key: str  # name in JSON data
    title: str  # title with the unit
    of: Callable[[Sequence[Trial]], Any]  # function from the trials of a row to the value
    digits: int = 3  # significant digits of numbers that are printed

    def cell(self, trials: Sequence[Trial]) -> str:
        value = self.of(trials)
        if isinstance(value, str):
            return value
        return "" if math.isnan(value) else f"{value:.{self.digits}g}" if value else "0"


def worst(key: str, scale: float = 1.0) -> Callable[[Sequence[Trial]], float]:
    """Return the function that finds the largest value of a measure, times a scale; NaN without any."""

    def largest(trials: Sequence[Trial]) -> float:
        found = (t.measures.get(key) for t in trials)
        numbers = [float(v) for v in found if v is not None and not math.isnan(v)]
        return scale * max(numbers, default=math.nan)

    return largest


def step_times(trials: Sequence[Trial]) -> StepTimeStatistics:
    return StepTimeStatistics.from_seconds(
        [t for trial in trials for t in trial.cpu], [t for trial in trials for t in trial.wall]
    )


def _failures(kind: str) -> Callable[[Sequence[Trial]], int]:
    return lambda trials: sum(t.failure == kind for t in trials)


def _deepest_pair(trials: Sequence[Trial]) -> str:
    deepest = max(trials, key=lambda t: t.measures.get("penetration") or 0.0)
    return (
        " and ".join(deepest.measures.get("penetrating", ())) if deepest.measures.get("penetration") else ""
    )


ROW = (
    Column("robot", "robot", lambda trials: trials[0].robot),
    Column("world", "world", lambda trials: trials[0].world),
    Column("noise", "noise", lambda trials: trials[0].noise or "none"),
    Column("dof", "DoF", lambda trials: trials[0].dof, 4),
)
"""Columns with which each table begins; their keys are attributes of trials, by which rows are grouped."""
_PAPER_DOF = {"hsr": 23, "fetch": 18, "pr2": 49}
PAPER_DOF = Column(
    "published_dof",
    "paper DoF",
    lambda trials: _PAPER_DOF.get(trials[0].robot.partition(" ")[0], math.nan),
    4,
)
SUCCESS = (
    Column("objects", "objects", lambda trials: count_objects(trials).objects, 6),
    Column("done", "done", lambda trials: count_objects(trials).done, 6),
    Column("excused", "out of reach", lambda trials: count_objects(trials).excused, 6),
    Column("rate", "of those in reach [%]", lambda trials: 100 * count_objects(trials).rate, 4),
    *(Column(kind, kind, _failures(kind), 6) for kind in FAILURES if kind),
)
TIMES = (
    Column("steps", "steps", lambda trials: step_times(trials).count, 9),
    Column("cpu_mean_ms", "CPU mean", lambda trials: step_times(trials).mean),
    Column("cpu_sd_ms", "sd", lambda trials: step_times(trials).deviation),
    Column("cpu_median_ms", "median", lambda trials: step_times(trials).median),
    Column("cpu_p99_ms", "p99", lambda trials: step_times(trials).p99),
    Column("cpu_worst_ms", "worst", lambda trials: step_times(trials).worst),
    Column("wall_mean_ms", "wall mean", lambda trials: step_times(trials).wall),
)
QUALITY = (
    Column("limit_violation", "limits violated [own unit]", worst("limit_violation")),
    Column("grasp_error_mm", "grasp error [mm]", worst("grasp_error", 1e3)),
    Column("contact_losses", "contact losses", worst("contact_losses"), 6),
    Column("penetration_mm", "penetration [mm]", worst("penetration", 1e3)),
    Column("penetrating", "deepest pair", _deepest_pair),
    Column("pressed_mm", "pressed [mm]", worst("pressed", 1e3)),
    Column("jitter", "jitter [m/s, rad/s]", worst("jitter")),
    Column("peak_force", "force [N]", worst("peak_force")),
)
"""Largest values of single trials; penetration is that of the pairs that are not excepted."""
COLUMNS = (*ROW, *SUCCESS, *TIMES, *QUALITY)  # columns of JSON data
_LONGEST_REASON = 90
_TIMED = (
    "Control steps [ms]: everything from the state to the command, distance queries included, "
    "without the world, planning and base placement"
)


def make_trial_tables(
    trials: Sequence[Trial], title: str, more: Iterable[ReportTable] = ()
) -> tuple[ReportTable, ...]:
    """Return the tables of trials: success, times, quality, excepted pairs and failures."""
    tables = (
        make_group_table(title, trials, (*ROW, *SUCCESS)),
        *more,
        make_group_table(_TIMED, trials, (*ROW[:3], *TIMES)),
        make_group_table("Worst of all trials", trials, (*ROW[:3], *QUALITY)),
        make_exception_table(trials),
        make_failure_table(trials),
    )
    return tuple(table for table in tables if table.rows)


def make_group_table(
    title: str, trials: Sequence[Trial], columns: Sequence[Column], by: Sequence[str] = ()
) -> ReportTable:
    """Return a row for each robot, world, noise and attribute; columns that are empty are left out."""
    groups = group_trials(trials, *by, *(column.key for column in ROW))
    columns = [c for c in columns if c.key != "noise" or any(t.noise for t in trials)]
    rows = [
        (*map(str, key[: len(by)]), *(column.cell(own) for column in columns)) for key, own in groups.items()
    ]
    head = (*by, *(column.title for column in columns))
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    return ReportTable(
        title, tuple(head[k] for k in kept), tuple(tuple(row[k] for k in kept) for row in rows)
    )


def make_exception_table(trials: Iterable[Trial]) -> ReportTable:
    """Return the table of the pairs of bodies whose penetration does not count.

    Bodies of one robot or of one piece of furniture are listed with those that they always overlap; those of
    a gripper with the object that it grasps or pushes.
    """
    rows = []
    for (robot,), own in group_trials(trials, "robot").items():
        pairs: dict[str, dict[str, None]] = {}
        for pair in (pair for t in own for pair in t.measures.get("excepted", ())):
            (head, a), (other, b) = (name.partition("/")[::2] for name in pair)
            if head == other:
                pairs.setdefault(f"{head}: {a}", {})[b] = None
            else:
                pairs.setdefault("handle that is grasped or pushed", {})[f"{head}: {a}"] = None
        rows += [(robot, body, ", ".join(others)) for body, others in pairs.items()]
    return ReportTable("Pairs whose penetration does not count", ("robot", "body", "with"), tuple(rows))


def make_failure_table(trials: Iterable[Trial]) -> ReportTable:
    rows = tuple(
        (t.case, t.robot, t.world, t.what, t.skill, t.failure, shorten_reason(t.reason))
        for t in trials
        if not t.done
    )
    head = ("case", "robot", "world", "object", "skill", "class", "reason")
    return ReportTable("Failures", head, rows)


def make_trial_numbers(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the columns of all robots and worlds, failures, and all trials as JSON data."""
    groups = group_trials(trials, *(column.key for column in ROW))
    data = [t.as_data() for t in trials]
    return {
        "cpu_seconds": sum(float(t.measures.get("cpu_seconds", 0.0)) for t in trials),
        "robots": [{c.key: as_json(c.of(own)) for c in COLUMNS} for own in groups.values()],
        "failures": [one for one in data if not one["done"]],
        "trials": data,
    }


def make_success_figure(trials: Sequence[Trial], measure: str, label: str) -> Figure:
    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        robots, skills = (list(dict.fromkeys(getattr(t, of) for t in trials)) for of in ("robot", "skill"))
        colors = {"": "0.7", "collision": "tab:red", "reach": "tab:blue", "time": "tab:orange", "other": "k"}
        for failure, color in colors.items():
            own = [t for t in trials if t.failure == failure and measure in t.measures]
            # Points of one robot are spread by skill, so that opening and closing do not hide each other.
            y = [robots.index(t.robot) + 0.24 * (skills.index(t.skill) - (len(skills) - 1) / 2) for t in own]
            if own:
                x, marker, size = (
                    [t.measures[measure] for t in own],
                    "|o"[bool(failure)],
                    30 if failure else 60,
                )
                axes.scatter(x, y, c=color, s=size, marker=marker, label=failure or "done")
        axes.set_yticks(range(len(robots)), robots)
        axes.set_ylim(len(robots) - 0.5, -0.5)
        axes.set_xlabel(label)
        canvas.legend(loc="outside right upper", frameon=False)

    return Figure(draw, (9.0, 3.5))


def shorten_reason(reason: str) -> str:
    line = " ".join(reason.split())
    return line if len(line) <= _LONGEST_REASON else f"{line[: _LONGEST_REASON - 1]}…"
