"""A robot in a model: what of it moves, stands, grasps and sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.expressions import Expression
from kineverse.formats.srdf.description import Srdf
from kineverse.grasping.gripper_detection import Gripper, find_gripper, find_grippers
from kineverse.lie import rotation_z, transform
from kineverse.model.body import is_empty_body
from kineverse.model.frame import WORLD, is_of_robot
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.symbols import Symbol

_CAMERA_WORDS = (("head", "tilt"), ("camera",), ("head",))  # in names, the likeliest first


@dataclass(frozen=True, slots=True)
class MobileBase:
    """Joint that places a robot in the world.

    Attributes
    ----------
    coordinates
        Its coordinates on which the place of the robot depends.
    parent, child
        Its frames: that in which it moves, and that of the robot.
    is_planar
        Whether the coordinates are x [m], y [m] and a heading [rad], in this order.

    See Also
    --------
    kineverse.worlds.Robot
    """

    coordinates: tuple[Symbol, ...]
    parent: str
    child: str
    is_planar: bool


class Robot:
    """A robot in a model, as skills, beliefs and worlds need it. :meth:`of` returns it.

    Attributes
    ----------
    model
        Model of the robot and of everything around it.
    name
        Prefix of its names in the model; empty if the model is the robot.
    frames
        Its frames, in the order of the model.
    bodies
        Those of them with shapes or masses.
    coordinates
        Its degrees of freedom, those of a mobile base included.
    speeds
        Its free speeds, in the order of the model.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> tags = model.include("kitchen")
    >>> robot = kv.worlds.Robot.of(model, "fetch")
    >>> robot.camera, robot.gripper().hand
    ('fetch/head_tilt_link', 'fetch/gripper_link')
    >>> robot.planar_base
    (fetch/base/x, fetch/base/y, fetch/base/angle)
    """

    def __init__(
        self, model: ModelView, name: str, frames: Sequence[str], *, srdf: Srdf | None = None
    ) -> None:
        self.model, self.name, self._srdf, self._version = model, name, srdf, model.version
        self.frames, self._owned = tuple(frames), frozenset(frames)
        self.coordinates = tuple(s for s in model.degrees_of_freedom if self.moves(s))
        self.speeds = tuple(v for v in model.speeds if self.moves(v))

    @classmethod
    def of(cls, model: ModelView, robot: Robot | str, *, srdf: Srdf | None = None) -> Robot:
        """Return a robot of a model; without a semantic description, one for each version of the model.

        Parameters
        ----------
        model
            Model that contains the robot.
        robot
            Prefix of the robot's names, empty if the model is the robot; or the robot of another version, or
            of another model, which keeps its semantic description.
        srdf
            Semantic description, whose end effectors come first among the grippers.

        Raises
        ------
        InvalidValueError
            For a robot that is neither a name nor a robot.
        UnknownNameError
            If nothing of the model that moves is below the prefix.

        See Also
        --------
        kineverse.worlds.Robot
        """
        if isinstance(robot, Robot):
            if robot.is_mechanism:
                return cls.of_mechanism(model)
            if robot.model is model and robot._version == model.version and srdf in (None, robot._srdf):
                return robot
            name, srdf = robot.name, srdf or robot._srdf
        elif isinstance(robot, str):
            name = robot
        else:
            raise InvalidValueError(f"A robot is named by the prefix of its names, not by {robot!r:.60}.")
        if srdf is not None:
            return _make(model, name, srdf)
        return cached_for_version(model, ("robot", name), lambda: _make(model, name, None))

    @classmethod
    def of_mechanism(cls, model: ModelView) -> Robot:
        """Return a model without a robot as one that has no frames, and whose coordinates are all driven."""
        return cached_for_version(model, ("robot", None), lambda: cls(model, "", ()))

    def __repr__(self) -> str:
        return f"<Robot '{self.name}' with {len(self.coordinates)} degrees of freedom>"

    @property
    def is_mechanism(self) -> bool:
        """True for a mechanism without a robot, whose coordinates are driven."""
        return not self.frames

    def owns(self, frame: str) -> bool:
        """Return whether a frame is one of the robot's."""
        return frame in self._owned

    def moves(self, symbol: Symbol) -> bool:
        """Return whether a coordinate, or a derivative of one, is the robot's; the model need not have it."""
        return is_of_robot(symbol.path, self.name)

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Frames of the robot with a body."""
        bodies = self.model.bodies
        return tuple(name for name in self.frames if name in bodies and not is_empty_body(bodies[name]))

    @cached_property
    def base(self) -> MobileBase | None:
        """The joint that places the robot in the world; None if it stands still."""
        for record in self.model.articulations.values():
            outside = record.parent == WORLD or not self.owns(record.parent)
            if record.coordinates and outside and self.owns(record.child):
                pose = self.model.fk(record.child, relative_to=record.parent)
                # Not the steering of a car.
                placing = tuple(s for s in record.coordinates if s in pose.symbols)
                return MobileBase(placing, record.parent, record.child, _is_planar(pose, placing))
        return None

    @property
    def planar_base(self) -> tuple[Symbol, ...]:
        """The coordinates x [m], y [m] and heading [rad] of the mobile base; empty without such a base."""
        return self.base.coordinates if self.base is not None and self.base.is_planar else ()

    @cached_property
    def grippers(self) -> tuple[Gripper, ...]:
        """The grippers, the likeliest for manipulation first."""
        return () if self.is_mechanism else find_grippers(self.model, self.name, self._srdf)

    def gripper(self, hand: str | None = None) -> Gripper:
        """Return the likeliest gripper, or the one of a hand.

        Parameters
        ----------
        hand
            Frame of the hand, or one of its fingers.

        Raises
        ------
        UnknownNameError
            If the robot has no gripper, or none at this frame; the message lists the grippers.
        """
        return find_gripper(self.model, self.name, hand, self._srdf)

    @cached_property
    def camera(self) -> str | None:
        """The frame that is named like a head that tilts, a camera or a head; None without any."""
        for words in _CAMERA_WORDS:
            for name in self.frames:
                last = name.rpartition("/")[2].lower()
                if all(word in last for word in words) and "optical" not in last:
                    return name
        return None

    @cached_property
    def markers(self) -> tuple[str, ...]:
        """The frames around the robot whose poses its camera is to observe, in the order of the model.

        These are the bodies of articulated objects, and the bodies that carry them.
        """
        model = self.model
        objects = [s for s in model.degrees_of_freedom if not self.moves(s)]
        motion = FrameDependence(model, objects)
        bodies = {name for name, body in model.bodies.items() if not is_empty_body(body)}
        result = {name for name in bodies if motion.moves(name)}
        for name, frame in model.frames.items():
            if motion.moves_between(name, carrier := frame.parent):
                while carrier != WORLD and carrier not in bodies:
                    carrier = model.frames[carrier].parent
                result.add(carrier)
        return tuple(name for name in model.frames if name in result and not self.owns(name))


def _make(model: ModelView, name: str, srdf: Srdf | None) -> Robot:
    robot = Robot(model, name, [frame for frame in model.frames if is_of_robot(frame, name)], srdf=srdf)
    if robot.is_mechanism or not robot.coordinates:
        prefixes = sorted({s.path.partition("/")[0] for s in model.degrees_of_freedom if "/" in s.path})
        raise UnknownNameError(
            f"The model has no robot '{name}': nothing that moves is below this prefix. "
            f"{suggest(name, prefixes, 'prefix')}"
        )
    return robot


def _is_planar(pose: Expression, coordinates: tuple[Symbol, ...]) -> bool:
    """Return whether a pose is translation(x, y, 0) · rotation_z(θ) of three coordinates, after an offset."""
    if len(coordinates) != 3 or not set(pose.symbols) <= set(coordinates):
        return False
    x, y, angle = values = np.array([0.3, -0.7, 1.1])
    function = compile([pose], coordinates, tier="interpreter")
    (offset,), (placed,) = function(np.zeros(3)), function(values)
    wanted = transform(rotation_z(angle), np.array([x, y, 0.0]))
    return bool(np.allclose(placed, offset @ wanted, atol=1e-9))
