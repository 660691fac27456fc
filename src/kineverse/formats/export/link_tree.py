"""Conversion of a model to a tree of links and joints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from kineverse._names import match_names
from kineverse.articulations.multi_axis import orientation
from kineverse.errors import list_some
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.formats.description import (
    IDENTITY_COEFFICIENTS,
    BallJointDescription,
    JointDescription,
    LinkDescription,
    LoopJoint,
    RobotDescription,
    SumLimit,
)
from kineverse.formats.names import TakenNames
from kineverse.formats.poses import ROTATION_TOLERANCE, rotation_deviation
from kineverse.formats.urdf.kept_elements import describe_elements, read_kept_parts
from kineverse.intervals.graph import TermGraph
from kineverse.loops.equations import AXES
from kineverse.loops.loop_records import LOOP_KINDS, LoopRecord, find_loops
from kineverse.model.articulation import Articulation
from kineverse.model.body import NO_BODY, Pose
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
    """Return the names of all frames, each after its parent, otherwise in the order of the model."""
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
    """Return the constraints, articulations and coordinates with rates of names or patterns."""
    known = [*model.constraints, *model.articulations, *map(str, model.rates)]
    return frozenset(match_names(leave_out, known, "constraint or articulation", "leave_out="))


def check_rotation(link: LinkDescription, unsupported: UnsupportedFeatures) -> None:
    """Refuse a link whose constant pose has no rotation matrix, which no roll, pitch and yaw represent."""
    deviation = rotation_deviation(link.pose)
    if deviation > ROTATION_TOLERANCE:
        unsupported.refuse(
            link.name, f"is turned by a constant that is off by {deviation:.2g} from any rotation"
        )


_STILL_TOLERANCE = 1e-9  # largest distance [m] of a point from a plane in which it stays


def find_loop_joints(model: ModelView) -> Iterator[LoopJoint]:
    """Yield the loops of a model that are equivalent to a ``connect`` or a ``weld``.

    A ``connect`` makes two points coincide; it also represents points of a planar loop. A ``weld`` makes two
    frames coincide. Loops of any other kind are not yielded.
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
    # A connect would also hold the directions that the mask leaves open. They may not move at all, as the
    # normal of a planar loop.
    for frame, to in loop.ends:
        pose = model.rates.resolve(model.fk(frame, to))
        for k, axis in enumerate(AXES[:3]):
            if axis not in loop.mask and (pose[k, 3].symbols or abs(float(pose[k, 3])) > _STILL_TOLERANCE):
                return None
    return "connect"


_QX_SUFFIX = "/qx"


def find_quaternions(model: ModelView) -> Iterator[tuple[str, Expression]]:
    """Yield the names and rotations of all quaternions, coordinates ``name/qx`` … with q̇ = ½ q ⊗ (ω, 0)."""
    rates = model.rates
    for coordinate in rates:
        if not coordinate.path.endswith(_QX_SUFFIX):
            continue
        name = coordinate.path.removesuffix(_QX_SUFFIX)
        usual = orientation(name)
        if all(x in rates and rates[x] == row for x, row in usual.rates.items()):
            yield name, quaternion(*usual.coordinates)


_POWERS = {1: "multiple", 4: "polynomial of degree 4"}
_UNIT_COEFFICIENTS = (IDENTITY_COEFFICIENTS, (0.0, -1.0))
"""Polynomials by which a joint's position is its coordinate, about the axis or the opposite axis."""


