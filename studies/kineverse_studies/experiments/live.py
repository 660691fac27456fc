"""``live``: the papers' experiment with a real robot (2022, IV-D), with a physics engine in its place.

A model server, a world in real time, a state estimator, a model estimator and a behaviour are processes of
their own, which ``kineverse live`` starts. The behaviour opens and closes each of three objects three times
in a row, on noisy poses; the world's own state judges. With ``ros`` the robot is only topics. Afterwards
robots open and close everything in the kitchen that ships and in generated ones, and open what nobody has
described, in lock step.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from kineverse.errors import KineverseError, OfflineError, UnknownNameError
from kineverse.formats import load
from kineverse.live.streams import (
    ACTIVITY,
    ROBOT,
    TRACKER,
    TRUTH,
    ActivityNote,
    RobotNote,
    TrackerNote,
    read_note,
)
from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.view.plots import Figure
from kineverse.worlds import Sensors

from . import kitchens, unknown_objects
from .execution import run_jobs
from .manipulation import skills
from .manipulation.trials import ROW, SUCCESS, Trial, make_failure_table, make_group_table, make_trial_numbers
from .registry import Options, Progress
from .report import Report, ReportTable, make_table
from .table1_open.programs import OBJECT, OBJECTS, PLACE, GraspedObject

OPTIONS = ("quick", "seed", "count", "robot", "processes", "noise", "record", "ros")
NOISE = "3mm+3mm/m,0.5deg,30Hz"  # noise of the sensors unless options name another one
ROUNDS, KITCHENS = 3, 10  # how often in a row, and number of generated kitchens
OPENED, SHUT = 0.9, 0.02  # share of the upper limit that is open; largest value that is shut [m], [rad]
NAME = "reproduce-live"
_STARTING, _FINISHING = 90.0, 900.0  # longest times until all processes are there, and until all is done [s]


@dataclass(frozen=True)
class LiveJob:
    robot: str  # name of a robot that ships
    thing: GraspedObject
    rounds: int
    noise: str
    seed: int
    ros: bool
    record: Path | None


@dataclass
class RealTimeRun:
    """Measures of an object that was opened and closed in real time."""

    robot: str
    thing: str
    done: int = 0  # openings and closings that the world confirms, and all that were wanted
    wanted: int = 0
    seconds: list[float] = field(default_factory=list)  # of each opening and closing
    error: float = 0.0  # largest error of the estimate of the object [m], [rad]
    force: float = 0.0  # largest force between the robot and another body [N]
    estimate: list[float] = field(default_factory=list)  # times from readings to estimates [ms]
    factor: float = math.nan  # real-time factor
    late: float = math.nan  # share of control steps that began late by more than 5 ms
    restarts: int = 0
    reason: str = ""

    def as_data(self) -> dict[str, Any]:
        return {
            "robot": self.robot, "object": self.thing, "done": self.done, "wanted": self.wanted,
            "seconds": self.seconds, "error": self.error, "force": self.force,
            "estimate_ms": float(np.median(self.estimate)) if self.estimate else None,
            "real_time_factor": self.factor, "late": self.late, "restarts": self.restarts,
            "reason": self.reason,
        }  # fmt: skip


def run(progress: Progress, options: Options) -> Report:
    """Run all; the option ``quick`` takes one drawer and one robot, once, and nothing in lock step."""
    noise = str(Sensors.parse(options.noise or NOISE))
    if options.record is not None:
        skills.make_record_folder(options.record)
    robots = options.robot or (("hsr",) if options.quick else tuple(SHIPPED))
    if unknown := [name for name in robots if name not in SHIPPED]:
        raise KineverseError(f"--robot {unknown[0]}: the live experiment has {', '.join(SHIPPED)}.")
    things = [OBJECTS["drawer"]] if options.quick else [*OBJECTS.values()]
    rounds = options.count or (1 if options.quick else ROUNDS)
    jobs = [
        LiveJob(robot, thing, rounds, noise, options.seed, options.ros, options.record)
        for robot in robots
        for thing in things
    ]
    run_one = run_topics if options.ros else run_processes
    runs = [run_one(job) for job in progress(jobs, "live", "object")]  # one at a time: they are in real time
    lock_step = [] if options.quick or options.ros else list(_run_lock_step(progress, options, noise, robots))
    return make_live_report(runs, lock_step, options)


# -- in real time --------------------------------------------------------------------------------------------


def make_object(thing: GraspedObject) -> Model:
    """Return the model of an object at its place."""
    model = load(thing.source, prefix=OBJECT)
    roots = [name for name, frame in model.frames.items() if frame.parent == WORLD]
    with model.edit() as edit:
        for root in roots:
            edit.attach(root, WORLD, PLACE)
    return model


@contextmanager
def started(words: Sequence[str], output: Path, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command of kineverse, whose output goes to a file, and end it."""
    python = options.pop("python", sys.executable)
    with output.open("w", encoding="utf-8") as out:
        process = subprocess.Popen([python, "-m", "kineverse", *words], stdout=out, **options)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(20.0)
        process.kill()
        process.wait()


