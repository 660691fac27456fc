"""Replacement of a joint by an identified one.

Frames keep their names, and so does the coordinate if the joint has one before and after. The coordinate
keeps its direction and its zero as far as possible: joint values are aligned with those of the served joint.
A joint that follows another coordinate, as a mimic joint, follows it afterwards too, with the observed ratio.
Other writes of the old operation stay. So children of the joint and users of its coordinate remain valid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from kineverse.articulations import Joint
from kineverse.articulations.joint import OneDofJoint
from kineverse.compilation import compile
from kineverse.estimation.identification.families import WX, GroupMotion
from kineverse.estimation.identification.joint_operations import joint_operation, rigid_pose
from kineverse.estimation.identification.result import Fit
from kineverse.expressions.expression import Expression
from kineverse.lie import Array, exp_so3, inverse, log_so3, transform
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.frame import Frame
from kineverse.model.model import Model
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, FRAMES, RATES, Operation, Writes
from kineverse.model.rates import to_plain
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol

from .report import TestableJoint
from .residuals import JointObservations, KnownJoint


@dataclass(frozen=True)
class JointValue:
    """Value of a joint as an expression of its coordinate."""

    coordinate: Symbol
    value: Expression  # joint value, as an expression of the coordinate
    follows: Expression | None  # expression that the joint follows, if it has no coordinate of its own
    is_derived: bool  # True if the value is not the coordinate itself
    lower: float  # limits of the value
    upper: float


def find_joint_value(
    model: Model, joint: TestableJoint, served: KnownJoint, records: Mapping[str, Articulation]
) -> JointValue | None:
    """Return the value of a joint; None if it has several degrees of freedom."""
    if len(served.coordinates) != 1:
        return None
    (coordinate,) = served.coordinates
    position = next((record.position for record in records.values()), None)
    if position is None or position == coordinate:
        return JointValue(coordinate, coordinate, None, False, float(served.lower[0]), float(served.upper[0]))
    lower, upper = -math.inf, math.inf
    for (kind, _), limit in model.history.entry(joint.tag).writes.items():
        if kind == CONSTRAINTS and limit.expression == position:
            if not (limit.lower.symbols or limit.upper.symbols):
                lower, upper = max(lower, float(limit.lower)), min(upper, float(limit.upper))
    follows = None if isinstance(position, Symbol) else position
    return JointValue(coordinate, model.rates.resolve(to_plain(position)), follows, True, lower, upper)


def follows_another(model: Model, joint: TestableJoint) -> bool:
    """Return True if an operation records an expression that its joint follows, as a mimic joint does."""
    records = _records(model.history.entry(joint.tag).writes, joint)
    return any(record.follows is not None for record in records.values())


WrittenValues: TypeAlias = Mapping[tuple[str, str], Any]

# A joint follows another up to this residual, and with another ratio above this slope error, in deviations.
_FOLLOWS, _GEARED = 3.0, 4.0


@dataclass(frozen=True)
class ReplacedJoint(Operation, document_kind="Relearned"):
    """Identified joint, with the other writes of the operation that it replaces."""

    joint: Operation
    record: str | None = None  # name of the articulation's record; that of the joint if None
    kept: tuple[tuple[tuple[str, str], Any], ...] = ()  # cells of the old operation, with their values
    frame: str = ""  # frame that the joint places
    before: Pose = Pose()  # pose of the joint in its parent
    after: Pose = Pose()  # of the frame in the joint's child

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the joint and the other cells."""
        writes = self.joint.apply(model).writes()
        if (FRAMES, self.frame) in writes:
            placed = writes[FRAMES, self.frame]
            writes[FRAMES, self.frame] = Frame(placed.parent, (self.before, *placed.factors, self.after))
        if self.record is not None:
            cells = writes.items()
            writes = {(k, self.record if k == ARTICULATIONS else name): value for (k, name), value in cells}
        return Writes.from_cells({**dict(self.kept), **writes})

    def default_tag(self) -> str:
        """Return the tag of the joint."""
        return self.joint.default_tag()