class LinkTreeBuilder:
    """Builder of the robot description of one model.

    With ``loose``, frames that the format cannot move are loose links. With ``carriers``, by default unless
    ``loose``, coordinates that are the position of no joint have a link of their own; else each link is a
    frame.
    """

    def __init__(
        self,
        model: ModelView,
        target: FormatCapabilities,
        leave_out: Iterable[str] = (),
        tolerance: float | None = None,
        strict: bool = False,
        loose: bool = False,
        carriers: bool | None = None,
    ) -> None:
        self.model, self.capabilities = model, target
        self._loose = loose
        self._carriers = not loose if carriers is None else carriers
        self.unsupported = UnsupportedFeatures(target.name, strict)
        self.remarks: list[str] = []
        # Symbols of refused frames: their limits are not reported a second time.
        self._refused_symbols: set[Symbol] = set()
        self._left_out = check_left_out_names(leave_out, model)
        self._articulations = {record.child: name for name, record in _non_loop_articulations(model)}
        self._owners = {s: r for _, r in _non_loop_articulations(model) for s in r.coordinates}
        self._values: dict[Symbol, Expression] = {}
        self._terms = TermGraph({})
        self._quaternions = dict(find_quaternions(model))
        self._tolerance = tolerance
        self._loops = list(find_loop_joints(model)) if target.loop_joints else []
        dependent_names = {name for loop in self._loops for name in loop.dependent}
        loop_dependent = {s for s in model.rates.dependent if str(s) in dependent_names}
        rates = model.plain_rates()
        self._rates = Rates({x: e for x, e in rates.items() if x not in loop_dependent})
        # A format that closes loops itself has the dependent coordinates as joints like all others.
        self._coordinates = sorted({*model.degrees_of_freedom, *loop_dependent}, key=lambda s: s.sort_key)

    def build(self) -> RobotDescription:
        """Build the robot description; :attr:`unsupported` receives what the format cannot represent."""
        omitted = self._left_out | {name for loop in self._loops for name in loop.constraints}
        # In a model with rates, ``model.constraints`` has nodes for coordinates, which look like curves.
        constraints = {n: c for n, c in self.model.plain_constraints().items() if n not in omitted}
        found = list(classify_constraints(constraints, self.resolve, self.unsupported))
        ranges = intersect_limits(item for item in found if isinstance(item, CoordinateLimit))
        approximation = None
        if self._tolerance is not None:
            degree = self.capabilities.polynomial_degree
            approximation = CurveApproximation(self._terms, ranges, degree, self._tolerance)
        names = sort_parents_first(self.model)
        decomposed = {name: self._decompose_frame(name, approximation) for name in names}
        chains = {name: chain for name, chain in decomposed.items() if chain is not None}
        self._check_rates(chains)
        joints = TakenNames(s.path for s in self._coordinates)
        independent = self._independent_motions(chains)
        links = [
            self._link(name, chains[name], independent, joints) if name in chains else self._loose_link(name)
            for name in names
            if name in chains or self._loose
        ]
        if self._carriers:
            links += self._carrier_links(chains, set(independent), links)
        description = RobotDescription(links, self.model.bodies.get(WORLD, NO_BODY), loops=self._loops)
        self._check_leaders(description)
        simple = list(self._expressible_constraints(found, approximation))
        assign_limits(description, simple, self.capabilities, self.unsupported)
        if approximation is not None and len(chains) == len(decomposed):
            parents = {n: self.model.frames[n].parent for n in chains}
            description.errors = approximation.frame_deviations(chains, parents)
            self._check_errors(description.errors)
        self._add_remarks()
        description.remarks = self.remarks
        return description

    def _check_leaders(self, description: RobotDescription) -> None:
        """Refuse joints that follow what is the position of no joint, such as a number of a quaternion."""
        known = {joint.symbol for joint in description.joints if joint.is_independent} | self._refused_symbols
        for joint in () if self._loose else description.joints:
            if joint.symbol not in known:
                target = self.capabilities.name
                self.unsupported.refuse(
                    joint.name, f"follows '{joint.symbol}', which is the position of no joint in {target}"
                )

    def _expressible_constraints(
        self,
        found: Iterable[CoordinateLimit | SumLimit | NonlinearLimit],
        approximation: CurveApproximation | None,
    ) -> Iterator[CoordinateLimit | SumLimit]:
        """Yield the limits that the format can represent, without those that others imply."""
        for item in found:
            if isinstance(item, NonlinearLimit):
                curve = item.expression, item.lower, item.upper
                if approximation is None or not approximation.is_implied(*curve):
                    self.unsupported.leave_out(item.name, item.reason)
                else:
                    self.remarks.append(f"'{item.name}' is not written: it holds within the other limits")
            elif isinstance(item, SumLimit) or item.symbol.position not in self._refused_symbols:
                yield item

    def _check_errors(self, errors: Mapping[str, FrameDeviation]) -> None:
        assert self._tolerance is not None
        worst = max(errors, key=lambda name: max(errors[name].position, errors[name].angle), default=None)
        if worst is None:
            return
        error = errors[worst]
        if error.position == math.inf:
            self.unsupported.refuse(
                worst,
                "is carried by something approximated, and a coordinate without limits takes it anywhere",
            )
        elif max(error.position, error.angle) > self._tolerance:
            self.unsupported.refuse(worst, f"would be off by up to {error}, and no less was found")

    def home_positions(self) -> dict[str, float]:
        """Return the home position of every coordinate by its path, including those that depend on loops."""
        state = self.model.default_state()
        values = {s: state[s] for s in self._coordinates if s in state}
        for s in self._coordinates:
            if s not in values:
                values[s] = float(self.model.rates.dependent[s](state))
        return {s.path: value for s, value in values.items()}

    def resolve(self, expression: Expression) -> Expression:
        """Return an expression in terms of independent coordinates, with the values of parameters."""
        expression = self._rates.resolve(expression)
        parameters = [s for s in expression.symbols if not s.has_derivative]
        for s in parameters:
            if s not in self._values and s.value is not None:
                self._values[s] = as_expression(s.value)
                self.remarks.append(f"the parameter '{s}' is written with its value {s.value!r}")
            elif s.value is None:
                self.unsupported.refuse(str(s), "is a parameter without a value")
        known = {s: self._values[s] for s in parameters if s in self._values}
        return apply_substitution(expression, known) if known else expression

    def _decompose_frame(self, name: str, approximation: CurveApproximation | None) -> MotionChain | None:
        factors = [self._factor(f) for f in self.model.frames[name].factors]
        record = self._articulation_of(name)
        follows = record is not None and record.follows is not None
        given = any(has_given_gradient(f) for f in factors if isinstance(f, Expression))
        if given and not self._loose:
            self.unsupported.refuse(name, "moves with a gradient that was given and is not the derivative")
            self._refused_symbols.update(s for f in factors if isinstance(f, Expression) for s in f.symbols)
            return None
        try:
            result = decompose_transform(
                factors, self._terms, list(self._quaternions.values()), offsets=follows
            )
        except UnrecognisedMotionError as problem:
            self._refuse(name, factors, str(problem))
            return None
        if approximation is not None:
            approximated = approximation.approximate(name, result)
            if isinstance(approximated, str):
                self._refuse(name, factors, approximated)
                return None
            return approximated
        degree = self.capabilities.polynomial_degree
        for motion in result.motions:
            if isinstance(motion, JointMotion) and (
                motion.is_curved or len(motion.coefficients) > degree + 1
            ):
                verb = "turns" if motion.is_rotation else "slides"
                self._refuse(name, factors, f"{verb} by no {_POWERS[degree]} of a coordinate")
                self.unsupported.curved = True
                return None
        return result

    def _refuse(self, name: str, factors: Iterable[Pose | Expression], problem: str) -> None:
        if self._loose:
            return
        symbols = dict.fromkeys(s for f in factors if isinstance(f, Expression) for s in f.symbols)
        self._refused_symbols.update(symbols)
        moves = f"it moves with {', '.join(map(str, symbols))}" if symbols else "loops hold it where it is"
        self.unsupported.refuse(name, f"{problem}; {moves}")

    def _factor(self, factor: Pose | Expression) -> Pose | Expression:
        if isinstance(factor, Pose):
            return factor
        if isinstance(factor, OneAxisTransform):
            amount = self.resolve(factor.amount)
            if amount is factor.amount:
                return factor
            return OneAxisTransform(factor.direction, amount, factor.is_rotation)
        return self.resolve(factor)

    def _independent_motions(self, chains: Mapping[str, MotionChain]) -> dict[Symbol, tuple[str, int]]:
        """Return for each coordinate the frame and the number of the motion whose position it is.

        Of several motions, the one in the articulation of the coordinate is taken. Coordinates without such a
        motion are missing.
        """
        independent: dict[Symbol, tuple[str, int]] = {}
        in_articulation: set[Symbol] = set()
        for name, found in chains.items():
            own = self._articulation_of(name)
            for k, motion in enumerate(found.motions):
                if not isinstance(motion, JointMotion) or motion.coefficients not in _UNIT_COEFFICIENTS:
                    continue
                symbol = motion.variable.data
                if symbol not in independent:
                    independent[symbol] = name, k
                if own is not None and symbol in own.coordinates and symbol not in in_articulation:
                    independent[symbol] = name, k
                    in_articulation.add(symbol)
        return independent

    def _articulation_of(self, frame: str) -> Articulation | None:
        name = self._articulations.get(frame)
        return None if name is None else self.model.articulations[name]

    def _link(
        self, name: str, found: MotionChain, independent: Mapping[Symbol, tuple[str, int]], joints: TakenNames
    ) -> LinkDescription:
        record = self._articulation_of(name)
        label = self._articulations.get(name, name)
        follows = None
        if record is not None and record.follows is not None:
            position = self.resolve(record.follows)
            follows = Constraint(position, position, position).line
        made: list[JointDescription | BallJointDescription] = []
        for k, motion in enumerate(found.motions):
            if isinstance(motion, QuaternionMotion):
                ball = next(n for n, q in self._quaternions.items() if q == motion.factor)
                made.append(BallJointDescription(ball, motion.point))
                continue
            symbol: Symbol = motion.variable.data
            if independent.get(symbol) == (name, k):
                axis = motion.axis if motion.coefficients == IDENTITY_COEFFICIENTS else _negative(motion.axis)
                made.append(JointDescription(symbol.path, motion.is_rotation, axis, motion.point, symbol))
                continue
            kind = "turn" if motion.is_rotation else "slide"
            preferred = [label, name] if len(found.motions) == 1 else []
            own = joints.take(*preferred, f"{label}/{kind}")
            axis, coefficients = motion.axis, motion.coefficients
            opposite = tuple(-c for c in coefficients)
            if follows is not None and follows == opposite[::-1]:
                # The limits of an articulation are on the position that it states, not on the opposite one.
                axis, coefficients = _negative(axis), opposite
            made.append(JointDescription(own, motion.is_rotation, axis, motion.point, symbol, coefficients))
        made = [replace(joint, dynamics=self._dynamics_of(joint, record, len(made))) for joint in made]
        body = self.model.bodies.get(name, NO_BODY)
        fixed = "" if made else joints.take(label, name, f"{name}/fixed")
        return LinkDescription(
            name,
            self.model.frames[name].parent,
            found.pose,
            made,
            body,
            fixed,
            record is not None,
            _joint_dynamics(record),
        )

    def _loose_link(self, name: str) -> LinkDescription:
        parent, body = self.model.frames[name].parent, self.model.bodies.get(name, NO_BODY)
        pose, home = self.model.fk(name, parent), self.model.default_state()
        values = {symbol: home[symbol] for symbol in pose.symbols}
        return LinkDescription(name, parent, pose(values), body=body, is_loose=True)

    def _dynamics_of(
        self, joint: JointDescription | BallJointDescription, record: Articulation | None, count: int
    ) -> dict[str, object]:
        """Return the dynamics of a joint: those of its articulation, or those under the joint's last name."""
        if isinstance(joint, BallJointDescription):
            is_only = count == 1
        elif joint.is_independent:
            record = self._owners.get(joint.symbol, record)
            is_only = record is not None and len(record.coordinates) <= 1
        else:
            is_only = count == 1 and record is not None and not record.coordinates
        if record is None:
            return {}
        if is_only:
            return dict(record.dynamics)
        start = f"{joint.name.rpartition('/')[2]}/"
        return {k.removeprefix(start): v for k, v in record.dynamics if k.startswith(start)}

    def _carrier_links(
        self, chains: Mapping[str, MotionChain], independent: set[Symbol], links: list[LinkDescription]
    ) -> Iterator[LinkDescription]:
        """Yield links without body, for coordinates that are the position of no joint yet."""
        frames = TakenNames([*self.model.frames, WORLD])
        used = {s for found in chains.values() for s in _quaternion_coordinates(found)}
        first: dict[Symbol, tuple[str, JointMotion]] = {}
        for name, found in chains.items():
            for motion in found.motions:
                if isinstance(motion, JointMotion):
                    first.setdefault(motion.variable.data, (self.model.frames[name].parent, motion))
        for symbol in self._coordinates:
            if symbol in independent or symbol in used or symbol in self._refused_symbols:
                continue
            parent, is_rotation, axis = links[0].name if links else WORLD, True, (0.0, 0.0, 1.0)
            if symbol in first:
                parent, follower = first[symbol]
                is_rotation, axis = follower.is_rotation, follower.axis
            joint = JointDescription(symbol.path, is_rotation, axis, (0.0, 0.0, 0.0), symbol)
            self.remarks.append(f"'{symbol}' has a link of its own that carries nothing")
            yield LinkDescription(
                frames.take(symbol.path, f"{symbol.path}/carrier"), parent, np.eye(4), [joint]
            )

    def _check_rates(self, chains: Mapping[str, MotionChain]) -> None:
        """Leave out the relations between the speeds of coordinates, except those of quaternions."""
        quaternions = {s for found in chains.values() for s in _quaternion_coordinates(found)}
        driven: dict[str, set[str]] = {}
        for coordinate, row in self._rates.items():
            if coordinate in quaternions:
                continue
            owners = (n for n, r in self.model.articulations.items() if coordinate in r.coordinates)
            owner = next(owners, str(coordinate))
            if owner in self._left_out or str(coordinate) in self._left_out:
                continue
            driven.setdefault(owner, set()).update(map(str, row))
        for owner, speeds in driven.items():
            self.unsupported.leave_out_speeds(
                owner, f"moves by speeds that are not its own, {', '.join(sorted(speeds))}"
            )

    def _add_remarks(self) -> None:
        kept = {name for name, _, _ in read_kept_parts(self.model.data)}
        data = [name for name in self.model.data if name not in kept]
        if data:
            self.remarks.append(f"data are not written: {list_some(data, 4)}")
        elements = describe_elements(self.model.data)
        if elements and not self.capabilities.keeps_urdf_elements:
            self.remarks.append(f"elements of URDF that say nothing of motion are not written: {elements}")
        for name in self._left_out:
            self.remarks.append(f"'{name}' is left out, as asked for")


def _non_loop_articulations(model: ModelView) -> Iterator[tuple[str, Articulation]]:
    for name, record in model.articulations.items():
        if record.kind not in LOOP_KINDS:
            yield name, record


def _quaternion_coordinates(found: MotionChain) -> Iterator[Symbol]:
    for motion in found.motions:
        if isinstance(motion, QuaternionMotion):
            yield from motion.factor.symbols


def _negative(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = axis
    return 0.0 - x, 0.0 - y, 0.0 - z


def _joint_dynamics(record: Articulation | None) -> dict[str, object]:
    """Return the dynamics of a planar or floating joint as a whole; those of its coordinates have a slash."""
    if record is None or record.kind not in ("planar", "floating"):
        return {}
    return {key: value for key, value in record.dynamics if "/" not in key}
