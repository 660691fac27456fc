"""Language of the processes of a live system: vectors, notes beside them, and questions.

Numbers go as vectors of state streams, so that everybody can read them; notes say the rest, as msgpack. All
stamps are times of the robot, which is the clock of the world's computer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, TypeAlias, TypeVar

import msgspec
import numpy as np

from kineverse.errors import KineverseError
from kineverse.exchange.protocol import encode as encode
from kineverse.exchange.state import Newest, StateReader
from kineverse.lie import Array
from kineverse.symbols import Symbol
from kineverse.worlds import Observation

ROBOT: Final = "robot"  # source of encoders, touch sensors and guards
CAMERA: Final = "camera"  # source of poses of visible markers
TRUTH: Final = "truth"  # source of the true state of a simulated world, for pages, recordings and judges
COMMANDS: Final = "commands"  # source of speeds
TRACKER: Final = "tracker"  # source of the believed state
ACTIVITY: Final = "activity"  # source of what is being done, and why
LEARNER: Final = "learner"  # source of what is thought of joints
SUPERVISOR: Final = "supervisor"  # source of how the processes are

TICK: Final = 0.01  # time between two readings of encoders [s]
TIMEOUT: Final = 0.04  # age of the state of a command from which on the robot stops [s]
OLDEST: Final = 0.1  # age of the state of a command that is never obeyed [s]


class RobotNote(msgspec.Struct, array_like=True):
    """Note beside the encoders of a robot."""

    world: str  # name of what the robot acts in
    timeout: float  # time after which a command no longer acts [s]
    touching: list[str]  # frames whose touch sensors report
    stopped: str = ""  # why the robot takes no commands at all; empty if it does
    force: float = math.nan  # largest force between the robot and another body [N]
    commanded: float = 0.0  # largest of the speeds that act, without fingers [m/s], [rad/s]
    refused: int = 0  # commands that were too old, in all
    late: int = 0  # ticks that began late by more than half of one, in all
    dropped: int = 0  # ticks that were left out, in all
    ticks: int = 0
    factor: float = 1.0  # time of the world by the time that has passed


class CameraNote(msgspec.Struct, array_like=True):
    """Note of a camera: one picture."""

    picture: int  # its number
    poses: dict[str, bytes]  # world_T_frame of the visible markers as 16 doubles

    @classmethod
    def make(cls, picture: int, poses: Mapping[str, Array]) -> CameraNote:
        """Return the note of some poses (4, 4)."""
        return cls(picture, {name: np.ascontiguousarray(pose).tobytes() for name, pose in poses.items()})

    def read(self) -> dict[str, Array]:
        """Return the poses (4, 4) by frame."""
        size = 16 * np.dtype(float).itemsize
        found = {name: data for name, data in self.poses.items() if len(data) == size}
        return {name: np.frombuffer(data).reshape(4, 4) for name, data in found.items()}


class CommandNote(msgspec.Struct, array_like=True):
    """Note beside the speeds of a robot, zero where none was given."""

    number: int  # of the command, by its sender
    duration: float  # time for which it acts [s]
    stamped: bool  # whether the stamp of the vector is that of a state
    kept: list[int]  # places of the fingers that keep their speed
    planned: dict[str, float]  # speeds planned for objects [m/s], [rad/s]


class TrackerNote(msgspec.Struct, array_like=True):
    """Note beside a believed state."""

    deviations: bytes  # standard deviations of the coordinates, as doubles
    seen: dict[str, float]  # time at which a marker of a coordinate was seen last [s]
    lost: list[str]  # coordinates whose track is lost, or that were never seen
    milliseconds: float  # time from a reading to its estimate


class SkillResult(msgspec.Struct, array_like=True):
    """Result of a skill at an object."""

    what: str  # the object's coordinate
    skill: str  # open or close
    done: bool
    reason: str
    seconds: float = 0.0


class ActivityNote(msgspec.Struct, array_like=True):
    """Note of a behaviour: what it does, and why."""

    behaviour: str
    doing: str = ""  # the skill and its object, or what is waited for
    why: str = ""
    phase: str = ""  # phase of the skill
    way: bytes = b""  # points (k, 3) of the way ahead of the hand, as doubles [m]
    wanted: bytes = b""  # pose (4, 4) at which the hand is wanted now
    vectors: dict[str, bytes] = {}  # vectors of the controller, origin and vector (2, 3)
    done: int = 0  # skills that were done, in all
    failed: int = 0
    last: str = ""  # result of the last skill
    steps: int = 0  # control steps, in all
    late: int = 0  # those that began late by more than 5 ms, in all
    results: list[SkillResult] = []  # of the last skills

    def read_way(self) -> Array | None:
        """Return the points (k, 3) of the way [m]; None without any."""
        return as_array(self.way, (-1, 3))

    def read_vectors(self) -> dict[str, tuple[Array, Array]]:
        """Return the vectors (3,) by name, each after its origin in the world [m]."""
        found = {name: as_array(data, (2, 3)) for name, data in self.vectors.items()}
        return {name: (ends[0], ends[1]) for name, ends in found.items() if ends is not None}


class ProcessRow(msgspec.Struct, array_like=True):
    """State of a process of a live system, as its supervisor sees it."""

    name: str  # its command, such as world
    pid: int  # 0 while there is none
    state: str  # running, starting, frozen, or how it ended
    restarts: int = 0
    cpu: float = math.nan  # share of a core


class SupervisorNote(msgspec.Struct, array_like=True):
    """Note of a supervisor: its processes, in the order in which they were started."""

    rows: list[ProcessRow]


class WatchedPart(msgspec.Struct, array_like=True):
    """Part whose joint is unknown, and what is thought of it."""

    frame: str
    parent: str  # frame relative to which it is watched
    state: str  # waits, moves, hidden, sure or written
    family: str = ""  # most probable kind of joint; empty before there is one
    probability: float = math.nan
    way: float = 0.0  # motion from where it stood [m]
    turn: float = 0.0  # the same [rad]
    poses: int = 0  # number of poses that were learned from


class ProposalRow(msgspec.Struct, array_like=True):
    """Operation that the learner would write."""

    tag: str
    what: str  # in words
    waits: str = ""  # what it waits for: a time, the server, or to be accepted


class LearnerNote(msgspec.Struct, array_like=True):
    """Note of a learner. The question ``accept`` (tag) has a proposal written."""

    watched: list[WatchedPart] = []
    alarms: dict[str, str] = {}  # why a part of the model is implausible, by its tag
    proposals: list[ProposalRow] = []
    edits: int = 0  # that were written, in all
    last: str = ""  # what was written last, or why it was not
    problem: str = ""  # why nothing is learned at all, such as a camera that sees nothing


class Ask(msgspec.Struct):
    """Question to a world: something that people do."""

    do: str
    arguments: dict[str, Any] = {}


class Answer(msgspec.Struct):
    """Answer to a question: an error, or what was asked for."""

    error: str = ""
    value: Any = None


Note = TypeVar("Note")
Handler: TypeAlias = Callable[..., Any]


def decode(data: bytes, kind: type[Note]) -> Note | None:
    """Return a note of a kind; None for bytes that are none, such as of another version."""
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except msgspec.MsgspecError:
        return None


def as_array(data: bytes, shape: tuple[int, int]) -> Array | None:
    """Return doubles as an array of a shape; None if there are none, or as many as do not fit."""
    count, left = divmod(len(data), np.dtype(float).itemsize)
    fits = count == shape[0] * shape[1] if shape[0] > 0 else count % shape[1] == 0
    if not count or left or not fits:
        return None
    found = np.frombuffer(data).reshape(shape)
    return found if np.isfinite(found).all() else None


class ObservationReader:
    """Reader of what a robot says, and of each picture of its camera once."""

    def __init__(self, reader: StateReader) -> None:
        self._reader, self._picture = reader, -1

    def read(self, robot: Newest, touching: Iterable[str], symbols: Mapping[str, Symbol]) -> Observation:
        """Return the readings in a robot's vector, those of known names, with the picture that is new."""
        poses: dict[str, Array] = {}
        seen, picture = None, self._reader.newest(CAMERA)
        shown = None if picture is None else decode(picture.note, CameraNote)
        if picture is not None and shown is not None and shown.picture != self._picture:
            self._picture, poses, seen = shown.picture, shown.read(), picture.stamp
        joints = {symbols[name]: value for name, value in robot.named.items() if name in symbols}
        return Observation(robot.stamp, joints, poses, frozenset(touching), seen)