def build_replacement(model: Model, data: JointObservations, fit: Fit) -> Operation:
    """Build the operation that replaces a joint by a fit of its observations."""
    joint, served, residuals = data.joint, data.served, data.residuals.select(fit.inliers)
    fit = replace(fit, joint_values=fit.joint_values[fit.inliers])
    base_T_parent = _constant(model, joint.parent, joint.base)
    frame_T_child = _constant(model, joint.child, joint.frame)
    writes = model.history.entry(joint.tag).writes
    records = _records(writes, joint)
    record = next(iter(records), None)
    motion, values = fit.motion, fit.joint_values
    before = find_joint_value(model, joint, served, records)
    same_kind, position = False, None
    places: tuple[Any, ...] = ()
    if isinstance(motion, GroupMotion) and motion.joints == 1 and before is not None:
        turns = motion.parametrisation.joints[0] >= WX
        same_kind = bool(served.is_angle[0]) == turns
        coordinates, others = residuals.values, residuals.other_values
        if same_kind and turns and not before.is_derived:
            coordinates = coordinates + _turn_about_axis(served, coordinates, motion, values)
        known = others[:, 0] if others.shape[1] else coordinates[:, 0]
        old = np.where(np.isfinite(known), known, coordinates[:, 0])
        if before.is_derived:
            old = np.asarray(compile(before.value, [before.coordinate]).batch(old[:, None]))
        geared = before.is_derived and bool(others.shape[1])
        motion, values, slope = _align_values(motion, values, old, same_kind, geared)
        same_kind = same_kind and slope == 1.0
        if before.follows is not None:
            off = values[:, 0] - slope * old
            if float(np.std(off)) < _FOLLOWS * float(np.sqrt(np.mean(fit.deviations**2))):
                position = before.follows if slope == 1.0 else slope * before.follows
    limits = list(zip(values.min(axis=0).tolist(), values.max(axis=0).tolist(), strict=True))
    if same_kind and before is not None:
        # The old limits stay, widened to the observed range.
        (low, high), *_ = limits
        limits = [(min(low, before.lower), max(high, before.upper))]
    if isinstance(motion, GroupMotion):
        right = motion.right @ inverse(frame_T_child)
        motion = replace(motion, left=base_T_parent @ motion.left, right=right)
    else:
        places = joint.frame, rigid_pose(base_T_parent), rigid_pose(inverse(frame_T_child))
    name = _name(records, joint, served, motion.joints)
    operation = joint_operation(motion, limits, name, joint.base, joint.frame)
    if record is not None and isinstance(operation, Joint):
        operation = replace(operation, dynamics=records[record].dynamics)
    if position is not None and isinstance(operation, OneDofJoint):
        operation = replace(operation, position=position)
    kept = _remaining_writes(writes, joint, served, same_kind, records)
    if record in (None, name) and not kept and not places:
        return operation
    return ReplacedJoint(operation, None if record == name else record, kept, *places)


def _records(writes: WrittenValues, joint: TestableJoint) -> dict[str, Articulation]:
    records = {name: value for (kind, name), value in writes.items() if kind == ARTICULATIONS}
    return {name: value for name, value in records.items() if value.child == joint.frame}


def _name(records: Mapping[str, Articulation], joint: TestableJoint, served: KnownJoint, joints: int) -> str:
    name = next(iter(records), joint.frame)
    if joints != 1 or len(served.coordinates) != 1:
        return name
    written = [x for value in records.values() for x in value.coordinates]
    if len(written) == 1:
        return written[0].path
    return name if records else served.coordinates[0].path


def _remaining_writes(
    writes: WrittenValues,
    joint: TestableJoint,
    served: KnownJoint,
    same_kind: bool,
    records: Mapping[str, Articulation],
) -> tuple[tuple[tuple[str, str], Any], ...]:
    """Return the writes that do not concern the pose between both frames."""
    replaced = {*served.coordinates, *(x for value in records.values() for x in value.coordinates)}
    kept = []
    for (kind, name), value in writes.items():
        if (kind == FRAMES and name == joint.frame) or (kind == ARTICULATIONS and name in records):
            continue
        if kind == RATES and value[0] in replaced:
            continue
        if kind == CONSTRAINTS:
            about = {s.position for s in value.expression.symbols}
            # Position limits are new; speed limits and locks stay if the unit is the same.
            if about <= replaced and not (same_kind and any(s.order for s in value.symbols)):
                continue
        kept.append(((kind, name), value))
    return tuple(kept)


_PARALLEL = 0.3  # hinges with axes that differ by more [rad] have no common zero


def _turn_about_axis(served: KnownJoint, coordinates: Array, motion: GroupMotion, values: Array) -> float:
    """Return the mean change of a served hinge's joint value that turns its poses like the identified ones.

    At a displaced hinge, the served joint values nearest to the poses compensate the displacement by a
    rotation. The zero of the relearned joint is that of the orientation.
    """
    there = served.linearise(coordinates)
    turns = log_so3(motion.linearise(values).pose[:, :3, :3] @ there.pose[:, :3, :3].mT)
    axes = there.by_joints[:, 3:, 0]
    about = np.einsum("ni,ni->n", turns, axes) / np.einsum("ni,ni->n", axes, axes)
    across = np.linalg.norm(turns - about[:, None] * axes, axis=1)
    return float(np.mean(about)) if float(np.max(across)) < _PARALLEL else 0.0


def _align_values(
    motion: GroupMotion, values: Array, old: Array, same_kind: bool, geared: bool
) -> tuple[GroupMotion, Array, float]:
    """Align joint values with the old ones; also return the ratio of both, 1 for the same kind."""
    new = values[:, 0]
    slope = float(np.mean((old - old.mean()) * (new - new.mean())))
    if slope < 0.0:
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        motion = replace(motion, left=motion.left @ flip, right=flip @ motion.right)
        new, slope = -new, -slope
    variance = float(np.var(old))
    slope = slope / variance if variance > 0.0 else 0.0
    off = new - new.mean() - slope * (old - old.mean())
    known = math.sqrt(float(np.var(off)) / (variance * len(old))) if variance > 0.0 else math.inf
    if same_kind and not (geared and abs(slope - 1.0) > _GEARED * known):
        slope = 1.0
    shift = float(new.mean()) - slope * float(old.mean())
    twist = np.zeros(6)
    twist[motion.parametrisation.joints[0]] = shift
    twist[2] += motion.pitch * twist[5]
    motion = replace(motion, left=motion.left @ transform(exp_so3(twist[3:]), twist[:3]))
    return motion, (new - shift)[:, None], slope


def _constant(model: Model, frame: str, relative_to: str) -> Array:
    transform = model.fk(frame, relative_to)
    return np.asarray(transform({s: s.value or 0.0 for s in transform.symbols}))
