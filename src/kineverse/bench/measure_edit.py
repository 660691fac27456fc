"""``edit``: what changes of a model cost, when it is large and when it is a robot."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from .edited_robot import JOINT, MUJOCO, PINOCCHIO, compiled_again, joint_replaced, read_again
from .large_model import (
    COPY,
    READERS,
    RELEVANT,
    TO_EMPTY,
    TO_LARGE,
    large_model,
    on_large,
    runs_of_replacing,
)
from .peers import Field
from .result import Bar, Comparison, Measurement, Result, at_most, faster
from .robot import find_robot
from .settings import Settings
from .timing import race


def measure(settings: Settings) -> Result:
    """Measure what edits of a large model and of a robot cost."""
    robot = find_robot(settings)
    large = large_model(settings.operations)
    measured = race("edit", list(on_large(large)), settings.rounds, settings.progress)
    runs = Measurement("operations run by that", "operations", (float(runs_of_replacing(large)),))
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        field = Field([joint_replaced(robot)])
        field.admit("pinocchio", lambda: [read_again(robot, Path(folder))])
        field.admit("mujoco", lambda: [compiled_again(robot)])
        edited = race("edit", field.contenders, settings.rounds, settings.progress)
    ratio = faster(measured, TO_LARGE, TO_EMPTY)
    return Result(
        name="edit",
        work=(
            f"edits of a model of {len(large.history.tags)} operations and {len(large.constraints)} "
            f"constraints; one joint of {robot.file.name} replaced, until the next pose of {robot.frame}"
        ),
        measurements=(*measured.values(), runs, *edited.values()),
        comparisons=(
            replace(ratio, bar=Bar(0.5, at_least=True)),
            Comparison(runs.name, runs.median, runs.unit, Bar(1 + READERS, at_least=False)),
            at_most(measured[RELEVANT], 50e-6),
            at_most(measured[COPY], 20e-6),
            at_most(edited[JOINT], 5e-3),
            faster(edited, JOINT, PINOCCHIO),
            faster(edited, JOINT, MUJOCO),
        ),
        missing=tuple(field.missing),
    )
