"""``table1-open``: a grasped folding door, hinged door and drawer are opened (2022 paper, Table I, IV-C1).

The programs alone come first: the papers' leader and follower, and one program over robot and object. Both
start from inverse kinematics onto the grasp, and the object goes where the program says. Then the skill opens
and closes each object in a world, approach and release included.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.errors import NoSolutionError
from kineverse.formats import load
from kineverse.manipulation.robot_sources import SHIPPED, RobotSource
from kineverse.model.model import Model
from kineverse.view.plots import Figure
from kineverse_studies.experiments.execution import run_jobs
from kineverse_studies.experiments.manipulation import skills
from kineverse_studies.experiments.manipulation.film import FilmRow, make_film, make_row
from kineverse_studies.experiments.manipulation.trials import (
    PAPER_DOF,
    ROW,
    TIMES,
    Column,
    Failure,
    StepTimeStatistics,
    Trial,
    group_trials,
    make_trial_numbers,
    make_trial_tables,
    step_times,
    worst,
)
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable

from .programs import (
    DONE,
    DT,
    LOST,
    OBJECT,
    OBJECTS,
    LeaderFollower,
    OneProgram,
    OpeningSetup,
    ProgramRun,
    make_opening_setup,
    open_by_program,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FILMED = "folding door"  # object whose opening is filmed
_PICTURES = 6
_SHARES = (0.0, 0.5, 1.0)


def make_opening_pictures(trials: Sequence[Trial]) -> dict[str, Figure]:
    """Return the picture of the objects, and the film of the opening by each shipped robot, by name."""
    found = {"objects": make_film([_object_row(name) for name in OBJECTS])}
    # Physics is nearer to the paper's real door than a world without forces.
    filmed = sorted(
        (t for t in trials if t.film and t.robot in SHIPPED and t.case == FILMED and t.skill == "open"),
        key=lambda t: (t.done, t.world == "mujoco"),
    )
    best = {t.robot: t for t in filmed}
    if best:
        found["folding-door"] = make_film([_robot_row(best[robot]) for robot in SHIPPED if robot in best])
    return found


def _object_row(name: str) -> FilmRow:
    thing = OBJECTS[name]
    what = f"{OBJECT}/{thing.coordinate}"
    model = load(thing.source, prefix=OBJECT)
    lower, upper = model.limits(what)
    values = [lower + share * (upper - lower) for share in _SHARES]
    labels = [f"{value:.2f}" for value in values]
    return FilmRow(name, lambda: model, [{what: value} for value in values], labels, (f"{OBJECT}/",))


def _robot_row(trial: Trial) -> FilmRow:
    title, load_model = f"{trial.robot}, {trial.world} world", partial(_load, trial.robot, trial.case)
    shown = f"{SHIPPED[trial.robot].prefix}/", f"{OBJECT}/"
    return make_row(title, load_model, trial.film, _PICTURES, "{0.time:.1f} s, {0.phase}", shown)


def _load(robot: str, thing: str) -> Model:
    return make_opening_setup(SHIPPED[robot], OBJECTS[thing]).model


PUBLISHED = {"hsr": (3.3, 2.2), "fetch": (1.2, 0.5), "pr2": (2.8, 1.6)}
"""Mean and deviation of the solver's time of a control step in the 2022 paper, Table I [ms]."""
PROGRAMS = (LeaderFollower.name, OneProgram.name)
FIGURE_SIZE = (9.0, 4.0)


def make_opening_report(trials: Sequence[Trial], starts: int, seed: int) -> Report:
    alone = [t for t in trials if t.skill in PROGRAMS]
    skill = [t for t in trials if t.skill not in PROGRAMS]
    groups = list(group_trials(alone, "robot", "skill").values())
    rows = tuple(tuple(column.cell(own) for column in PROGRAM_COLUMNS) for own in groups)
    title = "Programs alone: the solver's calls of a control step, and the whole step [ms]"
    numbers = {
        "seed": seed,
        "starts": starts,
        "programs": [{c.key: c.of(own) for c in PROGRAM_COLUMNS} for own in groups],
        "skill": make_trial_numbers(skill),
    }
    tables = (
        ReportTable(title, tuple(c.title for c in PROGRAM_COLUMNS), rows),
        _object_table(groups),
        *make_trial_tables(skill, "Skill: opened and closed"),
    )
    title = f"Grasped opening of three objects, {starts} starts each (2022 paper, Table I, IV-C1)"
    figure = Figure(lambda canvas: _draw(canvas, groups), FIGURE_SIZE)
    return Report("table1-open", title, tables, numbers, figure, make_opening_pictures(skill))


def _solver_times(trials: Sequence[Trial]) -> StepTimeStatistics:
    return StepTimeStatistics.from_seconds([t for trial in trials for t in trial.series["solve"]])


def _published(trials: Sequence[Trial], entry: int) -> float:
    """Return a figure of the paper, which is about two programs a step; NaN for another program."""
    known = PUBLISHED.get(trials[0].robot.partition(" ")[0])
    return math.nan if known is None or trials[0].skill != LeaderFollower.name else known[entry]


def _programs_a_step(trials: Sequence[Trial]) -> float:
    steps = sum(t.steps for t in trials)
    return sum(t.measures["programs"] for t in trials) / steps if steps else math.nan


