"""Recordings of the lockbox of the thesis: opened by trends, by a plan, and with unknown locks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kineverse.gallery.lockboxes import THESIS, make_lockbox_model, remove_locks
from kineverse.manipulation import PartMover, Session, execute_unlocking, explore_locks
from kineverse.worlds import MechanismWorld, Recorder
from kineverse_studies.experiments.manipulation.setting import make_record_folder

from .unlocking_runs import run_unlocking

_DT = 0.05


def record_thesis_box(folder: Path) -> None:
    """Record how the lockbox of the thesis is opened, a file for each of the three ways."""
    make_record_folder(folder)
    with _start(folder, "trends") as (_, recorder):
        run = run_unlocking(THESIS, recorder=recorder)
        recorder.write_outcome({"done": run.done, "reason": f"{run.steps} steps"})
    with _start(folder, "plan") as (world, recorder):
        recorder.write_outcome(execute_unlocking(world, THESIS.goal, on_step=recorder).as_data())
    with _start(folder, "unknown-locks") as (world, recorder):
        model = make_lockbox_model(remove_locks(THESIS), None)
        mover = PartMover(model.snapshot(), Session(world, dt=_DT, on_step=recorder))
        done = explore_locks(model, THESIS.goal, mover.move)
        recorder.write_outcome({"done": done.done, "reason": f"{len(done.tries)} tries"})


@contextmanager
def _start(folder: Path, name: str) -> Iterator[tuple[MechanismWorld, Recorder]]:
    """Return a world with the box, and a recorder of it."""
    world = MechanismWorld(make_lockbox_model(THESIS, None))
    with Recorder(folder / f"thesis-{name}.mcap", world.model, {"box": "thesis", "by": name}) as recorder:
        yield world, recorder
