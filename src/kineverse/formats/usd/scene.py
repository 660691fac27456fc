"""Bodies and joints of a USD stage, as OpenUSD's own parser of UsdPhysics reads them.

All lengths are in metres, angles in radians, masses in kilograms, and z is up in the world, whatever the
units and the axes of the stage. The scale of a body is part of the points in it: its frame has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.description import Matrix
from kineverse.formats.mimic import MimicRelation
from kineverse.formats.names import UniqueNames
from kineverse.formats.xml_reader import quote
from kineverse.lie import transform

from .pxr_api import (
    COEFFICIENTS,
    COORDINATE,
    DEPENDENT,
    FREE,
    HOME,
    LARGEST_FLOAT,
    LEADER,
    LOOP,
    MASSLESS,
    NAME,
    ROTATIONS,
    TRANSLATIONS,
    capture_diagnostics,
    number_of,
    numbers_of,
    pose_from_gf,
    pxr,
    refuse_errors,
    text_of,
)

IN_WORLD = ""  # path in place of a body's for what is fixed to the world
BALL = "ball"  # degree of freedom of all three turns together


@dataclass(frozen=True)
class UsdUnits:
    """Units of a stage: length [m], mass [kg], and the rotation of its axes in a world with z up."""

    length: float
    mass: float
    rotation: Matrix


@dataclass(frozen=True)
class UsdFreedom:
    """Degree of freedom of a joint: its coordinate, axis, bounds [rad] or [m], and dynamics."""

    kind: str  # transX … rotZ, or BALL
    name: str
    lower: float = -math.inf
    upper: float = math.inf
    dynamics: tuple[tuple[str, float], ...] = ()

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Return the names of its coordinates: one, or the quaternion of a ball."""
        return tuple(f"{self.name}/q{c}" for c in "xyzw") if self.kind == BALL else (self.name,)


@dataclass(frozen=True)
class UsdJoint:
    """Joint between two bodies, by their paths.

    ``pose0`` and ``pose1`` are the poses of its frame in both bodies. With a mimic, its coordinate is an
    affine function of the leader's, which is named by path. ``velocity`` bounds the speed [rad/s], [m/s].
    ``loop`` is the name of the loop that it closes, and ``dependent`` the coordinates that depend on it,
    where they are stated.
    """

    path: str
    name: str  # that of its coordinate; no coordinate's if it is generic
    body0: str
    body1: str
    pose0: Matrix
    pose1: Matrix
    freedoms: tuple[UsdFreedom, ...] = ()
    is_excluded: bool = False  # True if it closes a loop of its articulation
    mimic: MimicRelation[str] | None = None
    velocity: float = math.inf
    loop: str = ""
    dependent: tuple[str, ...] | None = None


@dataclass(frozen=True)
class UsdBody:
    """Rigid body; ``pose`` is that in the world, on the stage."""

    path: str
    name: str
    pose: Matrix
    is_kinematic: bool = False
    is_massless: bool = False
    free: str = ""  # name of its free motion, where that is stated
    home: tuple[float, ...] = ()  # coordinates of that motion at the pose; empty for none


@dataclass(frozen=True)
class UsdFrame:
    """Transform below a body, or in the world, that has a name in the model."""

    path: str
    name: str
    body: str
    pose: Matrix


@dataclass(frozen=True)
class UsdScene:
    """Rigid bodies, joints and named frames of a stage."""

    stage: Any
    units: UsdUnits
    bodies: dict[str, UsdBody]  # by path
    joints: tuple[UsdJoint, ...]
    frames: tuple[UsdFrame, ...]
    remarks: tuple[str, ...]


def read_scene(stage: Any, source: str) -> UsdScene:
    """Return the bodies and joints of a stage; errors name the source and the prim."""
    api = pxr()
    units = _read_units(stage, source)
    with capture_diagnostics(), refuse_errors(source):
        # Older versions have the second name alone.
        parse = (
            getattr(api.UsdPhysics, "UsdPhysicsLoadStageFromPrimRange", None)
            or api.UsdPhysics.LoadUsdPhysicsFromRange
        )
        parsed = {
            str(kind).rpartition(".")[2]: list(descs) for kind, (_, descs) in parse(stage, ["/"]).items()
        }
        return _SceneReader(stage, source, units).read(parsed)


def _read_units(stage: Any, source: str) -> UsdUnits:
    api = pxr()
    length = float(api.UsdGeom.GetStageMetersPerUnit(stage))
    mass = float(api.UsdPhysics.GetStageKilogramsPerUnit(stage))
    if not (0 < length < math.inf and 0 < mass < math.inf):
        raise FormatError(f"{source}: its units are {length:g} m and {mass:g} kg, which measure nothing.")
    rotation = np.eye(3)
    if api.UsdGeom.GetStageUpAxis(stage) == api.UsdGeom.Tokens.y:
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return UsdUnits(length, mass, rotation)