def run_processes(job: LiveJob) -> RealTimeRun:
    """Open and close an object by a live system of processes."""
    what = f"{OBJECT}/{job.thing.coordinate}"
    found = RealTimeRun(job.robot, job.thing.name, wanted=2 * job.rounds)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="kv-")))
        model, output = folder / "object.kv.json", folder / "output"
        make_object(job.thing).save(model)
        words = [
            "live", str(model), "--robot", job.robot, "--world", "mujoco", "--noise", job.noise,
            "--do", "tour", "--rounds", str(job.rounds), "--what", what, "--headless", "--json",
            "--seed", str(job.seed), "--seconds", str(_FINISHING), "--name", NAME,
        ]  # fmt: skip
        if job.record is not None:
            words += ["--record", str(job.record / f"{job.robot}-{job.thing.name.replace(' ', '-')}.mcap")]
        process = stack.enter_context(started(words, output, cwd=folder))
        try:
            _watch(found, process, what)
            process.wait(_STARTING)
            text = output.read_text("utf-8")
            answer = json.loads(text[text.index("{") :])
        except (KineverseError, subprocess.TimeoutExpired, ValueError) as error:
            found.reason = str(error)
            return found
    found.factor, found.late = answer["real_time_factor"], answer["late"]
    found.restarts = sum(answer["restarts"].values())
    return found


def _watch(found: RealTimeRun, process: subprocess.Popen[bytes], what: str) -> None:
    """Measure a live system by its streams until it ends."""
    live = _connect(process)
    upper = float(live.limits(what)[1])
    known = 0
    with live, live.exchange.reader() as reader:
        while process.poll() is None:
            reader.wait(0.1)
            truth, belief = reader.newest(TRUTH), reader.newest(TRACKER)
            note, doing = read_note(reader, ROBOT, RobotNote), read_note(reader, ACTIVITY, ActivityNote)
            if truth is None or belief is None or note is None:
                continue
            true = truth.named[what]
            believed = belief.named[what]
            tracker = read_note(reader, TRACKER, TrackerNote)
            if tracker is not None:
                found.estimate.append(tracker.milliseconds)
            if abs(truth.stamp - belief.stamp) < 1e-3 and what in (tracker.seen if tracker else ()):
                found.error = max(found.error, abs(true - believed))
            if not math.isnan(note.force):
                found.force = max(found.force, note.force)
            for result in [] if doing is None else doing.results[known:]:
                known += 1
                is_so = true >= OPENED * upper if result.skill == "open" else abs(true) <= SHUT
                found.done += result.done and is_so
                found.seconds.append(result.seconds)
                if not (result.done and is_so):
                    found.reason = f"{result.skill}: {result.reason} In truth it is at {true:.3g}."


def _connect(process: subprocess.Popen[bytes]) -> Any:
    end = time.monotonic() + _STARTING
    while process.poll() is None and time.monotonic() < end:
        with suppress(OfflineError, UnknownNameError):
            return load(f"live:{NAME}")
        time.sleep(0.2)
    raise KineverseError(f"The live system was not there within {_STARTING:g} s, or has ended.")


