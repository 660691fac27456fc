"""Faults of live systems: processes are killed or frozen while a robot moves; it stops and finishes later."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

import kineverse as kv
from kineverse.errors import OfflineError, UnknownNameError
from kineverse.live.streams import (
    ACTIVITY,
    ROBOT,
    SUPERVISOR,
    TRUTH,
    ActivityNote,
    RobotNote,
    SupervisorNote,
    decode,
    read_note,
)
from kineverse_studies.experiments.live import started

from .processes import folder, wait_until

DRAWER, HANDLE = "kitchen/sink_left_upper_drawer", "kitchen/sink_left_upper_drawer_handle"
SPEED = 0.2  # speed with which the drawer is pulled [m/s]
ZERO, REST, HELD = 0.05, 0.15, 0.01
"""Longest times from a fault until commanded speeds are zero, and the robot rests [s]; and the longest way of
a handle that is held [m]."""
SLOW = 0.05  # speed of a joint below which a robot rests [m/s], [rad/s]
FROZEN = 1.0  # time for which a process is frozen [s]
SPEEDING_UP = 0.5  # time in a phase until the robot has its speed [s]
AFTER = 0.5  # time for which the robot is watched after a fault [s]
STARTING, FINISHING = 120.0, 240.0  # longest times until a phase, and until all is done [s]
HOLDING = "move"  # phase in which the robot holds the object and moves it


class Fault(NamedTuple):
    """Signal to a process in a phase of a skill."""

    process: str
    signal: str  # KILL or STOP
    phase: str

    def __str__(self) -> str:
        return f"{self.process} {self.signal} in {self.phase}"


FAULTS = (
    Fault("behave", "KILL", HOLDING),
    Fault("track", "STOP", HOLDING),
    Fault("world", "STOP", HOLDING),
    Fault("behave", "KILL", "approach"),
    Fault("behave", "STOP", HOLDING),
    Fault("track", "KILL", HOLDING),
    Fault("behave", "STOP", "approach"),
    Fault("track", "KILL", "approach"),
    Fault("track", "STOP", "approach"),
    Fault("behave", "KILL", "close"),
    Fault("track", "KILL", "retract"),
    Fault("serve", "KILL", HOLDING),
)
"""The runs; the first two are the short form."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--runs", type=int, default=len(FAULTS), help=f"how many of the {len(FAULTS)} runs")
    parser.add_argument("--robot", default="hsr", help="a robot that ships (hsr)")
    parser.add_argument("--most", type=float, default=1.0, help="times the bars that are held (1)")


def run(arguments: argparse.Namespace) -> Iterator[str]:
    """Try the runs, and yield a line for each."""
    setting = Setting(make_kitchen(), DRAWER, HANDLE, arguments.robot)
    for k, fault in enumerate(FAULTS[: arguments.runs]):
        (found,) = try_faults(setting, [fault], arguments.most)
        times = [
            f"{name} after {1e3 * found[name]:.0f} ms" for name in ("zero", "rest") if found[name] >= 0.0
        ]
        yield ", ".join([f"{k + 1} {fault}", *times, f"the handle {1e3 * found['way']:.1f} mm", "then done"])


class Watch(threading.Thread):
    """Thread that keeps what a live system publishes."""

    def __init__(self, model: kv.exchange.LiveModel, what: str, handle: str) -> None:
        super().__init__(daemon=True)
        self._model, self.reader = model, model.exchange.reader()  # streams end with their model
        self._place = kv.compile([model.fk(handle)[:3, 3]])
        self._what, self.over = what, False
        self.robot: list[tuple[float, float, np.ndarray]] = []  # stamp, commanded speed, encoders
        self.truth: list[tuple[float, float, np.ndarray]] = []  # stamp, value, place of the handle
        self.phase = ""

    def run(self) -> None:
        """Keep each reading."""
        while not self.over:
            self.reader.wait(0.1)
            newest = self.reader.newest(ROBOT)
            note = None if newest is None else decode(newest.note, RobotNote)
            if newest is not None and note is not None and _is_new(self.robot, newest.stamp):
                self.robot.append((newest.stamp, note.commanded, newest.values))
            truth = self.reader.newest(TRUTH)
            if truth is not None and _is_new(self.truth, truth.stamp):
                values = truth.named
                place = self._place([values[str(s)] for s in self._place.inputs])
                self.truth.append((truth.stamp, values[self._what], np.array(place).ravel()))
            doing = read_note(self.reader, ACTIVITY, ActivityNote)
            self.phase = self.phase if doing is None else doing.phase

    @property
    def speed(self) -> float:
        """Commanded speed of the last reading."""
        return self.robot[-1][1] if self.robot else 0.0

    def pids(self) -> dict[str, int]:
        """Return the processes that the supervisor has."""
        note = read_note(self.reader, SUPERVISOR, SupervisorNote)
        return {} if note is None else {row.name: row.pid for row in note.rows if row.pid}


def _is_new(kept: list[tuple[float, float, np.ndarray]], stamp: float) -> bool:
    return not kept or stamp > kept[-1][0]


