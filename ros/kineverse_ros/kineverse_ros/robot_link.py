"""Messages between a skill, its robot node and the guard of that node, over sockets in this machine.

Times are those of the machine's steady clock, which all processes share: a clock that is set does not move
them. A process that ends closes its socket, however it ends, and the others know at once.
"""

from __future__ import annotations

import select
import socket
import time
from contextlib import suppress
from typing import Any

import msgspec

_LARGEST = 1 << 20  # size of a message [B]
_BUFFER = 1 << 20

now = time.monotonic
"""The present time [s]."""


class Wiring(msgspec.Struct, frozen=True, array_like=True):
    """What the robot node needs of settings and model: names and topics, no geometry."""

    joint_states: str
    joints: tuple[str, ...]  # names of all joints in the model
    joint_rules: dict[str, str]
    read: tuple[str, ...]  # coordinates that are read from joint states; the order of readings
    odometry: tuple[str, str] | None  # frames in TF between which the base is read; None without that
    command: str | None  # topic of Twist
    controllers: tuple[tuple[str, int], ...]  # topics with their numbers of joints
    trajectory: str
    frames: dict[str, str]  # frames of the model that readings place, by names in ROS
    poses: dict[str, str]  # topics of PoseStamped by frame of the model
    transforms: dict[str, str]  # observed frames of the model by name in TF
    timeout: float
    use_sim_time: bool


class Start(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """What the robot node is for; the first message to it."""

    wiring: Wiring


class Speeds(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Speeds to command now, until others come or the time is up."""

    sent: float
    stamp: float  # of the readings from which they were made
    base: tuple[float, float, float]  # x, y [m/s] and heading [rad/s], in the axes of the base's frame
    controllers: tuple[tuple[float, ...], ...]


class Follow(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Path to follow from now on."""

    sent: float
    stamp: float
    joints: tuple[str, ...]  # names in ROS
    times: tuple[float, ...]
    positions: tuple[tuple[float, ...], ...]
    velocities: tuple[tuple[float, ...], ...]


class Beat(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Sign of life of somebody who has the robot moved."""

    sent: float
    follows: bool  # False at the end of a path; one that is not over is given up
    hold: tuple[tuple[str, ...], tuple[float, ...]] = ((), ())  # where joints stop that follow a path
    moves: bool = False


class End(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Good-bye: the robot stands, and nobody needs to stop it."""


class Pose(msgspec.Struct, frozen=True, array_like=True):
    """Observed pose of a frame of the model in another one of it."""

    frame: str
    parent: str
    stamp: float
    numbers: tuple[float, ...]  # position and quaternion (x, y, z, w)


class Readings(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Readings of the robot, and poses that were observed since the last ones."""

    stamp: float  # the oldest of the readings
    joints: tuple[float, ...]
    base: tuple[float, ...] | None  # position and quaternion of the base's frame in TF
    poses: tuple[Pose, ...]


class Note(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Sentence on what is wrong."""

    text: str
    fatal: bool = False


_DECODER = msgspec.msgpack.Decoder(Start | Speeds | Follow | Beat | End | Readings | Note)


class Link:
    """One end of a connection of two processes; messages arrive whole and in order, or not at all."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)

    @classmethod
    def pair(cls) -> tuple[Link, socket.socket]:
        """Return an end, and the socket of the other one, for another process."""
        own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(own), other

    def fileno(self) -> int:
        """Return the file descriptor of this end."""
        return self._socket.fileno()

    def send(self, message: Any, wait: float = 0.0) -> bool:
        """Send a message; return False if the other end is gone, or takes none within a time [s]."""
        data = msgspec.msgpack.encode(message)
        try:
            if wait:
                select.select([], [self._socket], [], wait)
            self._socket.send(data, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def receive(self, timeout: float | None = None) -> Any:
        """Return the next message, or None after a time [s]; an EOFError if the other end is gone."""
        try:
            ready, _, _ = select.select([self._socket], [], [], timeout)
            if not ready:
                return None
            data = self._socket.recv(_LARGEST)
        except (OSError, ValueError):  # this end was closed meanwhile
            data = b""
        if not data:
            raise EOFError
        return _DECODER.decode(data)

    def close(self) -> None:
        """Close this end, and have a receive in another thread end."""
        with suppress(OSError):  # the other end is gone
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