def run_topics(job: LiveJob) -> RealTimeRun:
    """Open and close an object with a robot that is only topics of ROS 2, by a command for each."""
    what = f"{OBJECT}/{job.thing.coordinate}"
    found = RealTimeRun(job.robot, job.thing.name, wanted=2 * job.rounds)
    python = os.environ.get("KINEVERSE_ROS_PYTHON", sys.executable)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="kv-")))
        model = folder / "object.kv.json"
        make_object(job.thing).save(model)
        words = ["ros", model.name, "--robot", job.robot, "--simulate", "mujoco", "--noise", job.noise]
        robot = stack.enter_context(started(words, folder / "robot", cwd=folder, python=python))
        for skill in ("open", "close") * job.rounds:
            words = [skill, model.name, "--robot", job.robot, "--what", what, "--world", "ros", "--json"]
            words += ["--seed", str(job.seed), "--seconds", "120"]
            begin = time.monotonic()
            done = subprocess.run(
                [python, "-m", "kineverse", *words],
                cwd=folder, capture_output=True, encoding="utf-8", timeout=_FINISHING, check=False,
            )  # fmt: skip
            found.seconds.append(time.monotonic() - begin)
            try:
                answer = json.loads(done.stdout)
            except ValueError:
                found.reason = done.stderr.strip().rpartition("\n")[2]
                continue
            found.done += bool(answer["done"])
            if not answer["done"]:
                found.reason = f"{skill}: {answer['reason']}"
        if robot.poll() is not None:
            found.reason = f"The simulated robot has ended. {found.reason}"
    return found


# -- in lock step --------------------------------------------------------------------------------------------


def _run_lock_step(
    progress: Progress, options: Options, noise: str, robots: Sequence[str]
) -> Iterator[tuple[str, list[Trial]]]:
    given = replace(options, noise=noise)
    (setting,) = skills.make_settings(given)
    sources = [SHIPPED[name] for name in robots]
    names = {
        "the kitchen that ships": [kitchens.KITCHEN],
        f"{KITCHENS} generated kitchens": kitchens.name_kitchens(options.seed, KITCHENS),
    }
    for title, models in names.items():
        jobs = [kitchens.KitchenJob(name, robot, setting) for name in models for robot in sources]
        yield title, run_jobs(kitchens.run_kitchen, jobs, progress, title, "kitchen", given)
    unknown = [
        unknown_objects.UnknownObjectJob(robot, thing, setting, options.seed + k)
        for robot in sources
        for thing in unknown_objects.OBJECTS
        for k in range(ROUNDS)
    ]
    title = "objects whose joints nobody described"
    yield title, run_jobs(unknown_objects.open_one, unknown, progress, title, "object", given)


# -- what is reported ----------------------------------------------------------------------------------------


def make_live_report(
    runs: list[RealTimeRun], lock_step: list[tuple[str, list[Trial]]], options: Options
) -> Report:
    columns = {
        "robot": lambda one: one.robot,
        "object": lambda one: one.thing,
        "skills": lambda one: str(one.wanted),
        "done": lambda one: str(one.done),
        "time of one [s]": lambda one: f"{np.mean(one.seconds):.1f}" if one.seconds else "-",
        "error of the estimate [mm], [mrad]": lambda one: f"{1e3 * one.error:.1f}",
        "force [N]": lambda one: f"{one.force:.0f}",
        "reading to estimate [ms]": lambda one: f"{np.median(one.estimate):.2f}" if one.estimate else "-",
        "real-time factor": lambda one: f"{one.factor:.4f}",
        "late steps [%]": lambda one: f"{100 * one.late:.2f}",
        "restarts": lambda one: str(one.restarts),
        "failure": lambda one: one.reason,
    }
    how = "by topics of ROS 2" if options.ros else "by processes around a model server"
    title = f"Opened and closed in real time, {how}"
    failed = [one for _, trials in lock_step for one in trials]
    tables = [make_table(title, runs, columns)]
    tables += [make_group_table(f"In lock step: {name}", own, (*ROW, *SUCCESS)) for name, own in lock_step]
    tables.append(make_failure_table(failed))
    numbers = {
        "seed": options.seed,
        "runs": [one.as_data() for one in runs],
        "lock_step": {name: make_trial_numbers(own) for name, own in lock_step},
    }
    return Report("live", "The whole system, live (2022 paper, IV-D)", _filled(tables), numbers, _draw(runs))


def _filled(tables: Sequence[ReportTable]) -> tuple[ReportTable, ...]:
    return tuple(table for table in tables if table.rows)


def _draw(runs: list[RealTimeRun]) -> Figure:
    def draw(canvas: Any) -> None:
        axes = canvas.add_subplot()
        names = [f"{one.robot}, {one.thing}" for one in runs]
        for k, one in enumerate(runs):
            axes.scatter(one.seconds, [k] * len(one.seconds), s=40)
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("time of an opening or a closing [s]")

    return Figure(draw, (9.0, 4.0))
