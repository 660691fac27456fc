"""A description in the making: links on joints, written as plain URDF in [m], [rad] and [kg].

Only Python's own floats are used and rounded, so that the same text comes out everywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import pi

from mass import mass_properties
from shapes import ZERO, Material, Shape, Span, Vector


@dataclass(frozen=True)
class Joint:
    """How a link hangs on its parent; `limits` is (lower, upper), None for continuous and fixed joints."""

    name: str
    kind: str
    parent: str
    at: Vector
    rpy: Vector = ZERO
    axis: Vector | None = None
    limits: Span | None = None
    velocity: float = 0.0
    effort: float = 0.0
    mimic: tuple[str, float, float] | None = None
    friction: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True)
class Link:
    """A rigid part; without shapes it is a frame only."""

    name: str
    shapes: tuple[Shape, ...]
    joint: Joint | None
    section: str | None


@dataclass
class Description:
    """A tree of links below one root, which is a frame only."""

    name: str
    about: str
    materials: Mapping[str, Material]
    root: str
    links: list[Link] = field(default_factory=list)
    _section: str | None = None

    def __post_init__(self) -> None:
        self.links.append(Link(self.root, (), None, None))

    def section(self, title: str) -> None:
        """Write `title` as a comment above the next link."""
        self._section = title

    def fixed(
        self,
        link: str,
        parent: str,
        shapes: Iterable[Shape] = (),
        at: Vector = ZERO,
        rpy: Vector = ZERO,
        joint: str | None = None,
    ) -> None:
        """Add a link that does not move against its parent."""
        self._add(link, shapes, Joint(joint or f"{link}_joint", "fixed", parent, at, rpy))

    def moving(
        self,
        link: str,
        parent: str,
        kind: str,
        axis: Vector,
        shapes: Iterable[Shape],
        *,
        limits: Span | None = None,
        velocity: float,
        effort: float,
        at: Vector = ZERO,
        rpy: Vector = ZERO,
        joint: str | None = None,
        mimic: tuple[str, float, float] | None = None,
        friction: float = 0.0,
        damping: float = 0.0,
    ) -> None:
        """Add a link that slides or turns about `axis`; the joint takes the link's name if it has none."""
        name, motion = joint or link, (axis, limits, velocity, effort, mimic, friction, damping)
        self._add(link, shapes, Joint(name, kind, parent, at, rpy, *motion))

    def _add(self, name: str, shapes: Iterable[Shape], joint: Joint) -> None:
        shapes = tuple(shapes)
        if joint.parent not in {link.name for link in self.links}:
            raise ValueError(f"{name}: no parent {joint.parent} yet")
        if name in {link.name for link in self.links}:
            raise ValueError(f"{name} exists")
        for shape in shapes:
            if shape.material not in self.materials:
                raise ValueError(f"{name}: no material {shape.material}")
        self.links.append(Link(name, shapes, joint, self._section))
        self._section = None

    def xml(self) -> str:
        """Return the description as the text of a URDF file."""
        lines = ['<?xml version="1.0"?>', "<!--", *(f"  {row}".rstrip() for row in self.about.splitlines())]
        lines += ["-->", f'<robot name="{self.name}">']
        used = {shape.material for link in self.links for shape in link.shapes if shape.seen}
        for name, material in self.materials.items():
            if name in used:
                lines.append(
                    f'  <material name="{name}"><color rgba="{_numbers(material.rgba)}"/></material>'
                )
        for link in self.links:
            lines.append("")
            if link.section:
                lines += [f"  <!-- {link.section} -->"]
            if link.joint:
                lines += _joint_lines(link.name, link.joint)
            lines += _link_lines(link, self.materials)
        return "\n".join([*lines, "</robot>", ""])


def _link_lines(link: Link, materials: Mapping[str, Material]) -> list[str]:
    if not link.shapes:
        return [f'  <link name="{link.name}"/>']
    mass, centre, inertia = mass_properties(link.shapes, materials)
    smallest = 1e-9 * sum(inertia[i][i] for i in range(3))
    entries = " ".join(
        f'i{"xyz"[i]}{"xyz"[j]}="{_number(inertia[i][j] if abs(inertia[i][j]) > smallest else 0.0)}"'
        for i in range(3)
        for j in range(i, 3)
    )
    lines = [
        f'  <link name="{link.name}">',
        f'    <inertial><origin xyz="{_lengths(centre)}"/><mass value="{_number(mass)}"/>',
        f"      <inertia {entries}/></inertial>",
    ]
    lines += [
        f'    <visual>{_shape(shape)}<material name="{shape.material}"/></visual>'
        for shape in link.shapes
        if shape.seen
    ]
    lines += [f"    <collision>{_shape(shape)}</collision>" for shape in link.shapes if shape.collides]
    return [*lines, "  </link>"]


def _joint_lines(child: str, joint: Joint) -> list[str]:
    lines = [
        f'  <joint name="{joint.name}" type="{joint.kind}">',
        f'    <parent link="{joint.parent}"/>',
        f'    <child link="{child}"/>',
    ]
    if any(joint.at) or any(joint.rpy):
        lines.append(f"    {_origin(joint.at, joint.rpy)}")
    if joint.axis:
        lines.append(f'    <axis xyz="{_lengths(joint.axis)}"/>')
        span = ""
        if joint.limits:
            span = f'lower="{_number(joint.limits[0])}" upper="{_number(joint.limits[1])}" '
        speed, effort = _number(joint.velocity), _number(joint.effort)
        lines.append(f'    <limit {span}velocity="{speed}" effort="{effort}"/>')
    if joint.friction or joint.damping:
        damping, friction = _number(joint.damping), _number(joint.friction)
        lines.append(f'    <dynamics damping="{damping}" friction="{friction}"/>')
    if joint.mimic:
        master, factor, offset = joint.mimic
        lines.append(
            f'    <mimic joint="{master}" multiplier="{_number(factor)}" offset="{_number(offset)}"/>'
        )
    return [*lines, "  </joint>"]


def _shape(shape: Shape) -> str:
    if shape.kind == "box":
        geometry = f'<box size="{_lengths(shape.size)}"/>'
    elif shape.kind == "cylinder":
        geometry = f'<cylinder radius="{_length(shape.size[0])}" length="{_length(shape.size[1])}"/>'
    else:
        geometry = f'<sphere radius="{_length(shape.size[0])}"/>'
    origin = _origin(shape.at, shape.rpy) if any(shape.at) or any(shape.rpy) else ""
    return f"{origin}<geometry>{geometry}</geometry>"


def _origin(at: Vector, rpy: Vector) -> str:
    turn = f' rpy="{_numbers(rpy)}"' if any(rpy) else ""
    return f'<origin xyz="{_lengths(at)}"{turn}/>'


def _length(value: float) -> str:
    """Return a length to the micrometre."""
    return _number(round(value, 6))


def _lengths(values: Iterable[float]) -> str:
    return " ".join(_length(v) for v in values)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(_number(v) for v in values)


def _number(value: float) -> str:
    """Return six significant digits, and angles that are parts of pi in full."""
    for part in (pi, pi / 2, pi / 4):
        if abs(abs(value) - part) < 1e-9:
            return repr(part if value > 0 else -part)
    return f"{value + 0.0:.6g}"
