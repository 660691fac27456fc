"""Experiments by name, and their options."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias

from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .report import Report

WORLDS, BOTH = ("kinematic", "mujoco"), "both"  # worlds of trials, and the option for all of them


@dataclass(frozen=True)
class Options:
    quick: bool = False  # true for a reduced experiment, in seconds
    data: Path | None = None  # folder of recordings or robots
    model: str | None = None  # name or path of the model; None for the default
    models: tuple[Path, ...] = ()  # folders of further models
    seed: int = 0  # first seed
    count: int | None = None  # number of seeds, repetitions or the like; None for the default
    robot: tuple[str, ...] = ()  # names or paths of robots; empty for the default
    processes: int | None = None  # number of processes; None for the number of cores
    world: str = WORLDS[0]  # ``"kinematic"``, ``"mujoco"``, or ``"both"``
    noise: str | None = None  # as kineverse.worlds.Sensors.parse reads it; None to act on the truth
    ros: bool = False  # whether the robot is only topics of ROS 2
    record: Path | None = None  # folder of recordings, a path of the computer on which a trial runs
    executor: Executor | None = None  # where trials run, such as dask's client.get_executor()

    def check(self, name: str, supported: Sequence[str]) -> None:
        given = [field.name for field in fields(self) if getattr(self, field.name) != field.default]
        for option in given:
            if option == "executor" and "processes" not in supported:
                raise InvalidValueError(f"The experiment '{name}' runs in one process, without an executor.")
            if option not in supported and option != "executor":
                takes = ", ".join(f"--{known}" for known in supported) or "no options"
                raise InvalidValueError(f"The experiment '{name}' takes no --{option}. It takes {takes}.")
        for option, least in (("seed", 0), ("count", 1), ("processes", 1)):
            value = getattr(self, option)
            if value is not None and value < least:
                raise InvalidValueError(f"--{option} is a whole number from {least} on, not {value}.")
        if self.world not in (*WORLDS, BOTH):
            raise UnknownNameError(f"--world {self.world}: {suggest(self.world, (*WORLDS, BOTH), 'world')}")


Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]
EXPERIMENTS: Mapping[str, str] = {
    "fig3": "the garage door and its lock (2022 paper, Fig. 3 and Eqs. 11-13)",
    "fig4": "a kitchen tracked from poses of its parts (2022 paper, Fig. 4; 2020 paper, IV-A)",
    "sturm": "hinges and sliders learned from recordings of doors and drawers (--data FOLDER)",
    "stream": "a door that a hand opens, tracked and monitored at 30 Hz with correlated errors",
    "joint-types": "types of random hinges and sliders, with and without stated noise",
    "joint-families": "families of parts that are no hinge and no slider, and of parts that no joint holds",
    "kitchens": "generated kitchens, of which robots open and close all (--seed N --count 50)",
    "table1-open": "grasped objects are opened, also by the papers' two programs (2022 paper, Table I)",
    "table1-push": "twelve objects of a kitchen are pushed shut (both papers, Table I)",
    "checks": "what the motion checks find in models broken on purpose (--seed N --count 20 --models FOLDER)",
    "unknown-objects": "a door and a drawer whose joints nobody described are opened (--count 10)",
    "lockbox": "parts that lock each other, opened by trends and by plans (thesis behind the 2020 paper)",
    "live": "three objects opened and closed by processes in real time, and kitchens (2022 paper, IV-D)",
    "ablations": "pushes and locks without augmented gradients, and with each rule of trends",
    "calibration": "joints, cameras and wheels calibrated, against the Cramér-Rao bound and OpenCV",
    "estimation-grid": "hinges and sliders learned from noisy poses, against the Cramér-Rao bound",
    "conversion": "models written as URDF, MJCF and SDF, compared with pinocchio, MuJoCo and drake",
}
"""Descriptions of experiments by name; the names are modules of this package, with dashes for underscores."""
REQUIRED_EXTRAS: Mapping[str, tuple[str, ...]] = {  # extras without which an experiment cannot run
    "conversion": ("check",),
    "ablations": ("control", "geometry"),
    "checks": ("geometry",),
    "kitchens": ("control", "geometry"),
    "live": ("control", "geometry", "mjcf", "exchange"),
    "lockbox": ("control",),
    "table1-open": ("control", "geometry"),
    "table1-push": ("control", "geometry"),
    "unknown-objects": ("control", "geometry"),
}
PLANNED = ("kitchens", "live", "table1-open", "unknown-objects")  # they plan, which needs a C compiler


def reproduce(name: str, progress: Progress | None = None, options: Options | None = None) -> Report:
    """Run an experiment.

    Parameters
    ----------
    name
        One of :data:`EXPERIMENTS`.
    progress
        Progress reporter, such as :func:`kineverse.cli.output.show_progress`; None for none.
    options
        Options; the defaults if None.

    Raises
    ------
    UnknownNameError
        If there is no such experiment, with similar names.
    InvalidValueError
        If it does not support an option.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError(
            f"There is no experiment {name!r}. {suggest(name, EXPERIMENTS, 'experiment')} "
            "'kineverse reproduce --list' says what each is about."
        )
    module = importlib.import_module(f"{__package__}.{name.replace('-', '_')}")
    options = options or Options()
    options.check(name, module.OPTIONS)
    report: Report = module.run(progress or _no_progress, options)
    return report


def _no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items
