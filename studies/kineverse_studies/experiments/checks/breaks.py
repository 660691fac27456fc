"""Breaks of sound models: one joint, or a body that it moves, is made wrong in one named way.

Each break is wrong by construction, whatever a checker accepts:

- *degrees for radians*: a hinge of at least 20° gets as many radians, which are more than three turns.
- *mm for m*: a slider's limits are multiplied or divided by 1000.
- *axis outside*: the axis is moved clear of the sphere around all shapes, by half to twice the part's size.
- *moves nothing*: the joint gets an empty frame, and the part hangs on the carrier.
- *floats*: joint and part are moved out of the sphere around all other shapes, by more than the part's reach.
- *inertia*: one principal moment is larger than the sum of the others.
- *centre of mass*: it is moved out of the sphere around the body, by half to twice its size.
- *inside out*: a shape becomes a closed mesh whose triangles face inwards.
- *crossed limits*: a second limit begins above the end of the first.
- *hinge in the middle*: an axis beside the part is moved into its middle, so that half of it turns inwards.
- *axis flipped*, *axis turned* by 90°, *type swapped*, *scale* by 1000 or 1/1000.

A flipped or turned axis can leave a part that moves freely, such as a sliding door with room on both sides.
That is a different piece of furniture, and no check of geometry can know which was meant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_fields

from kineverse.articulations import Prismatic, Revolute
from kineverse.geometry.motion_checks.moving_parts import MovingPart, MovingParts
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.shapes import hull_faces, solid_from_geometry, solid_from_points
from kineverse.lie import Array, inverse, rotation_along_z, transform, translation, unit_vector
from kineverse.model.basic_operations import AddFrame, SetBody
from kineverse.model.body import Body, Box, Ellipsoid, Geometry, Inertia, Mesh, Pose, Shape, Sphere
from kineverse.model.frame import Frame
from kineverse.model.model import Model

LEAST_HINGE = math.radians(20.0)  # least range of a hinge whose degrees are taken for radians


@dataclass(frozen=True)
class SoundJoint:
    """Hinge or slider of a sound model whose part and carrier have shapes."""

    model: Model
    tag: str  # of its operation
    joint: Revolute | Prismatic
    part: MovingPart

    @property
    def coordinate(self) -> str:
        return str(self.part.coordinate)

    @property
    def span(self) -> float:
        lower, upper = self.part.limits
        return upper - lower

    @property
    def world_T_joint(self) -> Array:
        parent = self.joint.parent
        pose: Array = np.eye(4) if parent == "world" else self.model.fk(parent)(self.part.parts.default)
        return np.asarray(pose @ self.origin)

    @property
    def origin(self) -> Array:
        """Pose of the joint in its parent, (4, 4)."""
        assert isinstance(self.joint.origin, Pose)
        return self.joint.origin.matrix

    @property
    def axis(self) -> Array:
        """Direction in the frame of the joint."""
        return np.asarray(unit_vector(np.array(self.joint.axis, dtype=float)))

    @property
    def middle(self) -> Array:
        """Middle of the part in the frame of the joint."""
        return np.asarray((inverse(self.world_T_joint) @ np.append(self.part.shape.middle, 1.0))[:3])

    def all_points(self, bodies: list[str]) -> Array:
        return np.asarray(self.part.parts.shape_of(bodies).points)


def find_joints(model: Model) -> Iterator[SoundJoint]:
    """Yield the joints that can be broken; links of robots are left out."""
    parts = MovingParts(model)
    for tag in model.history.tags:
        joint = model.history.operation(tag)
        if not isinstance(joint, Revolute | Prismatic) or joint.position is not None:
            continue
        if not isinstance(joint.origin, Pose):
            continue
        for group in parts.groups:
            if group.joint == joint.name and len(group.coordinates) == 1 and not parts.is_robot_link(group):
                part = MovingPart(parts, group, group.coordinates[0])
                lower, upper = part.limits
                if part.solids and parts.solids(part.carrier) and lower < upper:
                    yield SoundJoint(model, tag, joint, part)


@dataclass(frozen=True)
class Break:
    name: str
    kinds: tuple[str, ...]  # kinds of findings that name it rightly
    is_certain: bool  # whether it can be known for certain
    applies: Callable[[SoundJoint], bool]
    make: Callable[[SoundJoint, np.random.Generator, Path], Model]


def _replaced(broken: SoundJoint, **changes: Any) -> Model:
    model = broken.model.copy()
    with model.edit() as edit:
        edit.replace(broken.tag, replace(broken.joint, **changes))
    return model


def _moved_axis(broken: SoundJoint, joint_T_new: Array, **changes: Any) -> Model:
    """Return the model with the axis at another pose in the frame of the joint, and the part where it was."""
    model, joint = broken.model.copy(), broken.joint
    between = f"{joint.child}/moved axis"
    origin = Pose.from_matrix(broken.origin @ joint_T_new)
    with model.edit() as edit:
        edit.replace(broken.tag, replace(joint, child=between, origin=origin, **changes))
        back = AddFrame(joint.child, Frame(between, (Pose.from_matrix(inverse(joint_T_new)),)))
        edit.insert(back, after=broken.tag)
    return model


def _changed_bodies(broken: SoundJoint, change: Callable[[Body], Body], names: list[str]) -> Model:
    model = broken.model.copy()
    with model.edit() as edit:
        for name in names:
            edit.apply(SetBody(name, change(model.bodies[name])), f"broken {name}", override=True)
    return model


def _has_range(broken: SoundJoint) -> bool:
    numbers = all(isinstance(end, float | int) for end in (broken.joint.lower, broken.joint.upper))
    return numbers and math.isfinite(broken.span)


def _is_hinge(broken: SoundJoint) -> bool:
    return isinstance(broken.joint, Revolute)


def _degrees(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    lower, upper = broken.part.limits
    return _replaced(broken, lower=math.degrees(lower), upper=math.degrees(upper))


def _millimetres(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    factor = float(rng.choice([1e3, 1e-3]))
    lower, upper = broken.part.limits
    return _replaced(broken, lower=factor * lower, upper=factor * upper)


def _across(rng: np.random.Generator, direction: Array) -> Array:
    """Return a random unit vector across a direction."""
    angle = rng.uniform(0.0, math.tau)
    return np.asarray(rotation_along_z(direction)[:, :2] @ [math.cos(angle), math.sin(angle)])


def _axis_outside(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    part = broken.part
    points = broken.all_points(list(part.parts.scene.bodies))
    radius = float(np.linalg.norm(points - part.shape.middle, axis=1).max())
    away = radius + part.size * rng.uniform(0.5, 2.0)
    return _moved_axis(broken, translation(broken.middle + away * _across(rng, broken.axis)))


def _moves_nothing(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    model, joint = broken.model.copy(), broken.joint
    with model.edit() as edit:
        edit.replace(broken.tag, replace(joint, child=f"{joint.child}/empty"))
        edit.insert(
            AddFrame(joint.child, Frame(joint.parent, (Pose.from_matrix(broken.origin),))), after=broken.tag
        )
    return model


def _floats(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    part = broken.part
    others = broken.all_points(part.parts.others(part.group))
    middle = (others.min(axis=0) + others.max(axis=0)) / 2
    own = broken.all_points([b for g in part.parts.groups.subtree(part.group) for b in part.parts.solids(g)])
    at = broken.world_T_joint[:3, 3]
    reach = float(np.linalg.norm(own - at, axis=1).max()) + (0.0 if _is_hinge(broken) else broken.span)
    radius = float(np.linalg.norm(others - middle, axis=1).max())
    target = middle + (radius + reach + part.size * rng.uniform(0.5, 2.0)) * unit_vector(rng.normal(size=3))
    parent = broken.world_T_joint @ inverse(broken.origin)
    shift = parent[:3, :3].T @ (target - at)
    return _replaced(broken, origin=Pose.from_matrix(translation(shift) @ broken.origin))


def _body_of(broken: SoundJoint, rng: np.random.Generator) -> str:
    return str(rng.choice(broken.part.solids))


def _mass(body: Body) -> float:
    return body.inertia.mass if body.inertia is not None and body.inertia.mass > 0.0 else 1.0


def _inertia(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    name = _body_of(broken, rng)
    square = broken.part.parts.body_shape(name).size ** 2

    def change(body: Body) -> Body:
        a, b = _mass(body) * square * rng.uniform(0.01, 0.1, 2)
        largest = (a + b) * rng.uniform(1.5, 5.0)
        moments = [float(x) for x in rng.permutation([a, b, largest])]
        origin = body.inertia.origin if body.inertia is not None else Pose()
        tensor = (moments[0], 0.0, 0.0, moments[1], 0.0, moments[2])
        return replace_fields(body, inertia=Inertia(_mass(body), tensor, origin))

    return _changed_bodies(broken, change, [name])


def _center_of_mass(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    name = _body_of(broken, rng)
    parts = broken.part.parts
    points = (parts.whole_shape(name) or parts.body_shape(name)).points
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    size = float(np.ptp(points, axis=0).max())
    away = float(np.linalg.norm(points - middle, axis=1).max()) + size * rng.uniform(0.5, 2.0)
    place = Pose.from_matrix(translation(middle + away * unit_vector(rng.normal(size=3))))

    def change(body: Body) -> Body:
        moment = _mass(body) * size**2 / 12
        tensor = (moment, 0.0, 0.0, moment, 0.0, moment)
        return replace_fields(body, inertia=Inertia(_mass(body), tensor, place))

    return _changed_bodies(broken, change, [name])


def _inside_out(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    name = _body_of(broken, rng)

    def change(body: Body) -> Body:
        shapes = list(collision_shapes(body))
        k = int(rng.integers(len(shapes)))
        solid = solid_from_geometry(shapes[k].geometry)
        if solid.core is None or not solid.core.corners.size:
            corners = solid.half * np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
            solid = solid_from_points(corners + solid.centre)
        faces = hull_faces(solid.engine)
        path = folder / f"{rng.integers(2**62)}.obj"
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in faces.vertices.tolist()]
        lines += [f"f {c + 1} {b + 1} {a + 1}" for a, b, c in faces.faces.tolist()]
        path.write_text("\n".join(lines), encoding="utf-8")
        shapes[k] = replace_fields(shapes[k], geometry=Mesh(str(path)))
        return replace_fields(body, collisions=tuple(shapes))

    return _changed_bodies(broken, change, [name])


def _crossed(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    model = broken.model.copy()
    begin = broken.part.limits[1] + broken.span * rng.uniform(0.1, 1.0)
    with model.edit() as edit:
        edit.constrain(f"{broken.joint.name}/second", begin, broken.part.coordinate, begin + broken.span)
    return model


def _beside(broken: SoundJoint) -> float:
    """Return the distance of the axis from the middle of the part, in its size."""
    return float(np.linalg.norm(np.cross(broken.axis, broken.middle))) / broken.part.size


def _hinge_in_the_middle(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    return _moved_axis(broken, translation(broken.middle))


def _flipped(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    return _replaced(broken, axis=tuple((-broken.axis).tolist()))


def _is_one_sided(broken: SoundJoint) -> bool:
    lower, upper = broken.part.limits
    home = broken.part.home
    return _has_range(broken) and min(home - lower, upper - home) < 0.1 * broken.span


def _swapped(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    joint = broken.joint
    kind = Prismatic if isinstance(joint, Revolute) else Revolute
    names = ("name", "parent", "child", "origin", "axis", "lower", "upper", "velocity")
    model = broken.model.copy()
    with model.edit() as edit:
        edit.replace(broken.tag, kind(**{name: getattr(joint, name) for name in names}))
    return model


def _scaled(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    factor = float(rng.choice([1e3, 1e-3]))

    def scale(shape: Shape) -> Shape:
        pose = shape.origin.matrix
        origin = Pose.from_matrix(transform(pose[:3, :3], factor * pose[:3, 3]))
        return replace_fields(shape, geometry=scale_geometry(shape.geometry, factor), origin=origin)

    def change(body: Body) -> Body:
        visuals, collisions = (tuple(map(scale, some)) for some in (body.visuals, body.collisions))
        return replace_fields(body, visuals=visuals, collisions=collisions)

    return _changed_bodies(broken, change, broken.part.solids)


def scale_geometry(geometry: Geometry, factor: float) -> Geometry:
    """Return a geometry with all its lengths multiplied by a factor."""
    if isinstance(geometry, Mesh):
        x, y, z = geometry.scale
        return replace_fields(geometry, scale=(factor * x, factor * y, factor * z))
    if isinstance(geometry, Box):
        x, y, z = geometry.size
        return Box((factor * x, factor * y, factor * z))
    if isinstance(geometry, Ellipsoid):
        x, y, z = geometry.radii
        return Ellipsoid((factor * x, factor * y, factor * z))
    if isinstance(geometry, Sphere):
        return Sphere(factor * geometry.radius)
    return type(geometry)(factor * geometry.radius, factor * geometry.length)


def _turned(broken: SoundJoint, rng: np.random.Generator, folder: Path) -> Model:
    across = rotation_along_z(broken.axis)[:, int(rng.integers(2))] * float(rng.choice([-1.0, 1.0]))
    return _replaced(broken, axis=tuple(across.tolist()))


def _always(broken: SoundJoint) -> bool:
    return True


BREAKS = (
    Break(
        "degrees for radians",
        ("degrees_for_radians",),
        True,
        lambda one: _is_hinge(one) and _has_range(one) and one.span >= LEAST_HINGE,
        _degrees,
    ),
    Break(
        "mm for m",
        ("millimetres_for_metres",),
        True,
        lambda one: not _is_hinge(one) and _has_range(one),
        _millimetres,
    ),
    Break("axis outside", ("axis_outside",), True, _is_hinge, _axis_outside),
    Break("moves nothing", ("moves_nothing",), True, _always, _moves_nothing),
    Break("floats", ("floats",), True, _has_range, _floats),
    Break("inertia", ("impossible_inertia",), True, _always, _inertia),
    Break("centre of mass", ("center_of_mass_outside",), True, _always, _center_of_mass),
    Break("inside out", ("inside_out",), True, _always, _inside_out),
    Break("crossed limits", ("crossed_limits",), True, _has_range, _crossed),
    Break(
        "hinge in the middle",
        ("into_carrier", "no_limits", "flipped_axis", "turned_axis"),
        False,
        lambda one: _is_hinge(one) and _beside(one) > 0.25,
        _hinge_in_the_middle,
    ),
    Break("axis flipped", ("flipped_axis",), False, _is_one_sided, _flipped),
    Break(
        "type swapped",
        ("comes_apart", "into_carrier", "flipped_axis", "turned_axis"),
        False,
        _has_range,
        _swapped,
    ),
    Break("scale", ("wrong_scale",), False, _always, _scaled),
    Break("axis turned", ("turned_axis", "into_carrier"), False, _has_range, _turned),
)
"""All breaks, those first that can be known for certain."""
