"""``kitchens``: robots open and close everything in generated kitchens, or in any other model.

Each kitchen is generated from a seed; see :mod:`kineverse.gallery.kitchens`. For each object, a robot begins
in the aisle, and all is shut. It opens the object, and closes it again if that succeeded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

from kineverse.errors import KineverseError, NoSolutionError
from kineverse.geometry import Rule
from kineverse.grasping import find_handle
from kineverse.manipulation import find_articulated_objects
from kineverse.manipulation.robot_placement import find_free_state
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import Symbol

from .execution import run_jobs
from .manipulation import skills
from .manipulation.trials import Trial, make_success_figure, make_trial_numbers, make_trial_tables
from .registry import Options, Progress
from .report import Report

OPTIONS = ("quick", "data", "model", "seed", "count", "robot", "processes", *skills.SettingOptions)
COUNT, QUICK_COUNT = 50, 1
QUICK_OBJECTS = 2
KITCHEN = "kitchen"
_CLEARANCE = 0.02  # least distance of the robot from the kitchen at the start [m]
_OFFSETS = tuple(sign * k / 2 for k in range(11) for sign in ((1, -1) if k else (1,)))
"""Places along the aisle that are tried for the start [m]."""
OPEN_SHARE = 0.98
"""Share of the range at which an object is wanted open; the limit itself is no target with room to err."""


@dataclass(frozen=True)
class KitchenJob:
    kitchen: str  # name or path of its model, such as ``"kitchens/17"``
    robot: RobotSource
    setting: skills.TrialSetting = field(default_factory=skills.TrialSetting)  # world, noise and recordings
    most: int | None = None  # largest number of objects; None for all
    only: str | None = None  # name of the coordinate of the only object; None for all


def run(progress: Progress, options: Options) -> Report:
    """Open and close everything; the option ``quick`` takes two objects of one kitchen, and one robot."""
    count = options.count or (QUICK_COUNT if options.quick else COUNT)
    robots = skills.find_robots(options.robot, options.data)
    if options.quick and not options.robot:
        robots = robots[-1:]
    names = [options.model] if options.model else name_kitchens(options.seed, count)
    jobs = [
        KitchenJob(name, robot, setting, QUICK_OBJECTS if options.quick else None)
        for name in names
        for setting in skills.make_settings(options)
        for robot in robots
    ]
    trials = run_jobs(run_kitchen, jobs, progress, "kitchens", "kitchen", options)
    return report_trials(trials, names)


def name_kitchens(seed: int, count: int) -> list[str]:
    return [f"kitchens/{k}" for k in range(seed, seed + count)]


def report_trials(trials: list[Trial], names: Sequence[str]) -> Report:
    which = names[0] if len(names) == 1 else f"{len(names)} kitchens, {names[0]} to {names[-1]}"
    return Report(
        name="kitchens",
        title=f"{which}: opened and closed",
        tables=make_trial_tables(trials, "Objects that were opened and closed"),
        numbers={"kitchens": list(names), **make_trial_numbers(trials)},
        figure=make_success_figure(trials, "height", "height of the handle [m]"),
    )


def run_kitchen(job: KitchenJob) -> list[Trial]:
    model = make_kitchen_with(job.robot, job.kitchen)
    objects = [
        one
        for one in find_articulated_objects(model, job.robot.prefix)
        if one.kind != "knob" and job.only in (None, str(one.coordinate))
    ]
    cases = [
        skills.TrialCase(
            job.kitchen,
            job.robot,
            str(one.coordinate),
            job.setting,
            measures=(("height", find_handle_height(model, one.coordinate)),),
        )
        for one in objects[: job.most]
    ]
    try:
        start = start_in_aisle(job.robot, model)
    except NoSolutionError as error:
        return [case.fail("open", model, "collision", str(error)) for case in cases]
    world = job.setting.make_world(model, job.robot.prefix, start)
    trials = []
    for case, one in zip(cases, objects, strict=False):
        targets = (one.shut + OPEN_SHARE * (one.opened - one.shut), one.shut)
        trials += skills.open_then_close(case, world, start, targets)
    return trials


def make_kitchen_with(robot: RobotSource, name: str) -> Model:
    model = robot.load()
    with model.edit() as edit:
        edit.include(name, KITCHEN)
    return model


def start_in_aisle(robot: RobotSource, model: Model) -> State:
    floor, begin = f"{KITCHEN}/floor", robot.start_state(model)
    states = (
        begin.updated({f"{robot.prefix}/base/y": offset, f"{robot.prefix}/base/angle": angle})
        for offset, angle in product(_OFFSETS, (math.pi / 2, -math.pi / 2))
    )
    rules = [Rule("*", floor)] if floor in model.frames else []
    found, _ = find_free_state(model, robot.prefix, states, _CLEARANCE, rules)
    if found is not None:
        return found
    raise NoSolutionError(f"The {robot.name} stands free nowhere along the aisle.")


def find_handle_height(model: Model, coordinate: Symbol) -> float:
    """Return the height of an object's handle while all is shut [m]; NaN if none is found."""
    try:
        frame = find_handle(model, coordinate).frame
    except KineverseError:
        return math.nan
    return float(model.fk(frame)(model.default_state())[2, 3])
