"""``table1-open``: a grasped folding door, hinged door and drawer are opened (2022 paper, Table I, IV-C1).

The programs alone come first: the papers' leader and follower, and one program over robot and object. Both
start from inverse kinematics onto the grasp, and the object goes where the program says. Then the skill opens
and closes each object in a world, approach and release included.
"""

from __future__ import annotations

from dataclasses import dataclass

from kineverse.errors import NoSolutionError
from kineverse.manipulation.robot_sources import RobotSource
from kineverse_studies.experiments.manipulation.robots import check_data, find_robots
from kineverse_studies.experiments.manipulation.setting import SettingOptions, TrialSetting, make_settings
from kineverse_studies.experiments.manipulation.skills import TrialCase, open_then_close
from kineverse_studies.experiments.manipulation.trial_pool import run_jobs
from kineverse_studies.experiments.manipulation.trials import Failure, Trial
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report

from .objects import OBJECTS, OpeningSetup, make_opening_setup
from .programs import DONE, DT, LOST, LeaderFollower, OneProgram, ProgramRun, open_by_program
from .report import make_opening_report

OPTIONS = ("quick", "data", "seed", "count", "robot", "processes", *SettingOptions)

STARTS, QUICK_STARTS = 10, 1
"""Number of starts of each robot at each object."""
_COMPILED = 30.0
"""Longest wait for compiled code [s]; times are those of compiled programs."""


@dataclass(frozen=True)
class OpeningJob:
    """Openings of one object by one robot."""

    robot: RobotSource
    thing: str
    starts: int
    seed: int
    settings: tuple[TrialSetting, ...]


def run(progress: Progress, options: Options) -> Report:
    """Open the objects; the option ``quick`` takes one start of each, ``count`` so many."""
    starts = options.count or (QUICK_STARTS if options.quick else STARTS)
    settings = make_settings(options)
    robots = find_robots(options.robot, check_data(options.data))
    jobs = [OpeningJob(robot, thing, starts, options.seed, settings) for robot in robots for thing in OBJECTS]
    trials = run_jobs(run_openings, jobs, progress, "table1-open", "object", options.processes)
    return make_opening_report(trials, starts, options.seed)


def run_openings(job: OpeningJob) -> list[Trial]:
    """Return the trials of the programs, and those of the skill."""
    setup = make_opening_setup(job.robot, OBJECTS[job.thing])
    start = setup.robot.start_state(setup.model)
    lower, upper = setup.model.limits(setup.what)
    trials = open_by_programs(setup, job)
    for setting in job.settings:
        case = TrialCase(job.thing, job.robot, str(setup.what), setting, job.seed, film=True)
        world = setting.make_world(setup.model, job.robot.prefix, start)
        trials += open_then_close(case, setup.model, world, start, (DONE * upper, lower))
    return trials


def open_by_programs(setup: OpeningSetup, job: OpeningJob) -> list[Trial]:
    """Return the trials of the programs alone."""
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
