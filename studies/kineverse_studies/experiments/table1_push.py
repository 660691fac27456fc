"""``table1-push``: twelve objects of a kitchen and a folding door are pushed shut (both papers, Table I).

The objects are open by .4 m or rad. A robot begins at the papers' start. Where that fails, base placement
searches for another one, and the table says so. The papers' own controller pushes from their start alone. The
authors' kitchen and robots come from ``--data``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kineverse.articulations.mechanisms import FoldingDoor
from kineverse.errors import UnknownNameError, suggest
from kineverse.geometry.exclusions import remove_unusable_shapes
from kineverse.manipulation.robot_sources import SHIPPED, RobotSource
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rotation_z, translation
from kineverse.state import State
from kineverse.view.plots import Figure
from kineverse.worlds.run_metrics import CONTACT_GAP

from .execution import run_jobs
from .manipulation import skills
from .manipulation.film import find_telling_moment, make_film, make_push_picture, make_row
from .manipulation.trials import (
    PAPER_DOF,
    QUALITY,
    ROW,
    TIMES,
    Column,
    StepTimeStatistics,
    Trial,
    group_trials,
    make_group_table,
    make_trial_numbers,
    make_trial_tables,
    step_times,
)
from .registry import Options, Progress
from .report import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

OPENED = 0.4  # value from which objects are pushed shut [m], [rad]
FOLDING_DOOR = "folding door"
SHIPPED_KITCHEN, AUTHORS_KITCHEN = "shipped kitchen", "authors' kitchen"
_FILES = {SHIPPED_KITCHEN: "kitchen", AUTHORS_KITCHEN: "iai_kitchen/iai_kitchen/urdf_obj/IAI_kitchen.urdf"}
_PLACE = Pose.from_matrix(translation(1.0, 0.0, 0.7) @ rotation_z(0.57))

# Name of each object: coordinate in the shipped kitchen, and in the authors'.
_COORDINATES: Mapping[str, tuple[str, str]] = {
    "fridge door": ("fridge_door", "iai_fridge_door_joint"),
    "oven door": ("oven_door", "oven_area_oven_door_joint"),
    "dishwasher door": ("dishwasher_door", "sink_area_dish_washer_door_joint"),
    "fridge lower drawer": ("fridge_lower_drawer", "fridge_area_lower_drawer_main_joint"),
    "oven left drawer": ("oven_left_drawer", "oven_area_area_left_drawer_main_joint"),
    "oven middle lower drawer": ("oven_middle_lower_drawer", "oven_area_area_middle_lower_drawer_main_joint"),
    "oven middle upper drawer": ("oven_middle_upper_drawer", "oven_area_area_middle_upper_drawer_main_joint"),
    "oven right drawer": ("oven_right_drawer", "oven_area_area_right_drawer_main_joint"),
    "sink left bottom drawer": ("sink_left_bottom_drawer", "sink_area_left_bottom_drawer_main_joint"),
    "sink left middle drawer": ("sink_left_middle_drawer", "sink_area_left_middle_drawer_main_joint"),
    "sink left upper drawer": ("sink_left_upper_drawer", "sink_area_left_upper_drawer_main_joint"),
    "sink trash drawer": ("sink_trash_drawer", "sink_area_trash_drawer_main_joint"),
}
OBJECTS = (*_COORDINATES, FOLDING_DOOR)  # names of the objects


@dataclass(frozen=True, eq=False)
class PushSetup:
    kitchen: str
    model: Model  # model of robot and furniture
    what: str
    start: State  # state with the robot at the papers' start, its base at the origin, and the object open


def find_kitchens(data: Path | None) -> Mapping[str, tuple[str, ...]]:
    found = {SHIPPED_KITCHEN: OBJECTS}
    if data is not None and (data / _FILES[AUTHORS_KITCHEN]).is_file():
        found[AUTHORS_KITCHEN] = OBJECTS
    return found


def make_push_setup(robot: RobotSource, kitchen: str, thing: str, data: Path | None = None) -> PushSetup:
    if thing not in OBJECTS:
        raise UnknownNameError(f"There is no object {thing!r}. {suggest(thing, OBJECTS, 'object')}")
    model = robot.load()
    if thing == FOLDING_DOOR:
        what = "cupboard"
        with model.edit() as edit:
            edit.apply(FoldingDoor(name=what, parent=WORLD, origin=_PLACE))
    else:
        file = _FILES[kitchen]
        source = str(data / file) if data is not None and kitchen == AUTHORS_KITCHEN else file
        model.include(source, "kitchen")
        if source != file:
            remove_unusable_shapes(model)
        what = f"kitchen/{_COORDINATES[thing][kitchen == AUTHORS_KITCHEN]}"
    opened = min(OPENED, float(model.limits(what)[1]))
    return PushSetup(kitchen, model, what, robot.start_state(model).updated({what: opened}))


FILMED = ("fridge door", "sink left upper drawer", "folding door")
"""Objects whose pushes are filmed; the first one is that of the film."""
_PICTURES = 5


def make_push_pictures(trials: Sequence[Trial]) -> dict[str, Figure]:
    own = [t for t in trials if t.film and t.robot in SHIPPED and t.case == SHIPPED_KITCHEN]
    # Of several worlds the first counts.
    films = {(t.robot, str(t.measures["thing"])): t for t in reversed(own)}
    found = {}
    panels = []
    for thing in FILMED:
        telling = [(*find_telling_moment(t.film), robot) for (robot, of), t in films.items() if of == thing]
        _, moment, robot = max(telling, key=lambda found: found[0], default=(0.0, None, ""))
        if moment is not None:
            title = f"{robot} at the {thing}, {moment.time:.1f} s"
            panels.append((title, partial(_load, robot, thing), moment))
    if panels:
        found["vectors"] = make_push_picture(panels)
    rows = []
    for robot in SHIPPED:
        if (trial := films.get((robot, FILMED[0]))) is not None:
            shown, load = (f"{SHIPPED[robot].prefix}/", trial.what), partial(_load, robot, FILMED[0])
            rows.append(make_row(robot, load, trial.film, _PICTURES, "{0.time:.1f} s", shown))
    if rows:
        found["fridge"] = make_film(rows)
    return found


def _load(robot: str, thing: str) -> Model:
    return make_push_setup(SHIPPED[robot], SHIPPED_KITCHEN, thing).model


PUBLISHED = {
    "2022": {"hsr": (1.9, 0.02), "fetch": (2.3, 0.01), "pr2": (2.7, 0.02)},
    "2020": {"hsr": (2.2, 0.08), "fetch": (4.8, 0.09), "pr2": (3.2, 0.06)},
}
"""Mean time of a control step and its deviation over the objects, Table I of each paper [ms]."""
PENETRATION, LIMITS, LOSSES = 5e-4, 1e-6, 1
"""Bars: deepest penetration, also of what is pushed [m], largest violation of limits, and contact losses
of one run."""


def make_push_report(trials: Sequence[Trial], seed: int) -> Report:
    by, every = ("case", "skill"), trials
    trials = [t for t in every if PAPERS not in t.skill]
    groups = group_trials(every, *by, *(c.key for c in ROW)).values()
    columns = (*ROW[:3], *OBJECT_COLUMNS, *PAPER_COLUMNS)
    pushes = [
        {"case": own[0].case, "skill": own[0].skill, **{c.key: c.of(own) for c in columns}} for own in groups
    ]
    numbers = {"seed": seed, "pushes": pushes, **make_trial_numbers(trials)}
    more = (
        make_group_table("Starts and bars", every, (*ROW[:3], *OBJECT_COLUMNS, *_COMPARED), by),
        make_group_table("Control steps beside the papers [ms]", trials, (*ROW, *PAPER_COLUMNS), by),
    )
    return Report(
        "table1-push",
        "Objects pushed shut with and without base placement (2020 and 2022 papers, Table I)",
        make_trial_tables(trials, "Objects pushed shut", more),
        numbers,
        Figure(lambda canvas: _draw_commands(canvas, trials), FIGURE_SIZE),
        make_push_pictures(trials),
    )


FIGURE_SIZE = (13.0, 4.2)
_NAMED = 6  # number of the fastest joints that have their names in the figure


def meets_bars(trial: Trial) -> bool:
    m = trial.measures
    return bool(
        trial.done
        and m.get("contact_losses", 0) <= LOSSES
        and max(m.get("penetration", 0.0), m.get("pressed", 0.0)) <= PENETRATION
        and m.get("limit_violation", 0.0) <= LIMITS
    )


OBJECT_COLUMNS = (
    Column("objects", "objects", len, 6),
    Column("done", "shut", lambda trials: sum(t.done for t in trials), 6),
    Column(
        "at_once",
        "from the papers' start",
        lambda trials: sum(t.done and t.measures.get("placed", 0) == 0 for t in trials),
        6,
    ),
    Column("within_bars", "within all bars", lambda trials: sum(map(meets_bars, trials)), 6),
)


def _spread(trials: Sequence[Trial]) -> float:
    """Return the deviation of the objects' means [ms], as in the papers."""
    means = [1e-3 * StepTimeStatistics.from_seconds(t.cpu).mean for t in trials if t.cpu]
    return StepTimeStatistics.from_seconds(means).deviation


