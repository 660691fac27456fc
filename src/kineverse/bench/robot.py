"""The robot on which everybody works, as Kineverse sees it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from kineverse.errors import KineverseError, UnknownNameError, ValueRejectedError
from kineverse.formats import load
from kineverse.formats.sources import locate_model
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.symbols import Symbol

from .agreement import Array
from .settings import Settings

PR2 = ("pr2_description/robots/pr2.urdf", "pr2_description/urdf/pr2.urdf", "pr2")
"""A real PR2 from the model path or from example-robot-data, else the one that ships."""

GRIPPER = "r_gripper_tool_frame"

_ONE_COORDINATE = ("fixed", "revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Robot:
    """A robot from a URDF file, with one frame of interest.

    Attributes
    ----------
    file
        The file that everybody reads.
    model
        What Kineverse makes of it, without prefix.
    frame
        Whose pose and Jacobian are computed, in the robot's root.
    """

    file: Path
    model: Model
    frame: str

    @cached_property
    def coordinates(self) -> tuple[Symbol, ...]:
        """All coordinates, the columns of :meth:`configurations`."""
        return self.model.symbols

    @cached_property
    def chain(self) -> tuple[Symbol, ...]:
        """The coordinates that move the frame; also the columns of its Jacobian."""
        return self.model.fk(self.frame).symbols

    @cached_property
    def mimics(self) -> dict[str, tuple[str, float, float]]:
        """The joints that follow others: whom, the multiplier and the offset; read from the file itself."""
        joints = ElementTree.parse(self.file).iterfind("joint")
        return {
            joint.get("name", ""): (
                mimic.get("joint", ""),
                float(mimic.get("multiplier", 1)),
                float(mimic.get("offset", 0)),
            )
            for joint in joints
            if (mimic := joint.find("mimic")) is not None
        }

    def configurations(self, count: int) -> Array:
        """Return configurations [rad], [m] in [-1, 1], shape (count, coordinates); always the same ones."""
        return np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self.coordinates)))

    def of_chain(self, configurations: Array) -> Array:
        """Return the columns of the coordinates that move the frame."""
        columns = [self.coordinates.index(symbol) for symbol in self.chain]
        return np.ascontiguousarray(configurations[:, columns])

    def positions(self, configurations: Array) -> dict[str, Array]:
        """Return the positions of all joints by name, those that follow others included."""
        columns = zip(self.coordinates, configurations.T, strict=True)
        known = {symbol.path: np.array(column) for symbol, column in columns}

        def position(joint: str) -> Array:
            if joint not in known:
                leader, multiplier, offset = self.mimics[joint]
                known[joint] = multiplier * position(leader) + offset
            return known[joint]

        for joint in self.mimics:
            position(joint)
        return known

    def __str__(self) -> str:
        return (
            f"{self.file.name} ({len(self.model.frames)} links, {len(self.coordinates) + len(self.mimics)} "
            f"moving joints, {self.file})"
        )


def find_robot(settings: Settings) -> Robot:
    """Return the robot that is wanted, else the first PR2 that is found.

    Raises
    ------
    UnknownNameError
        If there is no such robot, or no such frame on it.
    ValueRejectedError
        If peers have joints of other coordinates than Kineverse, so that comparing would take a translation:
        planar and floating ones, and those that follow others on the way to the frame.
    """
    file = _file(settings.robot)
    if file.suffix != ".urdf":
        raise ValueRejectedError(f"Peers read URDF, and {str(file)!r} is none; give another --robot.")
    model = load(file, prefix="")
    for name, articulation in model.articulations.items():
        if articulation.kind not in _ONE_COORDINATE:
            raise ValueRejectedError(
                f"Joint {name!r} is {articulation.kind}; robots to measure have joints with one coordinate."
            )
    robot = Robot(file, model, settings.frame or _default_frame(model))
    _check_chain(robot)
    return robot


def _file(name: str | None) -> Path:
    if name is not None:
        return locate_model(name).path
    for candidate in PR2[:-1]:
        try:
            return locate_model(candidate).path
        except UnknownNameError:
            continue
    return locate_model(PR2[-1]).path


def _default_frame(model: Model) -> str:
    if GRIPPER in model.frames:
        return GRIPPER
    led = [frame for frame in model.frames if _follower(model, frame) is None]
    return max(led, key=lambda frame: (len(model.speeds_of(frame)), frame))


def _check_chain(robot: Robot) -> None:
    if robot.frame not in robot.model.frames:
        robot.model.fk(robot.frame)  # raises, with similar names
    follower = _follower(robot.model, robot.frame)
    if follower is not None:
        raise ValueRejectedError(
            f"{robot.frame!r} is moved by {follower!r}, which follows another joint; choose another --frame."
        )
    if not robot.chain:
        raise ValueRejectedError(f"Nothing moves {robot.frame!r}; choose another --frame.")


def _follower(model: Model, frame: str) -> str | None:
    """Return a joint that moves the frame and follows another joint, if there is one."""
    above = {a.child: (name, a) for name, a in model.articulations.items()}
    while frame != WORLD:
        if frame in above:
            name, articulation = above[frame]
            if articulation.kind != "fixed" and not articulation.coordinates:
                return name
        frame = model.frames[frame].parent
    return None


def bare_text(file: str | os.PathLike[str]) -> str:
    """Return a URDF file without shapes, so that nobody looks for meshes.

    Raises
    ------
    KineverseError
        If it cannot be parsed.
    """
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise KineverseError(f"{file}: {error}") from None
    for element in [e for e in root if e.tag not in ("link", "joint")]:
        root.remove(element)
    for link in root.iterfind("link"):
        for shape in [e for e in link if e.tag in ("visual", "collision")]:
            link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")
