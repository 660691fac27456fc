"""``unknown-objects``: robots open a door and a drawer whose joints nobody described.

The world has the joints, the model of the skill has the parts fixed. The bar, for nine seeds of ten: the
right family is known before 10° or 8 cm, and the part is open within 15 s from the first grasp on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from kineverse.manipulation import Outcome, judge_outcome, open_unknown
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.manipulation.unknown_objects import forget_joint
from kineverse.model.model import Model
from kineverse.spatial import translation
from kineverse.worlds import RunMetrics, Sensors

from .execution import run_jobs
from .manipulation import skills
from .manipulation.trials import (
    ROW,
    Column,
    Trial,
    make_failure_table,
    make_group_table,
    make_success_figure,
    make_trial_numbers,
    worst,
)
from .registry import Options, Progress
from .report import Report

OPTIONS = ("quick", "data", "seed", "count", "robot", "processes", *skills.SettingOptions)
NOISE = "3mm+3mm/m,0.5deg,30Hz,outliers=0.05"  # noise of the sensors unless options name another one
COUNT, QUICK_COUNT = 10, 1  # number of seeds
MOST_TURN, MOST_WAY, MOST_SECONDS = math.radians(10.0), 0.08, 15.0
"""Motion before which the family has to be known [rad], [m], and time within which it is open [s]."""
_PLACE = translation(1.6, 0.0, 0.7)  # place of the furniture in front of the robot


@dataclass(frozen=True)
class UnknownObject:
    source: str  # name of the model; frames of the part and of its handle. The part's joint has its name
    part: str
    handle: str
    family: str  # true family of the joint


OBJECTS = {
    "door": UnknownObject("shelf_door", "shelf_door/door", "shelf_door/door_handle", "revolute"),
    "drawer": UnknownObject(
        "shelf_drawers", "shelf_drawers/upper_drawer", "shelf_drawers/upper_drawer_handle", "prismatic"
    ),
}
"""The objects by name."""


@dataclass(frozen=True)
class UnknownObjectJob:
    robot: RobotSource
    thing: str
    setting: skills.TrialSetting
    seed: int


def run(progress: Progress, options: Options) -> Report:
    """Open the objects; the option ``quick`` takes one seed and the last robot, ``count`` so many seeds."""
    count = options.count or (QUICK_COUNT if options.quick else COUNT)
    settings = skills.make_settings(replace(options, noise=options.noise or NOISE))
    robots = skills.find_robots(options.robot, options.data)
    if options.quick and not options.robot:
        robots = robots[-1:]
    jobs = [
        UnknownObjectJob(robot, thing, setting, seed)
        for robot in robots
        for setting in settings
        for thing in OBJECTS
        for seed in range(options.seed, options.seed + count)
    ]
    trials = run_jobs(open_one, jobs, progress, "unknown-objects", "opening", options)
    return report_openings(trials, options.seed, count)


def report_openings(trials: list[Trial], seed: int, count: int) -> Report:
    seeds = f"seed {seed}" if count == 1 else f"seeds {seed} to {seed + count - 1}"
    title = "Family known before 10° or 8 cm, open within 15 s; the other figures are the worst of all trials"
    tables = (make_group_table(title, trials, COLUMNS, by=("case",)), make_failure_table(trials))
    return Report(
        name="unknown-objects",
        title=f"Objects whose joints nobody described, {seeds}",
        tables=tuple(table for table in tables if table.rows),
        numbers={"seed": seed, "count": count, **make_trial_numbers(trials)},
        figure=make_success_figure(
            trials, "opened_seconds", "time from the first grasp until it is open [s]"
        ),
    )


def open_one(job: UnknownObjectJob) -> list[Trial]:
    robot, thing = job.robot, OBJECTS[job.thing]
    model = make_model(robot, thing)
    start = robot.start_state(model)
    world = job.setting.make_world(model, robot.prefix, start, job.seed)
    truth = (("seed", job.seed), ("true_family", thing.family))
    case = skills.TrialCase(job.thing, robot, thing.part, job.setting, job.seed, measures=truth)

    def act(watch: skills.TrialWatch) -> Outcome:
        gripper, point = world.robot.gripper(), model.fk(thing.handle, thing.part)(start)[:3, 3]
        metrics = RunMetrics(
            world,
            model.symbol(thing.part),
            gripper=gripper,
            handle=thing.handle,
            part=thing.part,
            point=point,
        )
        outcome = open_unknown(
            watch.open_session(skills.DT, metrics),
            thing.handle,
            model=forget_joint(model, thing.part, start),
            part=thing.part,
            sensors=Sensors.parse(job.setting.noise),
            hand=gripper,
            seed=job.seed,
        )
        return judge_outcome(outcome, metrics)

    return [case.run("open unknown", model, act, world)]


def make_model(robot: RobotSource, thing: UnknownObject) -> Model:
    model = robot.load()
    with model.edit() as edit:
        edit.include(thing.source, thing.source)
        edit.attach(f"{thing.source}/shelf", "world", _PLACE)
    return model


def is_known_early(trial: Trial) -> bool:
    """Return whether the right family was known before the part had moved far."""
    found = trial.measures
    if found.get("family") != found["true_family"]:
        return False
    return bool(found["decided_turn"] < MOST_TURN and found["decided_way"] < MOST_WAY)


def is_open_early(trial: Trial) -> bool:
    return trial.done and trial.measures["opened_seconds"] <= MOST_SECONDS


def _least_opening(trials: Sequence[Trial]) -> float:
    return min((t.value for t in trials if not math.isnan(t.value)), default=math.nan)


COLUMNS = (
    *ROW[:3],
    Column("trials", "trials", len, 6),
    Column("done", "done", lambda trials: sum(t.done for t in trials), 6),
    Column("known", "family known", lambda trials: sum(map(is_known_early, trials)), 6),
    Column("opened", "open in time", lambda trials: sum(map(is_open_early, trials)), 6),
    Column("both", "both", lambda trials: sum(is_known_early(t) and is_open_early(t) for t in trials), 6),
    Column("decided_cm", "decided at [cm]", worst("decided_way", 100.0)),
    Column("decided_degrees", "decided at [°]", worst("decided_turn", math.degrees(1.0))),
    Column("opened_seconds", "opened in [s]", worst("opened_seconds")),
    Column("grasps", "grasps", worst("grasps"), 6),
    Column("grasp_error_mm", "grasp error [mm]", worst("grasp_error", 1e3)),
    Column("opening", "least opening [m], [rad]", _least_opening),
)
"""Columns of the table; the openings are the true ones."""
