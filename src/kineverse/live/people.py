"""Acts of people on a live system: they move furniture, hide markers, add noise, and cut processes."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Final

import numpy as np

from kineverse.articulations import Fixed
from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.exchange import LiveModel
from kineverse.exchange.state import StateReader
from kineverse.lie import Array, rotation_z, transform
from kineverse.model.body import Pose
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .live_status import PATIENCE
from .streams import SUPERVISOR, ProcessRow, SupervisorNote, read_note

USUAL_NOISE: Final = "3mm+3mm/m,0.5deg,30Hz"
NOISES: Final[Mapping[str, str]] = {
    "none": "none",
    "usual": USUAL_NOISE,
    "10 mm, 2°": "10mm,2deg,30Hz",
    "outliers": f"{USUAL_NOISE},outliers=0.05",
}
"""Settings of :meth:`.Sensors.parse` by their name on the page."""

FREEZE: Final = 1.0  # time for which a process is frozen [s]


class Place:
    """Place of a piece of furniture: x, y [m] and an angle about z [rad] in the world, as an edit changes it.

    The frame is one of :func:`list_furniture`; any other is an UnknownNameError.
    """

    def __init__(self, model: ModelView, frame: str) -> None:
        pieces = list_furniture(model)
        if frame not in pieces:
            raise UnknownNameError(f"'{frame}' is no furniture. {suggest(frame, pieces, 'piece')}")
        self._frame, self._joint = frame, pieces[frame]
        self._record = model.articulations[self._joint]
        self._world_T_parent = _find_pose(model, self._record.parent)
        self._pose = _find_pose(model, frame)
        self.x, self.y = self._pose[:2, 3].tolist()
        self.angle = math.atan2(self._pose[1, 0], self._pose[0, 0])

    def move(self, x: float, y: float, angle: float) -> Fixed:
        """Return the operation that puts the piece elsewhere; height and tilt stay."""
        if not all(map(math.isfinite, (x, y, angle))):
            raise InvalidValueError("A place is given by finite numbers.")
        turned = rotation_z(np.asarray(angle - self.angle)) @ self._pose[:3, :3]
        pose = transform(turned, np.array([x, y, self._pose[2, 3]]))
        record, origin = self._record, Pose.from_matrix(np.linalg.inv(self._world_T_parent) @ pose)
        ends = {"parent": record.parent, "child": self._frame}
        return Fixed(name=self._joint, origin=origin, dynamics=record.dynamics, **ends)


def _find_pose(model: ModelView, frame: str) -> Array:
    return np.eye(4) if frame == WORLD else np.asarray(compile(model.fk(frame))({}))


def list_furniture(model: ModelView, robot: Collection[str] = ()) -> dict[str, str]:
    """Return the pieces of furniture that can be put elsewhere: the name of the fixed joint by the frame.

    These are the bodies that stand in the world; frames of a robot are none.
    """
    return {
        record.child: name
        for name, record in model.articulations.items()
        if record.kind == "fixed"
        and record.child in model.bodies
        and record.child not in robot
        and not model.fk(record.child).symbols
    }


def move_furniture(live: LiveModel, frame: str, x: float, y: float, angle: float) -> None:
    """Put a piece of furniture elsewhere by an edit of the served model [m], [rad]."""

    def change(edit: Edit) -> None:
        (*_, tag) = live.history.writers(f"frames/{frame}")
        edit.replace(tag, Place(live, frame).move(x, y, angle))

    live.transact(change)


def find_carried(model: ModelView, coordinate: Symbol) -> list[str]:
    """Return the frames that a coordinate moves, whose markers show it."""
    return [name for name in model.frames if name != WORLD and coordinate in model.fk(name).symbols]


def find_process(reader: StateReader, name: str) -> ProcessRow:
    """Return a process that the supervisor has told of just now; any other is an UnknownNameError."""
    note, age = read_note(reader, SUPERVISOR, SupervisorNote), reader.age.get(SUPERVISOR, math.inf)
    rows = {} if note is None or age > PATIENCE[SUPERVISOR] else {row.name: row for row in note.rows}
    row = rows.get(name)
    if row is None or row.pid <= 1:
        raise UnknownNameError(f"No supervisor tells of a running process '{name}'.")
    return row


def cut_process(reader: StateReader, name: str, freeze: bool = False) -> None:
    """Kill a process of the live system, or freeze it for a second.

    One that the supervisor does not tell of is an UnknownNameError, one that is gone a KineverseError.
    """
    pid = find_process(reader, name).pid
    try:
        if not freeze:
            os.kill(pid, signal.SIGKILL)
            return
        os.kill(pid, signal.SIGSTOP)
        thaw = threading.Timer(FREEZE, lambda: _continue(pid))
        thaw.daemon = True
        thaw.start()
    except OSError as error:
        raise KineverseError(f"The process '{name}' cannot be cut: {error.strerror}.") from None


def _continue(pid: int) -> None:
    with contextlib.suppress(OSError):  # it was killed meanwhile
        os.kill(pid, signal.SIGCONT)


class Errands:
    """Thread that does what people ask for, of each kind the newest only.

    How it went is told to a function: a line, and whether it was refused.
    """

    def __init__(self, tell: Callable[[str, bool], None]) -> None:
        self._tell = tell
        self._change = threading.Condition()
        self._waiting: dict[str, tuple[str, Callable[[], object]]] = {}
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="kineverse-errands", daemon=True)
        self._thread.start()

    def send(self, kind: str, line: str, function: Callable[[], object]) -> None:
        """Have something done, in place of what was asked of that kind and is not begun."""
        with self._change:
            self._waiting[kind] = line, function
            self._change.notify()

    def close(self) -> None:
        """Begin nothing more."""
        with self._change:
            self._is_closed = True
            self._change.notify()

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                kind = next(iter(self._waiting))
                line, function = self._waiting.pop(kind)
            try:
                function()
                self._tell(f"{time.strftime('%H:%M:%S')} {line}", False)
            except KineverseError as error:
                self._tell(f"{time.strftime('%H:%M:%S')} refused: {line}. {error}", True)