def _published(trials: Sequence[Trial], entry: int) -> float:
    paper = next((values for name, values in PUBLISHED.items() if name in trials[0].skill), {})
    return paper.get(trials[0].robot.partition(" ")[0], (math.nan, math.nan))[entry]


PAPERS = "papers' push"  # skill of the papers' controller
_COMPARED = (*(c for c in QUALITY if c.key not in ("grasp_error_mm", "penetrating", "peak_force")), TIMES[1])
PAPER_COLUMNS = (
    PAPER_DOF,
    TIMES[1],
    Column("sd_over_objects_ms", "sd over objects", _spread),
    Column("published_mean_ms", "paper mean", lambda trials: _published(trials, 0)),
    Column("published_sd_ms", "sd over objects", lambda trials: _published(trials, 1)),
    Column("cpu_worst_ms", "worst", lambda trials: step_times(trials).worst),
)


def _draw_commands(canvas: Canvas, trials: Sequence[Trial]) -> None:
    """Draw the commanded speeds of each robot at the first filmed object (2020 paper, Fig. 7)."""
    shown = [t for t in trials if t.series.get("time") and t.measures["thing"] == FILMED[0]]
    own = list({t.robot: t for t in reversed(shown)}.values())[::-1]
    panels = np.atleast_1d(canvas.subplots(1, max(1, len(own))))
    for axes, trial in zip(panels, own, strict=False):
        time = np.asarray(trial.series["time"])
        speeds = {name: np.asarray(v) for name, v in trial.series.items() if name != "time"}
        fastest = sorted(speeds, key=lambda name: -float(np.abs(speeds[name]).max(initial=0.0)))
        for name in reversed(fastest):
            label = name.partition("/")[2].removesuffix(":velocity")
            style = {"label": label} if name in fastest[:_NAMED] else {"color": "0.75"}
            axes.plot(time, speeds[name], linewidth=0.9, **style)
        gaps = ((m.time, np.linalg.norm(m.vectors["r - p"][1])) for m in trial.film if m.vectors)
        touches = (at for at, gap in gaps if gap < CONTACT_GAP)
        if (touch := next(touches, None)) is not None:
            axes.axvline(touch, color="0.5", linewidth=0.8, linestyle=":")
        axes.legend(fontsize="x-small", frameon=False)
        axes.set_title(f"{trial.robot}, {trial.measures['thing']} (dotted: first contact)", fontsize="medium")
        axes.set_xlabel("time [s]")
    panels[0].set_ylabel("commanded speeds [rad/s], [m/s]")