PROGRAM_COLUMNS = (
    ROW[0],
    Column("program", "program", lambda trials: trials[0].skill),
    ROW[3],
    PAPER_DOF,
    Column("opened", "opened", lambda trials: sum(t.done for t in trials), 6),
    Column("runs", "of", len, 6),
    Column("solve_mean_ms", "solver mean (wall)", lambda trials: _solver_times(trials).mean),
    Column("solve_sd_ms", "sd", lambda trials: _solver_times(trials).deviation),
    Column("published_mean_ms", "paper mean", lambda trials: _published(trials, 0)),
    Column("published_sd_ms", "sd", lambda trials: _published(trials, 1)),
    *(column for column in TIMES if column.key in ("cpu_mean_ms", "cpu_p99_ms", "cpu_worst_ms")),
    Column("rate_hz", "slowest [Hz]", lambda trials: 1e3 / step_times(trials).worst),
    Column("programs_a_step", "programs a step", _programs_a_step),
    Column(
        "grasp_error_mm",
        "grasp error [mm]",
        lambda trials: worst("grasp_error", 1e3)([t for t in trials if t.done]),
    ),
    Column("limit_violation", "limits violated [own unit]", worst("limit_violation")),
)
"""Columns of the programs alone; the grasp error is that of the runs that opened the object."""


def _object_table(groups: Sequence[Sequence[Trial]]) -> ReportTable:
    objects = list(dict.fromkeys(t.case for own in groups for t in own))
    rows: list[tuple[float | str, ...]] = []
    for own in groups:
        cells = []
        for name in objects:
            runs = [t for t in own if t.case == name]
            steps = [t.steps for t in runs if t.done]
            mean = f", {np.mean(steps):.0f} steps" if steps else ""
            cells.append(f"{sum(t.done for t in runs)} of {len(runs)}{mean}")
        rows.append((own[0].robot, own[0].skill, *cells))
    return ReportTable("Opened with the handle in the hand", ("robot", "program", *objects), tuple(rows))


def _draw(canvas: Canvas, groups: Sequence[Sequence[Trial]]) -> None:
    axes = canvas.add_subplot()
    times: list[Any] = [
        [1e3 * t for trial in own for t in trial.series["solve"]] or [math.nan] for own in groups
    ]
    axes.boxplot(times, whis=(1, 99), showfliers=False, orientation="horizontal")
    axes.set_yticks(range(1, len(groups) + 1), [f"{own[0].robot}, {own[0].skill}" for own in groups])
    axes.set_xscale("log")
    axes.set_xlabel("solver's calls of a control step [ms], 1st to 99th percentile")


OPTIONS = ("quick", "data", "seed", "count", "robot", "processes", *skills.SettingOptions)
STARTS, QUICK_STARTS = 10, 1  # number of starts of each robot at each object
_COMPILED = 30.0  # longest wait for compiled code [s]; times are those of compiled programs


@dataclass(frozen=True)
class OpeningJob:
    robot: RobotSource
    thing: str
    starts: int
    seed: int
    settings: tuple[skills.TrialSetting, ...]


def run(progress: Progress, options: Options) -> Report:
    """Open the objects; the option ``quick`` takes one start of each, ``count`` so many."""
    starts = options.count or (QUICK_STARTS if options.quick else STARTS)
    settings = skills.make_settings(options)
    robots = skills.find_robots(options.robot, options.data)
    jobs = [OpeningJob(robot, thing, starts, options.seed, settings) for robot in robots for thing in OBJECTS]
    trials = run_jobs(run_openings, jobs, progress, "table1-open", "object", options)
    return make_opening_report(trials, starts, options.seed)


def run_openings(job: OpeningJob) -> list[Trial]:
    setup = make_opening_setup(job.robot, OBJECTS[job.thing])
    start = setup.robot.start_state(setup.model)
    lower, upper = setup.model.limits(setup.what)
    trials = open_by_programs(setup, job)
    for setting in job.settings:
        case = skills.TrialCase(job.thing, job.robot, str(setup.what), setting, job.seed, film=True)
        world = setting.make_world(setup.model, job.robot.prefix, start)
        trials += skills.open_then_close(case, world, start, (DONE * upper, lower))
    return trials


def open_by_programs(setup: OpeningSetup, job: OpeningJob) -> list[Trial]:
    programs = (LeaderFollower(setup), OneProgram(setup))
    for program in programs:
        for controller in program.controllers:
            controller.wait(_COMPILED)
    trials = []
    for k in range(job.starts):
        try:
            start = setup.find_start(job.seed + k)
        except NoSolutionError as error:
            trials += [_trial(setup, one.name, ProgramRun(), "reach", str(error)) for one in programs]
            continue
        for program in programs:
            found = open_by_program(program, setup, start)
            lost = found.position_error > LOST
            reason = "the handle is lost" if lost else "open" if found.done else "not open in time"
            trials.append(_trial(setup, program.name, found, "other" if lost else "time", reason))
    return trials


def _trial(setup: OpeningSetup, program: str, found: ProgramRun, failure: Failure, reason: str) -> Trial:
    return Trial(
        setup.thing.name,
        setup.robot.name,
        str(setup.what),
        program,
        found.done,
        found.value,
        "" if found.done else failure,
        reason,
        DT * found.steps,
        found.steps,
        tuple(found.cpu),
        measures={
            "programs": found.programs,
            "grasp_error": found.position_error,
            "grasp_rotation": found.rotation_error,
            "limit_violation": found.violation,
        },
        world="none",
        dof=setup.robot.count_freedom(setup.model),
        series={"solve": tuple(found.solve)},
    )
