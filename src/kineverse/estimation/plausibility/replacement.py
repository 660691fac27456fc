"""Replacement of a joint by an identified one.

Whoever hangs below or looks at a coordinate goes on working: frames keep their names, and so does the
coordinate where there is one before and one after. It keeps its direction and its zero as well, as far as it
has them: joint values are aligned with those of the served articulation. What followed another coordinate, as
a mimic joint, goes on to follow it, geared otherwise if that is what was seen. What the old operation wrote
beside the joint stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np

from kineverse.articulations import Joint
from kineverse.articulations.joint import OneDofJoint
from kineverse.compile import compile  # noqa: A004
from kineverse.estimation.identification.families import WX, GroupMotion
from kineverse.estimation.identification.found_operations import joint_operation, rigid_pose
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.outlier_rejection import RowIndices
from kineverse.estimation.identification.projection import project_observations
from kineverse.estimation.identification.result import Fit
from kineverse.estimation.linear_algebra import squared_errors
from kineverse.expressions.expression import Expression
from kineverse.lie import Stack, exp_so3, inverse, transform
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.frame import Frame
from kineverse.model.model import Model
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, FRAMES, RATES, Operation, Writes
from kineverse.model.rate_nodes import to_plain
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol

from .known_motion import KnownJoint
from .testability import TestableJoint


@dataclass(frozen=True)
class JointValue:
    """How far a joint had moved.

    Attributes
    ----------
    coordinate
        That of the served articulation.
    value
        How far the joint has moved, as an expression of it.
    follows
        What it follows, if it has no coordinate of its own.
    led
        Whether its value is more than the coordinate: one that follows, in whichever way.
    lower, upper
        Its limits.
    """

    coordinate: Symbol
    value: Expression
    follows: Expression | None
    led: bool
    lower: float
    upper: float

    def at(self, coordinates: Stack) -> Stack:
        """Return how far it had moved at values of the coordinate, (N,)."""
        if not self.led:
            return coordinates
        moved: Stack = np.asarray(compile(self.value, [self.coordinate]).batch(coordinates[:, None]))
        return moved


def find_joint_value(
    model: Model, link: TestableJoint, served: KnownJoint, records: Mapping[str, Articulation]
) -> JointValue | None:
    """Return how far a joint had moved; None if that is not one number."""
    if served.joints != 1 or len(served.coordinates) != 1:
        return None
    (coordinate,) = served.coordinates
    position = next((record.position for record in records.values()), None)
    if position is None or position == coordinate:
        return JointValue(coordinate, coordinate, None, False, float(served.lower[0]), float(served.upper[0]))
    value = model.rates.resolve(to_plain(position))
    lower, upper = -math.inf, math.inf
    for (kind, _), limit in model.history.entry(link.tag).writes.items():
        if kind == CONSTRAINTS and limit.expression == position:
            if not (limit.lower.symbols or limit.upper.symbols):
                lower, upper = max(lower, float(limit.lower)), min(upper, float(limit.upper))
    follows = None if isinstance(position, Symbol) else position
    return JointValue(coordinate, value, follows, True, lower, upper)


def follows_another(model: Model, link: TestableJoint) -> bool:
    """Whether an operation says itself what its joint follows, as a mimic joint."""
    writes = model.history.entry(link.tag).writes
    return any(
        kind == ARTICULATIONS and value.child == link.frame and value.follows is not None
        for (kind, _), value in writes.items()
    )


# χ² of six numbers that is exceeded once in a thousand.
_LIKELY = 22.5


def extend_fit(fit: Fit, seen: Observations, used: RowIndices) -> tuple[RowIndices, Fit]:
    """Return which observations a fit to some of them explains, and the fit with their joint values.

    Parameters
    ----------
    fit
        Of the observations ``used``.
    seen
        All observations.
    used
        The numbers of those of the fit.

    Returns
    -------
    rows, fit
        The numbers of other observations that are explained, followed by those of the fit.
    """
    others = np.setdiff1d(np.arange(len(seen)), used)
    if not len(others) or not fit.motion.joints:
        return used, fit
    solution = project_observations(fit.motion, fit.joint_values, seen.select(others))
    fits = squared_errors(solution.residuals, solution.covariance) < _LIKELY
    values = np.concatenate([solution.values[fits], fit.joint_values])
    return np.concatenate([others[fits], used]), replace(fit, joint_values=values)


WrittenValues: TypeAlias = Mapping[tuple[str, str], Any]

# What follows another may be off by so many deviations, and is geared if its slope is off by so many.
_FOLLOWS, _GEARED = 3.0, 4.0


@dataclass(frozen=True)
class ReplacedJoint(Operation):
    """A joint that was learned, and what the operation that it stands in for wrote beside its joint.

    Attributes
    ----------
    joint
        The joint.
    record
        The name under which the articulation is on record; that of the joint if None.
    kept
        The rest, as pairs of a cell (kind, name) and a value.
    frame
        The frame that the joint places.
    before, after
        Where the joint stands in its parent, and the frame on what the joint moves.
    """

    document_kind: ClassVar[str] = "Relearned"

    joint: Operation
    record: str | None = None
    kept: tuple[tuple[tuple[str, str], Any], ...] = ()
    frame: str = ""
    before: Pose = Pose()
    after: Pose = Pose()

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the joint and the rest."""
        writes = self.joint.apply(model).writes()
        if (FRAMES, self.frame) in writes:
            placed = writes[FRAMES, self.frame]
            factors = (self.before, *placed.factors, self.after)
            writes[FRAMES, self.frame] = Frame(placed.parent, factors)
        if self.record is not None:
            writes = {
                (kind, self.record if kind == ARTICULATIONS else name): value
                for (kind, name), value in writes.items()
            }
        return Writes.of({**dict(self.kept), **writes})

    def default_tag(self) -> str:
        """Return that of the joint."""
        return self.joint.default_tag()