OPTIONS = ("quick", "data", "seed", "robot", "processes", *skills.SettingOptions)
PERIODS = {"2022": (0.02, 1200), "2020": (0.1, 500)}  # control period [s] and largest number of steps
QUICK_OBJECTS = ("fridge door", "sink trash drawer")


@dataclass(frozen=True)
class PushJob:
    robot: RobotSource
    kitchen: str  # name of the kitchen, and the folder of the authors' files
    data: Path | None
    thing: str
    paper: str = "2022"  # paper whose control period and steps count
    setting: skills.TrialSetting = field(default_factory=skills.TrialSetting)  # world, noise and recordings
    seed: int = 0  # seed of the base placement
    logic: str | None = "and"  # rule of trends: ``"and"``, ``"product"``, or None for exact gradients alone
    baseline: bool = False  # whether the papers' controller pushes


def run(progress: Progress, options: Options) -> Report:
    """Push all objects shut; the option ``quick`` takes two of them, and the period of the 2022 paper."""
    data = skills.check_data(options.data)
    jobs = [
        PushJob(robot, kitchen, data, thing, paper, setting, options.seed, baseline=baseline)
        for setting in skills.make_settings(options)
        for kitchen, things in find_kitchens(data).items()
        for robot in skills.find_robots(options.robot, data)
        for thing in things
        for baseline in (False, True)
        for paper in PERIODS
        if not options.quick or (thing in QUICK_OBJECTS and paper == "2022")
    ]
    trials = run_jobs(run_push, jobs, progress, "table1-push", "push", options)
    return make_push_report(trials, options.seed)


def run_push(job: PushJob) -> list[Trial]:
    setup: PushSetup = make_push_setup(job.robot, job.kitchen, job.thing, job.data)
    dt, steps = PERIODS[job.paper]
    case = skills.TrialCase(
        setup.kitchen,
        job.robot,
        setup.what,
        job.setting,
        job.seed,
        film=job.thing in FILMED and job.paper == "2022" and not job.baseline,
        measures=(("thing", job.thing),),
    )
    world = job.setting.make_world(setup.model, job.robot.prefix, setup.start, dt=dt)
    skill = f"{PAPERS if job.baseline else 'push'} ({job.paper})"
    push = partial(skills.run_push_trial, dt=dt, steps=steps, logic=job.logic, baseline=job.baseline)
    return [push(case, world, setup.start, skill)]