def read_note(reader: StateReader, source: str, kind: type[Note]) -> Note | None:
    """Return the newest note of a source; None without any."""
    newest = reader.newest(source)
    return None if newest is None else decode(newest.note, kind)


def ask(reader: StateReader, source: str, do: str, timeout: float = 5.0, **arguments: Any) -> Any:
    """Ask a process to do something, and return its answer.

    It is an OfflineError if none comes, and a KineverseError with the reason if it cannot do that.
    """
    answer = decode(reader.ask(source, encode(Ask(do, arguments)), timeout), Answer)
    if answer is None:
        raise KineverseError(f"'{source}' has answered in another language; is it of another version?")
    if answer.error:
        raise KineverseError(answer.error)
    return answer.value


def answer_by(handlers: Mapping[str, Handler]) -> Callable[[bytes], bytes]:
    """Return a function that answers questions by functions, for :class:`.StatePublisher`."""

    def answer(data: bytes) -> bytes:
        question = decode(data, Ask)
        handler = None if question is None else handlers.get(question.do)
        if question is None or handler is None:
            return encode(Answer("That is not understood here; is it of another version?"))
        try:
            return encode(Answer(value=handler(**question.arguments)))
        except (KineverseError, TypeError) as error:
            return encode(Answer(str(error)))

    return answer