class Setting(NamedTuple):
    """Scene of a live system, and the object that is opened and closed."""

    model: kv.Model
    what: str
    handle: str
    robot: str = "hsr"
    world: str = "mujoco"


def try_faults(setting: Setting, faults: Sequence[Fault], most: float = 1.0) -> list[dict[str, float]]:
    """Start a live system, send signals to its processes, and return what was measured after each."""
    with folder() as path:
        output, model = Path(path, "output"), Path(path, "model.kv.json")
        setting.model.save(model)
        words = ["live", str(model), "--robot", setting.robot, "--world", setting.world, "--do", "tour"]
        words += ["--far", "1", "--what", setting.what, "--headless", "--json", "--name", "fault"]
        words += ["--seconds", str(FINISHING)]
        with started(words, output, stderr=subprocess.STDOUT, cwd=path) as system:
            watch = Watch(_connect(system, output), setting.what, setting.handle)
            watch.start()
            found = [_send(fault, watch, system, output, most) for fault in faults]
            _finish(faults, system, output)
            watch.over = True
            return found


def make_kitchen() -> kv.Model:
    """Return the kitchen with a drawer that is pulled slowly."""
    model = kv.Model()
    with model.edit() as edit:
        edit.include("kitchen")
        edit.constrain("slow", -SPEED, kv.velocity(DRAWER), SPEED)
    return model


def _send(
    fault: Fault, watch: Watch, system: subprocess.Popen[bytes], output: Path, most: float
) -> dict[str, float]:
    """Send a signal in its phase, and check how the robot stops."""
    moves = fault.phase in (HOLDING, "approach", "retract")

    def is_there() -> bool:
        assert system.poll() is None, f"{fault}: it ended: {output.read_text('utf-8')[-2000:]}"
        return watch.phase == fault.phase and (not moves or watch.speed > 2 * SLOW)

    wait_until(is_there, STARTING, f"the phase '{fault.phase}'")
    if moves:
        time.sleep(SPEEDING_UP)
    pid = watch.pids()[fault.process]
    at = time.time()
    os.kill(pid, getattr(signal, f"SIG{fault.signal}"))
    if fault.signal == "STOP":
        time.sleep(FROZEN)
        os.kill(pid, signal.SIGCONT)
    else:
        time.sleep(AFTER)
    found = _find_stop(watch, at)
    if fault.process in ("behave", "track") and moves:
        assert found["zero"] <= most * ZERO, f"{fault}: commanded speeds are zero after {found['zero']:.3f} s"
        if fault.phase == HOLDING:
            assert found["way"] <= most * HELD, f"{fault}: the handle moved {1e3 * found['way']:.1f} mm"
        else:
            assert found["rest"] <= most * REST, f"{fault}: the robot rests after {found['rest']:.3f} s"
    else:
        found |= {"zero": math.nan, "rest": math.nan}
    return found


def _finish(faults: Sequence[Fault], system: subprocess.Popen[bytes], output: Path) -> None:
    """Wait until all is done, and check that what was killed was started again."""
    which = ", ".join(map(str, faults))
    try:
        system.wait(FINISHING)
    except subprocess.TimeoutExpired:
        raise AssertionError(f"{which}: not finished. {output.read_text('utf-8')[-2000:]}") from None
    text = output.read_text("utf-8")
    assert system.returncode == 0, f"{which}: not done. {text[-2000:]}"
    restarts = json.loads(text[text.index("{") :])["restarts"]
    for name in {fault.process for fault in faults if fault.signal == "KILL"}:
        assert restarts.get(name), f"{which}: '{name}' was not started again"


def _connect(system: subprocess.Popen[bytes], output: Path) -> kv.exchange.LiveModel:
    model: list[kv.exchange.LiveModel] = []

    def connects() -> bool:
        assert system.poll() is None, f"it ended: {output.read_text('utf-8')[-2000:]}"
        with suppress(OfflineError, UnknownNameError):
            model.append(kv.load("live:fault"))
        return bool(model)

    wait_until(connects, STARTING, "a model server")
    return model[0]


def _find_stop(watch: Watch, at: float) -> dict[str, float]:
    """Return when commands were zero and the robot rested [s], and how far the handle went [m]."""
    robot = [one for one in watch.robot if at - 0.1 < one[0] < at + AFTER]
    truth = [one for one in watch.truth if at - 0.1 < one[0] < at + AFTER]
    zero = next((stamp for stamp, commanded, _ in robot if stamp > at and not commanded), math.inf)
    moving = [
        b[0] for a, b in pairwise(robot) if b[0] > a[0] and np.abs(b[2] - a[2]).max() / (b[0] - a[0]) > SLOW
    ]
    before = [one for one in truth if one[0] <= at]
    after = [one for one in truth if one[0] > at]
    way = (
        max((float(np.linalg.norm(one[2] - before[-1][2])) for one in after), default=0.0) if before else 0.0
    )
    return {"zero": zero - at, "rest": max(moving, default=at) - at, "way": way}
