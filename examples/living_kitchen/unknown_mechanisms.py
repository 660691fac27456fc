"""Mechanisms of unknown type: a base, a part that moves on it, and a hidden joint."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import kineverse as kv
from kineverse.articulations import Prismatic, Revolute, Screw
from kineverse.articulations.mechanisms.mechanism import (
    BLUE,
    DARK,
    STEEL,
    WOOD,
    YELLOW,
    box_shape,
    rod_shape,
)
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Pose, Rgba, Shape, Vector3
from kineverse.model.frame import WORLD
from kineverse.spatial import rotation_z, translation
from kineverse.view.rendering.triangle_mesh import Floats

BASE, PART, HIDDEN = "stranger/base", "stranger/part", "stranger/hidden"
"""The observed frames, and the name of the hidden joint."""

BASE_POSE = translation(-3.15, 0.95, 0.0) @ rotation_z(0.35)
"""Pose of the base: in front, facing the camera."""


@dataclass(frozen=True)
class UnknownMechanism:
    """Mechanism with a hidden joint between its base and its part.

    Attributes
    ----------
    name
        The name of the mechanism.
    family
        The family of its joint.
    joint
        The joint from the base to a frame on the axis, with its limits.
    mount
        The pose of the part in that frame.
    base, part
        Their shapes, in their frames.
    """

    name: str
    family: str
    joint: Revolute | Prismatic | Screw
    mount: Pose
    base: tuple[Shape, ...]
    part: tuple[Shape, ...]

    @cached_property
    def model(self) -> kv.Model:
        """The true model, in which the joint is called :data:`HIDDEN`."""
        model = kv.Model()
        with model.edit() as edit:
            edit.add_frame(BASE, parent=WORLD, transform=BASE_POSE)
            edit.apply(self.joint)
            edit.add_frame(PART, parent=self.joint.child, transform=self.mount.matrix)
            edit.apply(SetBody(BASE, Body(visuals=self.base)))
            edit.apply(SetBody(PART, Body(visuals=self.part)))
        return model

    @property
    def limits(self) -> tuple[float, float]:
        """The limits of the joint [m], [rad]."""
        return self.model.limits(HIDDEN)

    @cached_property
    def poses(self) -> Callable[[float], tuple[Floats, Floats]]:
        """The poses of base and part, as a function of the position of the joint."""
        function = kv.compile([self.model.fk(BASE), self.model.fk(PART)])

        def at(value: float) -> tuple[Floats, Floats]:
            base, part = function(np.array([value]))
            return base, part

        return at

    @property
    def axis(self) -> tuple[Floats, Floats]:
        """A point on the true axis [m], and its direction, in the base."""
        direction = np.array(self.joint.axis)
        assert isinstance(self.joint.origin, Pose)  # of all mechanisms below
        frame = self.joint.origin.matrix
        return frame[:3, 3], frame[:3, :3] @ direction / np.linalg.norm(direction)


def chest() -> UnknownMechanism:
    """Return a chest with a lid that is hinged at the back."""
    width, depth, height, wall = 0.9, 0.5, 0.42, 0.03
    sides = _walls((depth, width, height), wall, WOOD)
    lid = (
        box_shape((depth + 0.04, width + 0.04, 0.05), (0.0, 0.0, 0.0), BLUE),
        box_shape((0.03, 0.16, 0.03), (-depth / 2 - 0.035, 0.0, 0.0), STEEL),
    )
    hinge = Revolute(**_between((depth / 2 + 0.02, 0.0, height)), axis=(0.0, 1.0, 0.0), lower=0.0, upper=1.35)
    return UnknownMechanism("chest", "revolute", hinge, _at(-depth / 2 - 0.02, 0.0, 0.025), sides, lid)


def crate() -> UnknownMechanism:
    """Return a crate in a rack, which slides out and a little upwards."""
    width, depth, height = 0.6, 0.55, 0.5
    rack = (
        *_walls((depth, width, height), 0.03, STEEL),
        box_shape((depth, width, 0.03), (0, 0, height), STEEL),
    )
    front = (
        box_shape((depth - 0.08, width - 0.1, 0.3), (0.0, 0.0, 0.0), YELLOW),
        box_shape((0.04, width + 0.02, 0.36), (-depth / 2 - 0.0, 0.0, 0.0), WOOD),
        box_shape((0.03, 0.2, 0.03), (-depth / 2 - 0.04, 0.0, 0.08), DARK),
    )
    slide = Prismatic(**_between((-0.05, 0.0, 0.28)), axis=(-0.96, 0.0, 0.28), lower=0.0, upper=0.5)
    return UnknownMechanism("crate", "prismatic", slide, _at(0.0, 0.0, 0.0), rack[1:], front)


def stool() -> UnknownMechanism:
    """Return a stool whose seat rises as it turns."""
    base = (
        rod_shape((0.0, 0.0, 0.0), (0.0, 0.0, 0.05), 0.26, DARK),
        rod_shape((0.0, 0.0, 0.05), (0.0, 0.0, 0.42), 0.035, STEEL),
    )
    seat = (
        rod_shape((0.0, 0.0, -0.03), (0.0, 0.0, 0.03), 0.24, WOOD),
        rod_shape((0.0, 0.0, -0.3), (0.0, 0.0, -0.03), 0.025, STEEL),
        box_shape((0.1, 0.08, 0.05), (-0.24, 0.0, 0.0), BLUE),
    )
    thread = Screw(
        **_between((0.0, 0.0, 0.46)), axis=(0.0, 0.0, 1.0), lower=0.0, upper=2.4, pitch=0.24 * math.tau / 2.4
    )
    return UnknownMechanism("stool", "screw", thread, _at(0.0, 0.0, 0.0), base, seat)


MECHANISMS: dict[str, Callable[[], UnknownMechanism]] = {"chest": chest, "crate": crate, "stool": stool}
"""Constructors of the mechanisms, by name."""


def _between(point: Vector3) -> dict[str, Any]:
    return {"name": HIDDEN, "parent": BASE, "child": HIDDEN, "origin": _at(*point)}


def _at(x: float, y: float, z: float) -> Pose:
    return Pose.from_matrix(translation(x, y, z))


def _walls(size: Vector3, wall: float, color: Rgba) -> tuple[Shape, ...]:
    """Return front, back, sides and bottom of an open box on the floor; its front is towards -x."""
    depth, width, height = size
    return (
        *(box_shape((wall, width, height), (x, 0.0, height / 2), color) for x in (-depth / 2, depth / 2)),
        *(box_shape((depth, wall, height), (0.0, y, height / 2), color) for y in (-width / 2, width / 2)),
        box_shape((depth, width, wall), (0.0, 0.0, wall / 2), color),
    )
