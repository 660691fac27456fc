"""``kitchens``: robots open and close everything in generated kitchens.

Each kitchen is generated from a seed; see :mod:`kineverse.gallery.kitchens`. For each object, a robot begins
in the aisle, and all is shut. It opens the object, and closes it again if that succeeded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import product

from kineverse.errors import NoSolutionError
from kineverse.experiments.manipulation.robots import RobotSource, find_data, find_robots
from kineverse.experiments.manipulation.setting import SettingOptions, TrialSetting, make_settings
from kineverse.experiments.manipulation.skills import TrialCase, open_then_close
from kineverse.experiments.manipulation.tables import (
    make_success_figure,
    make_trial_numbers,
    make_trial_tables,
)
from kineverse.experiments.manipulation.trial_pool import run_jobs
from kineverse.experiments.manipulation.trials import Trial
from kineverse.experiments.registry import Options, Progress
from kineverse.experiments.report import Report
from kineverse.geometry import Rule, Scene
from kineverse.model.model import Model
from kineverse.state import State

OPTIONS = ("quick", "data", "seed", "count", "robot", "processes", *SettingOptions)

COUNT, QUICK_COUNT = 50, 1
QUICK_OBJECTS = 2
KITCHEN = "kitchen"
_CLEARANCE = 0.02
"""Least distance of the robot from the kitchen at the start [m]."""
_OFFSETS = tuple(sign * k / 2 for k in range(11) for sign in ((1, -1) if k else (1,)))
"""Places along the aisle that are tried for the start [m]."""
OPEN_SHARE = 0.98
"""Share of the range at which an object is wanted open; the limit itself is no target with room to err."""


@dataclass(frozen=True)
class KitchenJob:
    """All objects of one kitchen, with one robot in one world.

    Attributes
    ----------
    seed
        Seed of the kitchen.
    robot
        The robot.
    setting
        World, noise and recordings.
    most
        Largest number of objects; None for all.
    """

    seed: int
    robot: RobotSource
    setting: TrialSetting = field(default_factory=TrialSetting)
    most: int | None = None


def run(progress: Progress, options: Options) -> Report:
    """Open and close everything; the option ``quick`` takes two objects of one kitchen, and one robot."""
    count = options.count or (QUICK_COUNT if options.quick else COUNT)
    robots = find_robots(options.robot, options.data and find_data(options.data))
    if options.quick and not options.robot:
        robots = robots[-1:]
    seeds = range(options.seed, options.seed + count)
    jobs = [
        KitchenJob(seed, robot, setting, QUICK_OBJECTS if options.quick else None)
        for seed in seeds
        for setting in make_settings(options)
        for robot in robots
    ]
    trials = run_jobs(run_kitchen, jobs, progress, "kitchens", "kitchen", options.processes)
    return report_trials(trials, seeds)


def report_trials(trials: list[Trial], seeds: range) -> Report:
    """Return the report on the trials."""
    return Report(
        name="kitchens",
        title=f"{len(seeds)} generated kitchens, seeds {seeds[0]} to {seeds[-1]}, opened and closed",
        tables=make_trial_tables(trials, "Objects that were opened and closed"),
        numbers={"seeds": [seeds[0], seeds[-1]], **make_trial_numbers(trials)},
        figure=make_success_figure(trials, "height", "height of the handle [m]"),
    )


def run_kitchen(job: KitchenJob) -> list[Trial]:
    """Return the trials of one kitchen and one robot."""
    model = make_kitchen_with(job.robot, job.seed)
    cases = [
        TrialCase(
            str(job.seed),
            job.robot,
            what,
            job.setting,
            measures=(("height", find_handle_height(model, what)),),
        )
        for what in list_objects(model, KITCHEN)[: job.most]
    ]
    try:
        start = start_in_aisle(job.robot, model)
    except NoSolutionError as error:
        return [case.fail("open", model, "collision", str(error)) for case in cases]
    world = job.setting.make_world(model, job.robot.prefix, start)
    trials = []
    for case in cases:
        lower, upper = model.limits(case.what)
        targets = (lower + OPEN_SHARE * (upper - lower), lower)
        trials += open_then_close(case, model, world, start, targets)
    return trials


def make_kitchen_with(robot: RobotSource, seed: int) -> Model:
    """Return a robot in a generated kitchen."""
    model = robot.load()
    with model.edit() as edit:
        edit.include(f"kitchens/{seed}", KITCHEN)
    return model


def start_in_aisle(robot: RobotSource, model: Model) -> State:
    """Return a state with the robot in the aisle, as near to its middle as it stands free.

    It looks along the aisle, where its arms fit. Where the aisle is too narrow, it stands before its end.

    Raises
    ------
    NoSolutionError
        If there is no such place.
    """
    scene = Scene(model)
    rules = [Rule("*", f"{KITCHEN}/floor"), Rule(f"{robot.prefix}/*", f"{robot.prefix}/*")]
    near = scene.watch(f"{robot.prefix}/*", "*", radius=_CLEARANCE, rules=rules)
    for offset, angle in product(_OFFSETS, (math.pi / 2, -math.pi / 2)):
        base = {f"{robot.prefix}/base/y": offset, f"{robot.prefix}/base/angle": angle}
        state = robot.start_state(model).updated(base)
        scene.update(state)
        if not len(near()):
            return state
    raise NoSolutionError(f"The {robot.name} stands free nowhere along the aisle.")


def list_objects(model: Model, prefix: str) -> tuple[str, ...]:
    """Return the names of the coordinates below a prefix."""
    return tuple(str(q) for q in model.degrees_of_freedom if str(q).startswith(f"{prefix}/"))


def find_handle_height(model: Model, what: str) -> float:
    """Return the height of an object's handle while all is shut [m]; NaN without a frame of that name."""
    for name in (f"{what}_handle", f"{what}/handle"):
        if name in model.frames:
            return float(model.fk(name)(model.default_state())[2, 3])
    return math.nan