def build_replacement(
    model: Model, link: TestableJoint, served: KnownJoint, coordinates: Stack, others: Stack, fit: Fit
) -> Operation:
    """Return the operation to replace the link's one by.

    Parameters
    ----------
    model, link, served
        The model as it is served, and the articulation in question.
    coordinates
        The served articulation's coordinates at the fit's observations, (N, n).
    others
        What others say of coordinates that are theirs, (N, e); NaN where they say nothing.
    fit
        What was identified between the frames that were seen.
    """
    base_T_parent = _constant(model, link.parent, link.base)
    frame_T_child = _constant(model, link.child, link.frame)
    writes = model.history.entry(link.tag).writes
    records = _records(writes, link)
    record = next(iter(records), None)
    if not isinstance(fit.motion, GroupMotion):
        joint = fit.operation(_name(records, link, served, fit.joint_values.shape[1]), link.base, link.frame)
        kept = _kept(writes, link, served, False, records)
        places = rigid_pose(base_T_parent), rigid_pose(inverse(frame_T_child))
        return ReplacedJoint(joint, record, kept, link.frame, *places)
    motion, values = fit.motion, fit.joint_values
    before = find_joint_value(model, link, served, records)
    alike, position = False, None
    if motion.joints == 1 and before is not None:
        turns = motion.parametrisation.joints[0] >= WX
        alike = bool(served.turning[0]) == turns
        told = others[:, 0] if others.shape[1] else coordinates[:, 0]
        old = before.at(np.where(np.isfinite(told), told, coordinates[:, 0]))
        motion, values, slope = _aligned(motion, values, old, alike, before.led and bool(others.shape[1]))
        alike = alike and slope == 1.0
        if before.follows is not None:
            off = values[:, 0] - slope * old
            if float(np.std(off)) < _FOLLOWS * float(np.sqrt(np.mean(fit.deviations**2))):
                position = before.follows if slope == 1.0 else slope * before.follows
    limits = [
        (float(low), float(high)) for low, high in zip(values.min(axis=0), values.max(axis=0), strict=True)
    ]
    if alike and before is not None:
        # Nothing was seen that contradicts the old limits; those that were left are wider now.
        (low, high), *_ = limits
        limits = [(min(low, before.lower), max(high, before.upper))]
    motion = replace(motion, left=base_T_parent @ motion.left, right=motion.right @ inverse(frame_T_child))
    name = _name(records, link, served, motion.joints)
    joint = joint_operation(motion, limits, name, link.base, link.frame)
    if record is not None and isinstance(joint, Joint):
        joint = replace(joint, dynamics=records[record].dynamics)
    if position is not None and isinstance(joint, OneDofJoint):
        joint = replace(joint, position=position)
    kept = _kept(writes, link, served, alike, records)
    if record in (None, name) and not kept:
        return joint
    return ReplacedJoint(joint, None if record == name else record, kept)


def _records(writes: WrittenValues, link: TestableJoint) -> dict[str, Articulation]:
    """Return what is on record about the joint."""
    return {
        name: value
        for (kind, name), value in writes.items()
        if kind == ARTICULATIONS and value.child == link.frame
    }


def _name(records: Mapping[str, Articulation], link: TestableJoint, served: KnownJoint, joints: int) -> str:
    """Return what the joint is called: like the old coordinate, where there was one of its own and is one."""
    named = next(iter(records), link.frame)
    if joints != 1 or len(served.coordinates) != 1:
        return named
    own = [x for value in records.values() for x in value.coordinates]
    if len(own) == 1:
        return own[0].path
    return named if records else served.coordinates[0].path


def _kept(
    writes: WrittenValues,
    link: TestableJoint,
    served: KnownJoint,
    alike: bool,
    records: Mapping[str, Articulation],
) -> tuple[tuple[tuple[str, str], Any], ...]:
    """Return what has nothing to do with the pose between both frames."""
    own = {*served.coordinates, *(x for value in records.values() for x in value.coordinates)}
    kept = []
    for (kind, name), value in writes.items():
        if (kind == FRAMES and name == link.frame) or (kind == ARTICULATIONS and name in records):
            continue
        if kind == RATES and value[0] in own:
            continue
        if kind == CONSTRAINTS:
            about = {s.position for s in value.expression.symbols}
            # Limits are new; a speed limit or a lock means something as long as its unit is the same.
            if about <= own and not (alike and any(s.order for s in value.symbols)):
                continue
        kept.append(((kind, name), value))
    return tuple(kept)


def _aligned(
    motion: GroupMotion, values: Stack, old: Stack, alike: bool, geared: bool
) -> tuple[GroupMotion, Stack, float]:
    """Return the same motion with joint values that grow with the old ones, and are 0 where those are.

    And how fast: as fast, if they are alike, unless ``geared`` says that the old ones were seen elsewhere.
    """
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
    if alike and not (geared and abs(slope - 1.0) > _GEARED * known):
        slope = 1.0
    shift = float(new.mean()) - slope * float(old.mean())
    twist = np.zeros(6)
    twist[motion.parametrisation.joints[0]] = shift
    twist[2] += motion.pitch * twist[5]
    motion = replace(motion, left=motion.left @ transform(exp_so3(twist[3:]), twist[:3]))
    return motion, (new - shift)[:, None], slope


def _constant(model: Model, frame: str, relative_to: str) -> Stack:
    transform = model.fk(frame, relative_to)
    values: Stack = transform({s: s.value or 0.0 for s in transform.symbols})
    return values
