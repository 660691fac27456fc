"""Conversion of a model to a tree of links and joints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from kineverse.articulations.multi_axis import orientation
from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.formats.description import (
    IDENTITY_COEFFICIENTS,
    NO_BODY,
    BallJointDescription,
    JointDescription,
    LinkDescription,
    LoopJoint,
    RobotDescription,
    SumLimit,
)
from kineverse.formats.names import TakenNames
from kineverse.intervals.graph import TermGraph
from kineverse.loops.equations import AXES
from kineverse.loops.record import LOOP_KINDS as LOOPS
from kineverse.loops.record import LoopRecord, find_loops
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.model.rates import Rates
from kineverse.model.registry import FrameDeviation
from kineverse.spatial import OneAxisTransform, quaternion
from kineverse.symbols import Symbol

from .approximation import CurveApproximation
from .capabilities import FormatCapabilities, UnsupportedFeatures
from .joint_axes import (
    JointMotion,
    MotionChain,
    QuaternionMotion,
    UnrecognisedMotionError,
    decompose_transform,
)
from .joint_limits import (
    CoordinateLimit,
    NonlinearLimit,
    assign_limits,
    classify_constraints,
    has_given_gradient,
    intersect_limits,
)


def sort_parents_first(model: ModelView) -> list[str]:
    """Return the names of all frames, each after its parent, in their order where that allows it."""
    frames = dict(model.frames)
    done = {WORLD: None}
    for name in frames:
        chain = []
        while name not in done:
            chain.append(name)
            name = frames[name].parent
        done |= dict.fromkeys(reversed(chain))
    return [name for name in done if name in frames]


def check_left_out_names(leave_out: Iterable[str], model: ModelView) -> frozenset[str]:
    """Return the names of what is to be left out, if all of them exist."""
    wanted = [leave_out] if isinstance(leave_out, str) else list(leave_out)
    known = {*model.constraints, *model.articulations, *map(str, model.rates)}
    for name in wanted:
        if name not in known:
            raise UnknownNameError(
                f"{name!r} cannot be left out: it is neither a constraint nor an articulation. "
                f"{suggest(str(name), known, 'name')}"
            )
    return frozenset(wanted)


_STILL_TOLERANCE = 1e-9


def find_loop_joints(model: ModelView) -> Iterator[LoopJoint]:
    """Yield what ties the ends of loops, and what they determine, where that is faithful.

    Points that coincide are tied by a ``connect``, and so are those in a plane that nothing leaves; frames
    that coincide by a ``weld``. A loop that says anything else is none of these.
    """
    for loop in find_loops(model):
        kind = _loop_joint_kind(model, loop)
        if kind is not None:
            yield LoopJoint(loop.name, kind, loop.ends, loop.free, loop.dependent, loop.constraints)


def _loop_joint_kind(model: ModelView, loop: LoopRecord) -> Literal["connect", "weld"] | None:
    if set(loop.mask) == set(AXES):
        return "weld"
    if not set(loop.mask) <= set(AXES[:3]):
        return None
    # What the mask leaves open may not move, or the tie would hold it: a plane's normal does not.
    for frame, to in loop.ends:
        pose = model.rates.resolve(model.fk(frame, to))
        for k, axis in enumerate(AXES[:3]):
            if axis not in loop.mask and (pose[k, 3].symbols or abs(float(pose[k, 3])) > _STILL_TOLERANCE):
                return None
    return "connect"


_QX_SUFFIX = "/qx"


def find_quaternions(model: ModelView) -> Iterator[tuple[str, Expression]]:
    """Yield names and rotations of coordinates ``name/qx`` ... ``name/qw`` with q̇ = ½ q ⊗ (ω, 0)."""
    rates = model.rates
    for coordinate in rates:
        if not coordinate.path.endswith(_QX_SUFFIX):
            continue
        name = coordinate.path.removesuffix(_QX_SUFFIX)
        usual = orientation(name)
        if all(x in rates and rates[x] == row for x, row in usual.rates.items()):
            yield name, quaternion(*usual.coordinates)


_POWERS = {1: "multiple", 4: "polynomial of degree 4"}
_WHOLE = (IDENTITY_COEFFICIENTS, (0.0, -1.0))
"""The amounts by which a joint may be a coordinate."""


class LinkTreeBuilder:
    """Turns one model into a plan.

    Parameters
    ----------
    model
        The model.
    target
        What the format can say.
    leave_out
        Names of constraints that are left out, and of articulations whose own speeds are.
    tolerance
        How far frames may be off [m], [rad]; None for nowhere.
    strict
        Whether constraints that the format cannot say are refused, rather than left out.
    """

    def __init__(
        self,
        model: ModelView,
        target: FormatCapabilities,
        leave_out: Iterable[str] = (),
        tolerance: float | None = None,
        strict: bool = False,
    ) -> None:
        self.model, self.target = model, target
        self.refusals = UnsupportedFeatures(target.name, strict)
        self.remarks: list[str] = []
        # What refused frames move by: its own limits need no complaint of their own.
        self._lost: set[Symbol] = set()
        self._left_out = check_left_out_names(leave_out, model)
        self._records = {record.child: name for name, record in _own_records(model)}
        self._values: dict[Symbol, Expression] = {}
        self._terms = TermGraph({})
        self._quaternions = dict(find_quaternions(model))
        self._tolerance = tolerance
        self._loops = list(find_loop_joints(model)) if target.loops else []
        determined = {name for loop in self._loops for name in loop.dependent}
        tied_by_loops = {s for s in model.rates.dependent if str(s) in determined}
        given = model.plain_rates()
        self._rates = Rates({x: e for x, e in given.items() if x not in tied_by_loops})
        # What a tie determines is a coordinate like any other for who reads it.
        self._coordinates = sorted({*model.degrees_of_freedom, *tied_by_loops}, key=lambda s: s.sort_key)

    def plan(self) -> RobotDescription:
        """Return the plan; what cannot be said is in :attr:`refusals`."""
        tied = {name for loop in self._loops for name in loop.constraints}
        # With rates, ``model.constraints`` has coordinates as nodes, which only look like curves.
        kept = {
            n: c
            for n, c in self.model.plain_constraints().items()
            if n not in self._left_out and n not in tied
        }
        found = list(classify_constraints(kept, self.resolve, self.refusals))
        ranges = intersect_limits(item for item in found if isinstance(item, CoordinateLimit))
        approximation = None
        if self._tolerance is not None:
            approximation = CurveApproximation(self._terms, ranges, self.target.degree, self._tolerance)
        everywhere = {name: self._placed(name, approximation) for name in sort_parents_first(self.model)}
        placed = {name: there for name, there in everywhere.items() if there is not None}
        self._check_rates(placed)
        joints = TakenNames(s.path for s in self._coordinates)
        leading = self._leading(placed)
        links = [self._link(name, there, leading, joints) for name, there in placed.items()]
        links += self._carriers(placed, set(leading), links)
        plan = RobotDescription(links, self.model.bodies.get(WORLD, NO_BODY), loops=self._loops)
        simple = list(self._simple(found, approximation))
        assign_limits(plan, simple, self.target.name, self.target.sums, self.target.one_way, self.refusals)
        if approximation is not None and len(placed) == len(everywhere):
            plan.errors = approximation.errors(placed, {n: self.model.frames[n].parent for n in placed})
            self._check_errors(plan.errors)
        self._remark()
        plan.remarks = self.remarks
        return plan

    def _simple(
        self,
        found: Iterable[CoordinateLimit | SumLimit | NonlinearLimit],
        approximation: CurveApproximation | None,
    ) -> Iterator[CoordinateLimit | SumLimit]:
        """Yield the constraints that can be said, without those that hold because of others."""
        for item in found:
            if isinstance(item, NonlinearLimit):
                curve = item.expression, item.lower, item.upper
                if approximation is None or not approximation.implied(*curve):
                    self.refusals.leave(item.name, item.reason)
                else:
                    self.remarks.append(f"'{item.name}' is not written: it holds within the other limits")
            elif isinstance(item, SumLimit) or item.symbol.position not in self._lost:
                yield item

    def _check_errors(self, errors: Mapping[str, FrameDeviation]) -> None:
        """Refuse the frame that is off most, if that is too much."""
        assert self._tolerance is not None
        worst = max(errors, key=lambda name: max(errors[name].position, errors[name].angle), default=None)
        if worst is None:
            return
        error = errors[worst]
        if error.position == math.inf:
            self.refusals.add(
                worst,
                "is carried by something approximated, and a coordinate without limits takes it anywhere",
            )
        elif max(error.position, error.angle) > self._tolerance:
            self.refusals.add(worst, f"would be off by up to {error}, and no less was found")

    def home(self) -> dict[Symbol, float]:
        """Return where every coordinate is unless more is known, those that loops determine among them."""
        state = self.model.default_state()
        values = {s: state[s] for s in self._coordinates if s in state}
        for s in self._coordinates:
            if s not in values:
                values[s] = float(self.model.rates.dependent[s](state))
        return values

    def resolve(self, expression: Expression) -> Expression:
        """Return an expression of coordinates that depend on nothing, parameters at their values."""
        expression = self._rates.resolve(expression)
        parameters = [s for s in expression.symbols if not s.has_derivative]
        for s in parameters:
            if s not in self._values and s.value is not None:
                self._values[s] = as_expression(s.value)
                self.remarks.append(f"the parameter '{s}' is written with its value {s.value!r}")
            elif s.value is None:
                self.refusals.add(str(s), "is a parameter without a value")
        known = {s: self._values[s] for s in parameters if s in self._values}
        return apply_substitution(expression, known) if known else expression

    def _placed(self, name: str, approximation: CurveApproximation | None) -> MotionChain | None:
        """Return where a frame is in its parent; None if that is refused."""
        factors = [self._factor(f) for f in self.model.frames[name].factors]
        follows = name in self._records and self.model.articulations[self._records[name]].follows is not None
        if any(has_given_gradient(f) for f in factors if isinstance(f, Expression)):
            self.refusals.add(name, "moves with a gradient that was given and is not the derivative")
            self._lost.update(s for f in factors if isinstance(f, Expression) for s in f.symbols)
            return None
        try:
            found = decompose_transform(
                factors, self._terms, list(self._quaternions.values()), offsets=follows
            )
        except UnrecognisedMotionError as problem:
            self._refuse(name, factors, str(problem))
            return None
        if approximation is not None:
            near = approximation.placing(name, found)
            if isinstance(near, str):
                self._refuse(name, factors, near)
                return None
            return near
        for motion in found.moving:
            if isinstance(motion, JointMotion) and (
                motion.curved or len(motion.amount) > self.target.degree + 1
            ):
                verb, powers = "turns" if motion.turns else "slides", _POWERS[self.target.degree]
                self._refuse(name, factors, f"{verb} by no {powers} of a coordinate")
                self.refusals.curved = True
                return None
        return found

    def _refuse(self, name: str, factors: Iterable[Pose | Expression], problem: str) -> None:
        about = dict.fromkeys(s for f in factors if isinstance(f, Expression) for s in f.symbols)
        self._lost.update(about)
        moves = f"it moves with {', '.join(map(str, about))}" if about else "loops hold it where it is"
        self.refusals.add(name, f"{problem}; {moves}")

    def _factor(self, factor: Pose | Expression) -> Pose | Expression:
        if isinstance(factor, Pose):
            return factor
        if isinstance(factor, OneAxisTransform):
            amount = self.resolve(factor.amount)
            return (
                factor
                if amount is factor.amount
                else OneAxisTransform(factor.direction, amount, factor.is_rotation)
            )
        return self.resolve(factor)

    def _leading(self, placed: Mapping[str, MotionChain]) -> dict[Symbol, tuple[str, int]]:
        """Return for each coordinate the frame, and which of its motions, that is just this coordinate.

        Of several, the one that is on record for it; for some there is none.
        """
        leading: dict[Symbol, tuple[str, int]] = {}
        on_record: set[Symbol] = set()
        for name, found in placed.items():
            own = self._record(name)
            for k, motion in enumerate(found.moving):
                if not isinstance(motion, JointMotion) or motion.amount not in _WHOLE:
                    continue
                symbol = motion.variable.data
                if symbol not in leading:
                    leading[symbol] = name, k
                if own is not None and symbol in own.coordinates and symbol not in on_record:
                    leading[symbol] = name, k
                    on_record.add(symbol)
        return leading

    def _record(self, frame: str) -> Articulation | None:
        name = self._records.get(frame)
        return None if name is None else self.model.articulations[name]

    def _link(
        self, name: str, found: MotionChain, leading: Mapping[Symbol, tuple[str, int]], joints: TakenNames
    ) -> LinkDescription:
        record = self._record(name)
        label = self._records.get(name, name)
        dynamics = dict(record.dynamics) if record is not None else {}
        follows = None
        if record is not None and record.follows is not None:
            position = self.resolve(record.follows)
            follows = Constraint(position, position, position).line
        made: list[JointDescription | BallJointDescription] = []
        for k, motion in enumerate(found.moving):
            if isinstance(motion, QuaternionMotion):
                ball = next(n for n, q in self._quaternions.items() if q == motion.factor)
                made.append(BallJointDescription(ball, motion.point))
                continue
            symbol: Symbol = motion.variable.data
            if leading.get(symbol) == (name, k):
                axis = motion.axis if motion.amount == IDENTITY_COEFFICIENTS else _negative(motion.axis)
                made.append(JointDescription(symbol.path, motion.turns, axis, motion.point, symbol))
                continue
            what = "turn" if motion.turns else "slide"
            wishes = [label, name] if len(found.moving) == 1 else []
            own = joints.take(*wishes, f"{label}/{what}")
            axis, amount = motion.axis, motion.amount
            opposite = tuple(-c for c in amount)
            if follows is not None and follows == opposite[::-1]:
                # Its own limits are on what is on record, so that is its position, and not the opposite.
                axis, amount = _negative(axis), opposite
            made.append(JointDescription(own, motion.turns, axis, motion.point, symbol, amount))
        given = _split_dynamics(dynamics, made)
        made = [replace(joint, dynamics=own) for joint, own in zip(made, given, strict=True)]
        body = self.model.bodies.get(name, NO_BODY)
        fixed = "" if made else joints.take(label, name, f"{name}/fixed")
        return LinkDescription(
            name, self.model.frames[name].parent, found.pose, made, body, fixed, record is not None
        )

    def _carriers(
        self,
        placed: Mapping[str, MotionChain],
        leading: set[Symbol],
        links: list[LinkDescription],
    ) -> Iterator[LinkDescription]:
        """Yield links that carry nothing, for coordinates that only others follow, or that move nothing."""
        frames = TakenNames([*self.model.frames, WORLD])
        used = {s for found in placed.values() for s in _quaternion_coordinates(found)}
        first: dict[Symbol, tuple[str, JointMotion]] = {}
        for name, found in placed.items():
            for motion in found.moving:
                if isinstance(motion, JointMotion):
                    first.setdefault(motion.variable.data, (self.model.frames[name].parent, motion))
        for symbol in self._coordinates:
            if symbol in leading or symbol in used or symbol in self._lost:
                continue
            parent, turns, axis = links[0].name if links else WORLD, True, (0.0, 0.0, 1.0)
            if symbol in first:
                parent, follower = first[symbol]
                turns, axis = follower.turns, follower.axis
            joint = JointDescription(symbol.path, turns, axis, (0.0, 0.0, 0.0), symbol)
            self.remarks.append(f"'{symbol}' has a link of its own that carries nothing")
            yield LinkDescription(
                frames.take(symbol.path, f"{symbol.path}/carrier"), parent, np.eye(4), [joint]
            )

    def _check_rates(self, placed: Mapping[str, MotionChain]) -> None:
        """Leave out that coordinates move by the speeds of others, except quaternions that turn."""
        fine = {s for found in placed.values() for s in _quaternion_coordinates(found)}
        driven: dict[str, set[str]] = {}
        for coordinate, row in self._rates.items():
            if coordinate in fine:
                continue
            owner = next(
                (n for n, r in self.model.articulations.items() if coordinate in r.coordinates),
                str(coordinate),
            )
            if owner in self._left_out or str(coordinate) in self._left_out:
                continue
            driven.setdefault(owner, set()).update(map(str, row))
        for owner, speeds in driven.items():
            self.refusals.leave_out_speeds(
                owner, f"moves by speeds that are not its own, {', '.join(sorted(speeds))}"
            )

    def _remark(self) -> None:
        if self.model.data:
            names = list(self.model.data)
            more = f" and {len(names) - 4} more" if len(names) > 4 else ""
            self.remarks.append(f"data are not written: {', '.join(names[:4])}{more}")
        for name in self._left_out:
            self.remarks.append(f"'{name}' is left out, as asked for")


def _own_records(model: ModelView) -> Iterator[tuple[str, Articulation]]:
    for name, record in model.articulations.items():
        if record.kind not in LOOPS:
            yield name, record


def _quaternion_coordinates(found: MotionChain) -> Iterator[Symbol]:
    for motion in found.moving:
        if isinstance(motion, QuaternionMotion):
            yield from motion.factor.symbols


def _split_dynamics(
    dynamics: dict[str, object], joints: list[JointDescription | BallJointDescription]
) -> list[dict[str, object]]:
    """Return what is known of each joint: all of it of a single one, else what bears its last name."""
    if len(joints) == 1:
        return [dynamics]
    result = []
    for joint in joints:
        start = f"{joint.name.rpartition('/')[2]}/"
        result.append({k.removeprefix(start): v for k, v in dynamics.items() if k.startswith(start)})
    return result


def _negative(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = axis
    return 0.0 - x, 0.0 - y, 0.0 - z
