"""``table1-push``: twelve objects of a kitchen and a folding door are pushed shut (both papers, Table I).

The objects are open by .4 m or rad. A robot begins at the papers' start. Where that fails, base placement
searches for another one, and the table says so. The authors' kitchen and robots come from ``--data``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from kineverse.manipulation.robot_sources import RobotSource
from kineverse_studies.experiments.manipulation.robots import check_data, find_robots
from kineverse_studies.experiments.manipulation.setting import SettingOptions, TrialSetting, make_settings
from kineverse_studies.experiments.manipulation.skills import TrialCase, run_push_trial
from kineverse_studies.experiments.manipulation.trial_pool import run_jobs
from kineverse_studies.experiments.manipulation.trials import Trial
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report

from .figures import FILMED
from .objects import PushSetup, find_kitchens, make_push_setup
from .report import make_push_report

OPTIONS = ("quick", "data", "seed", "robot", "processes", *SettingOptions)

PERIODS = {"2022": (0.02, 1200), "2020": (0.1, 500)}
"""Control period [s] and largest number of steps, by paper."""
QUICK_OBJECTS = ("fridge door", "sink trash drawer")


@dataclass(frozen=True)
class PushJob:
    """Push of one object by one robot."""

    robot: RobotSource
    kitchen: str  # name of the kitchen, and the folder of the authors' files
    data: Path | None
    thing: str
    paper: str = "2022"  # paper whose control period and steps count
    setting: TrialSetting = field(default_factory=TrialSetting)  # world, noise and recordings
    seed: int = 0  # seed of the base placement
    logic: str | None = "and"  # rule of trends: ``"and"``, ``"product"``, or None for exact gradients alone


def run(progress: Progress, options: Options) -> Report:
    """Push all objects shut; the option ``quick`` takes two of them, and the period of the 2022 paper."""
    data = check_data(options.data)
    jobs = [
        PushJob(robot, kitchen, data, thing, paper, setting, options.seed)
        for setting in make_settings(options)
        for kitchen, things in find_kitchens(data).items()
        for robot in find_robots(options.robot, data)
        for thing in things
        for paper in PERIODS
        if not options.quick or (thing in QUICK_OBJECTS and paper == "2022")
    ]
    trials = run_jobs(run_push, jobs, progress, "table1-push", "push", options.processes)
    return make_push_report(trials, options.seed)


def run_push(job: PushJob) -> list[Trial]:
    """Return the trial of one push."""
    setup: PushSetup = make_push_setup(job.robot, job.kitchen, job.thing, job.data)
    dt, steps = PERIODS[job.paper]
    case = TrialCase(
        setup.kitchen,
        job.robot,
        setup.what,
        job.setting,
        job.seed,
        film=job.thing in FILMED and job.paper == "2022",
        measures=(("thing", job.thing),),
    )
    world = job.setting.make_world(setup.model, job.robot.prefix, setup.start, dt=dt)
    skill = f"push ({job.paper})"
    return [run_push_trial(case, setup.model, world, setup.start, skill, dt=dt, steps=steps, logic=job.logic)]