def _rigid_pose(units: UsdUnits, matrix: Any) -> Matrix:
    rows = np.array(matrix).T  # Gf multiplies row vectors
    linear = rows[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() > 1e-12:
        linear = np.array(matrix.RemoveScaleShear()).T[:3, :3]
    if np.linalg.det(linear) < 0:  # a mirror image is part of the points
        linear = -linear
    result: Matrix = transform(units.rotation @ linear, units.rotation @ rows[:3, 3] * units.length)
    return result


def find_body_above(prim: Any, bodies: Container[str]) -> str:
    """Return the path of the body that a prim is or is below; that of the world without one."""
    while prim and not prim.IsPseudoRoot():
        if str(prim.GetPath()) in bodies:
            return str(prim.GetPath())
        prim = prim.GetParent()
    return IN_WORLD


class _SceneReader:
    """Reader of what the parser of UsdPhysics found in one stage."""

    def __init__(self, stage: Any, source: str, units: UsdUnits) -> None:
        self._stage, self._source, self._units = stage, source, units
        self._remarks: list[str] = []
        self._xforms = pxr().UsdGeom.XformCache()
        self._body_names = UniqueNames(self._rename, "world")
        self._joint_names = UniqueNames(self._rename)

    def read(self, parsed: dict[str, list[Any]]) -> UsdScene:
        """Return the scene of the descriptors, by the names of their types."""
        bodies = {str(d.primPath): self._body(d) for d in parsed.get("RigidBody", ()) if d.rigidBodyEnabled}
        joints: list[UsdJoint] = []
        readers: dict[str, Callable[[Any, str], Iterable[UsdFreedom]]] = {
            "FixedJoint": lambda found, name: (),
            "RevoluteJoint": self._one_freedom,
            "PrismaticJoint": self._one_freedom,
            "SphericalJoint": self._ball,
            "D6Joint": self._generic,
        }
        for kind, read in readers.items():
            made = (self._joint(d, read, bodies) for d in parsed.get(kind, ()))
            joints += [joint for joint in made if joint is not None]
        for kind in ("DistanceJoint", "CustomJoint"):
            for d in parsed.get(kind, ()):
                self._say(
                    d.primPath,
                    f"is left out: a {kind.removesuffix('Joint').lower()} joint is none that is read",
                )
        by_path = {joint.path: joint for joint in joints}
        every = self._stage.Traverse(pxr().Usd.TraverseInstanceProxies())
        order = {str(prim.GetPath()): k for k, prim in enumerate(every)}
        joints = [
            self._checked_mimic(joint, by_path) for joint in sorted(joints, key=lambda j: order[j.path])
        ]
        frames = tuple(self._frames(bodies))
        return UsdScene(self._stage, self._units, bodies, tuple(joints), frames, tuple(self._remarks))

    def _body(self, found: Any) -> UsdBody:
        prim = self._stage.GetPrimAtPath(found.primPath)
        path = str(found.primPath)
        name = self._body_names.take(text_of(prim, NAME) or prim.GetName(), path)
        pose = _rigid_pose(self._units, self._xforms.GetLocalToWorldTransform(prim))
        massless = prim.GetAttribute(MASSLESS)
        return UsdBody(
            path,
            name,
            pose,
            found.kinematicBody,
            bool(massless and massless.Get()),
            text_of(prim, FREE) or "",
            numbers_of(prim, HOME, 7),
        )

    def _frames(self, bodies: dict[str, UsdBody]) -> Iterator[UsdFrame]:
        for prim in self._stage.Traverse(pxr().Usd.TraverseInstanceProxies()):
            path = str(prim.GetPath())
            name = text_of(prim, NAME)
            if name is None or path in bodies or prim.GetTypeName() != "Xform":
                continue
            body = find_body_above(prim, bodies)
            world = _rigid_pose(self._units, self._xforms.GetLocalToWorldTransform(prim))
            above = bodies[body].pose if body else np.eye(4)
            yield UsdFrame(path, self._body_names.take(name, path), body, np.linalg.inv(above) @ world)

    # -- joints ----------------------------------------------------------------------------------------------

    def _joint(
        self, found: Any, read: Callable[[Any, str], Iterable[UsdFreedom]], bodies: dict[str, UsdBody]
    ) -> UsdJoint | None:
        prim = self._stage.GetPrimAtPath(found.primPath)
        for relation in ("physics:body0", "physics:body1"):
            for target in prim.GetRelationship(relation).GetTargets():
                if not self._stage.GetPrimAtPath(target):  # OpenUSD takes it for the world
                    self._refuse(prim, f"connects {quote(str(target))}, which is not on the stage.")
        if not found.jointEnabled:
            self._say(found.primPath, "is left out: it is not enabled")
            return None
        body0, body1 = (path if path in bodies else IN_WORLD for path in map(str, (found.body0, found.body1)))
        if body0 == body1:
            self._say(found.primPath, "is left out: it connects no two bodies")
            return None
        name = text_of(prim, NAME) or prim.GetName()
        freedoms = tuple(read(found, name))
        if not (freedoms and isinstance(found, pxr().UsdPhysics.D6JointDesc)):
            name = self._joint_names.take(name, str(found.primPath))
            freedoms = tuple(replace(one, name=name) for one in freedoms)
        is_single = len(freedoms) == 1 and freedoms[0].kind != BALL
        unit = self._unit(freedoms[0].kind) if is_single else 1.0
        speed = number_of(prim, "newton:velocityLimit") if is_single else None
        dependent = prim.GetAttribute(DEPENDENT).Get() if prim.HasAttribute(DEPENDENT) else None
        return UsdJoint(
            str(found.primPath),
            name,
            body0,
            body1,
            self._local_pose(prim, body0, found.localPose0Position, found.localPose0Orientation),
            self._local_pose(prim, body1, found.localPose1Position, found.localPose1Orientation),
            freedoms,
            found.excludeFromArticulation,
            self._mimic(prim, unit),
            speed * unit if speed is not None and 0 < speed < LARGEST_FLOAT else math.inf,
            (text_of(prim, LOOP) or "") if found.excludeFromArticulation else "",
            None if dependent is None else tuple(map(str, dependent)),
        )

    def _unit(self, kind: str) -> float:
        """Return the unit of a degree of freedom: a degree [rad], or the length of the stage [m]."""
        return math.radians(1.0) if kind in ROTATIONS else self._units.length

    def _local_pose(self, prim: Any, body: str, position: Any, orientation: Any) -> Matrix:
        pose = pose_from_gf(position, orientation)
        pose[:3, 3] *= self._units.length
        if not np.isfinite(pose).all():
            self._refuse(prim, "is at a place that is not finite.")
        if not body:
            pose = transform(self._units.rotation, np.zeros(3)) @ pose
        return pose

    def _one_freedom(self, found: Any, name: str) -> Iterator[UsdFreedom]:
        prim = self._stage.GetPrimAtPath(found.primPath)
        kinds = ROTATIONS if isinstance(found, pxr().UsdPhysics.RevoluteJointDesc) else TRANSLATIONS
        kind = kinds["XYZ".index(str(found.axis).rpartition(".")[2])]
        lower, upper = self._bounds(kind, found.limit.lower, found.limit.upper)
        if lower > upper:
            self._say(found.primPath, "is not limited: its lower limit is above the upper one")
            lower, upper = -math.inf, math.inf
        dynamics = dict(self._pull(found.primPath, kind, found.drive))
        for key, value in self._passive(prim, kind):
            dynamics[key] = dynamics.get(key, 0.0) + value
        yield UsdFreedom(kind, name, lower, upper, tuple(dynamics.items()))

    def _ball(self, found: Any, name: str) -> Iterator[UsdFreedom]:
        prim = self._stage.GetPrimAtPath(found.primPath)
        if any((number_of(prim, f"physics:coneAngle{k}Limit") or 0.0) >= 0.0 for k in (0, 1)):
            self._say(found.primPath, "has a cone as its limit, which is left out")
        yield UsdFreedom(BALL, name)

    def _generic(self, found: Any, own: str) -> Iterator[UsdFreedom]:
        prim = self._stage.GetPrimAtPath(found.primPath)
        limits = {_freedom_name(pair.first): pair.second for pair in found.jointLimits}
        drives = {_freedom_name(pair.first): pair.second for pair in found.jointDrives}
        if "distance" in limits:
            self._say(found.primPath, "limits a distance, which is left out")
        free: list[UsdFreedom] = []
        for kind in (*TRANSLATIONS, *ROTATIONS):
            limit = limits.get(kind)
            lower, upper = (
                (-math.inf, math.inf) if limit is None else self._bounds(kind, limit.lower, limit.upper)
            )
            if lower > upper:
                continue
            wish = text_of(prim, COORDINATE.format(kind)) or f"{own}/{kind}"
            name = self._joint_names.take(wish, f"{found.primPath} {kind}")
            free.append(
                UsdFreedom(kind, name, lower, upper, self._pull(found.primPath, kind, drives.get(kind)))
            )
        turns = [one for one in free if one.kind in ROTATIONS]
        if len(turns) == 2:
            self._refuse(
                prim, "turns about two axes, in an order that UsdPhysics does not state. Write two joints."
            )
        if len(turns) == 3:
            if any(one != UsdFreedom(one.kind, one.name) for one in turns):
                self._say(found.primPath, "limits or drives its three turns, which is left out")
            free = [*(one for one in free if one.kind in TRANSLATIONS), UsdFreedom(BALL, turns[0].name)]
        yield from free

    def _bounds(self, kind: str, lower: float, upper: float) -> tuple[float, float]:
        unit = self._unit(kind)
        low = lower * unit if abs(lower) < LARGEST_FLOAT else math.copysign(math.inf, lower)
        high = upper * unit if abs(upper) < LARGEST_FLOAT else math.copysign(math.inf, upper)
        return low, high

    def _pull(self, path: Any, kind: str, drive: Any) -> tuple[tuple[str, float], ...]:
        """Return the effort, the damping and the spring of a drive."""
        if drive is None or not drive.enabled:
            return ()
        if drive.acceleration:
            self._say(path, "is driven by accelerations, which is left out")
            return ()
        force, unit = self._force(kind), self._unit(kind)
        numbers = {
            "effort": drive.forceLimit * force if drive.forceLimit < LARGEST_FLOAT else 0.0,
            "damping": drive.damping * force / unit,
            "spring_stiffness": drive.stiffness * force / unit,
            "spring_reference": drive.targetPosition * unit if drive.stiffness else 0.0,
        }
        return tuple((key, value) for key, value in numbers.items() if value and math.isfinite(value))

    def _force(self, kind: str) -> float:
        """Return the unit of torque [N m] or of force [N]."""
        length, mass = self._units.length, self._units.mass
        return mass * length**2 if kind in ROTATIONS else mass * length

    def _passive(self, prim: Any, kind: str) -> tuple[tuple[str, float], ...]:
        """Return friction, armature and damping of Newton's schema."""
        force, unit = self._force(kind), self._unit(kind)
        inertia = force if kind in ROTATIONS else self._units.mass
        units = {"friction": force, "armature": inertia, "damping": force / unit}
        numbers = {key: number_of(prim, f"newton:{key}") for key in units}
        return tuple((key, value * units[key]) for key, value in numbers.items() if value)

    def _mimic(self, prim: Any, unit: float) -> MimicRelation[str] | None:
        own = prim.GetRelationship(LEADER)
        if own and own.GetTargets():
            offset, factor = numbers_of(prim, COEFFICIENTS, 2) or (0.0, 1.0)
            return MimicRelation(str(own.GetTargets()[0]), factor, offset)
        relation = prim.GetRelationship("newton:mimicJoint")
        leaders = relation.GetTargets() if relation else []
        enabled = prim.GetAttribute("newton:mimicEnabled")
        if not leaders or (enabled and enabled.Get() is False):
            return None
        given = number_of(prim, "newton:mimicCoef1")
        shift = (number_of(prim, "newton:mimicCoef0") or 0.0) * unit
        return MimicRelation(str(leaders[0]), 1.0 if given is None else given, shift)

    def _checked_mimic(self, joint: UsdJoint, by_path: dict[str, UsdJoint]) -> UsdJoint:
        if joint.mimic is None:
            return joint
        prim = self._stage.GetPrimAtPath(joint.path)
        leader = by_path.get(joint.mimic.leader)
        if leader is None:
            self._refuse(prim, f"follows {quote(joint.mimic.leader)}, which is no joint that is read.")
        kinds = [tuple(freedom.kind[:3] for freedom in each.freedoms) for each in (joint, leader)]
        is_mixed = bool(prim.GetRelationship(LEADER))
        single = [("rot",), ("tra",)]
        if not (kinds[0] in single and kinds[1] in single and (kinds[0] == kinds[1] or is_mixed)):
            self._refuse(
                prim, f"follows {quote(leader.name)}, which is no joint of its type with one coordinate."
            )
        return joint

    def _refuse(self, prim: Any, reason: str) -> NoReturn:
        raise FormatError(f"{self._source}: {prim.GetPath()} {reason}")

    def _say(self, path: Any, text: str) -> None:
        self._remarks.append(f"{self._source}: {path} {text}.")

    def _rename(self, where: str, problem: str, replacement: str) -> None:
        self._remarks.append(f"{self._source}: {where}: {problem}; {replacement}.")


def _freedom_name(freedom: Any) -> str:
    """Return the name of a degree of freedom in the schema: ``transX`` for ``TransX``."""
    name = str(freedom).rpartition(".")[2]
    return name[0].lower() + name[1:]
