"""Quadratic program of pushes (2020 paper, eq. 5-11), and the pair of bodies in contact that enters it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Command, Controller, Goal, Keep, Target
from kineverse.control.contact_constraints import ContactSlots
from kineverse.control.formulation import find_speeds
from kineverse.control.tasks import Task
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.functions import sqrt
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.logic import less
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .contact_selection import PushTool, find_alignment
from .vectors import Vector, move_point, scale

TOUCHING = 1e-3  # largest gap of a contact [m]
LOST = 3e-3  # gap at which a contact is lost [m]
PRESS = 2e-4  # depth that rows of touching bodies allow, so that contact is kept [m]
NEAR = 0.012  # distance of the tip from the axis of a contact within which it approaches the surface [m]
_REACH_SPEED = 0.5  # largest speed of the tip on its way to a contact [m/s]
_TOUCH_SPEED = 0.15  # rate at which the trend of contact is followed [m/s]
_SPIN_WEIGHT = 0.01  # against turns of the pusher about its axis, which change nothing but nearest points
_MARGIN, _RADIUS = 5e-3, 0.035  # distance that pairs which may not touch keep, and from which they count [m]
_MOST_PAIRS = 6
_SMOOTH = 0.02
_ANY = 1e3  # speed that restricts nothing
_SIZES = {
    "gap": 1, "slip": 2, "pushed": 1, "target": 3, "facing": 3, "normal": 3, "reach": 1, "touch": 1,
    "hold": 1, "engaged": 1, "near": 1, "pace": 1, "free": 1,
}  # fmt: skip
"""Number of parameters of each number of a contact, in the order of :attr:`PushNumbers.listed`."""


@dataclass(slots=True)
class PushNumbers:
    """Parameters of a push program at the present contact."""

    gap: float  # distance of pusher and object [m]
    slip: Sequence[float]  # how far the tip has moved along both tangents since it touched [m]
    pushed: float  # derivative of the gap over the object's speed
    target: Vector  # contact point [m], direction of the push, and outward normal
    facing: Vector
    normal: Vector
    reach: float  # weight of the goal that moves the tip to the contact point
    touch: float  # weight of the trend towards a contact
    hold: float  # weight of the goals that keep a contact
    engaged: float  # 1 while the pusher touches, else 0
    near: float  # gap from which on the pusher touches [m]
    pace: float  # largest speed of the coordinate [m/s], [rad/s]
    free: float  # 1 if the object may move, else 0

    @property
    def listed(self) -> list[float]:
        """All numbers, one after the other."""
        return [
            self.gap, *self.slip, self.pushed, *self.target, *self.facing, *self.normal, self.reach,
            self.touch, self.hold, self.engaged, self.near, self.pace, self.free,
        ]  # fmt: skip


class PushProgram:
    """Controller of a push, whose tasks depend on the numbers of the present contact."""

    def __init__(
        self,
        model: ModelView,
        coordinate: Symbol,
        target_value: float,
        tool: PushTool,
        scene: Scene,
        *,
        dt: float,
        fixed: Iterable[Symbol | str],
        logic: str | None,
    ) -> None:
        fixed = tuple(fixed)
        speed = coordinate.derivative()
        tip, axis = tool.locate_tip(model), tool.point_axis(model)
        resting = find_speeds(model, fixed, "fixed")
        moving = set(model.rates.over_free_speeds(tip.gradient())) - resting - {speed}
        speeds = [*sorted(moving, key=lambda s: s.sort_key), speed]

        numbers = {name: Target(f"push/{name}", np.zeros(size)) for name, size in _SIZES.items()}
        one = {name: number.parameters[0] for name, number in numbers.items()}
        target, facing, normal = (numbers[name].expression for name in ("target", "facing", "normal"))
        rates = Target("push/rate", np.zeros((3, len(speeds))))
        relative = rates.expression
        d = one["gap"].with_gradient({s: relative[0, k] for k, s in enumerate(speeds)})
        slips = array(
            [
                e.with_gradient({s: relative[i + 1, k] for k, s in enumerate(speeds)})
                for i, e in enumerate(numbers["slip"].parameters)
            ]
        )
        offset = tip - target
        lateral = offset - normal * (normal @ offset)
        aside = sqrt(lateral @ lateral + 1e-8)
        touched = less(d, one["near"])
        aligned = less(aside, NEAR)
        v = as_expression(speed)
        ḋ = sum((relative[0, k] * s for k, s in enumerate(speeds)), as_expression(0.0))
        twist = model.jacobian(tool.frame, form="world", symbols=speeds)
        turn = twist[3:] @ array(speeds)
        most = _ANY * one["free"]
        far = _ANY * (1 - one["engaged"])
        tasks: list[Task] = [
            Goal(coordinate, target_value, name="object", gain=4.0, speed=one["pace"]),
            Goal(tip, target, name="reach", gain=3.0, speed=_REACH_SPEED, weight=one["reach"]),
            Goal(slips, 0.0, name="no slip", gain=5.0, weight=one["hold"]),
            Goal(d, -PRESS, name="press", gain=10.0, weight=one["hold"]),
            Keep(-most, v, most, name="still unless touched"),
            Keep(-math.inf, one["pushed"] * v, far, name="push, never pull"),
            Keep(-math.inf, ḋ, far, name="object does not run away"),
        ]
        if axis.gradient():  # the pusher of a gantry keeps its direction
            tasks.append(Goal(axis, facing, name="facing", gain=2.0, speed=1.0, weight=0.05))
        if (axis @ turn).gradient():
            tasks.append(Goal(axis @ turn, 0.0, name="no spin", weight=_SPIN_WEIGHT))
        truth: Expression | None = None
        if logic == "and":
            truth = touched & aligned
        elif logic == "product":
            truth = touched * aligned
        if truth is not None:
            tasks.append(Goal(truth, 1.0, name="touch", gain=_TOUCH_SPEED, weight=one["touch"]))
        self.controller = Controller(
            model,
            tasks,
            dt=dt,
            fixed=fixed,
            scene=scene,
            margin=_MARGIN,
            radius=_RADIUS,
            smooth=_SMOOTH,
            contacts=24,
        )
        order = self.controller.speeds
        self.columns = [order.index(s) for s in speeds]
        self.object_column = order.index(speed)
        place = {s: k for k, s in enumerate(self.controller.inputs)}
        self._values = np.array([s.value or 0.0 for s in self.controller.inputs])
        self._coordinates = tuple(s for s in self.controller.inputs if s.value is None)
        # Parameters are kept in one vector, and without trends some of them serve nothing.
        every = [symbol for number in (*numbers.values(), rates) for symbol in number.parameters]
        self._numbers, self._first_rate = np.zeros(len(every)), len(every) - len(rates.parameters)
        self._used = np.array([k for k, s in enumerate(every) if s in place], dtype=np.intp)
        self._places = np.array([place[every[k]] for k in self._used], dtype=np.intp)
        self._tip_symbols = tuple(s for s in tip.symbols if not s.order)
        self._tip_function = compile([tip, tip.jacobian(self._tip_symbols)])
        self._tip = self._tip_function.bind()

    def load(self, state: State) -> DistanceResults:
        """Take a state, and return the near pairs of bodies."""
        self._values[: len(self._coordinates)] = state.vector(self._coordinates)
        return self.controller.query_contacts(self._values)

    def step(self, numbers: PushNumbers, rates: Array | None) -> Command:
        """Return the command for one time step, at the state that was loaded."""
        self._numbers[: self._first_rate] = numbers.listed
        self._numbers[self._first_rate :] = 0.0 if rates is None else rates
        self._values[self._places] = self._numbers[self._used]
        return self.controller.step(self._values)

    def tip(self, state: State, read: Mapping[Symbol, float] | None = None) -> Vector:
        """Return the foremost point of the pusher at a state, or at readings of encoders [m]."""
        inputs = self._tip_function.inputs
        if read is None:
            self._tip.input[:] = state.vector(inputs)
        else:
            self._tip.input[:] = [read[s] if s in read else state[s] for s in inputs]
        self._tip()
        x, y, z = self._tip.outputs[0].tolist()
        return x, y, z

    def tip_jacobian(self, state: State) -> tuple[tuple[Symbol, ...], Array]:
        """Return the coordinates of the tip, and its derivatives (3, n) over them."""
        self._tip.input[:] = state.vector(self._tip_function.inputs)
        self._tip()
        return self._tip_symbols, np.array(self._tip.outputs[1])


class PushPair(NamedTuple):
    """Body of a pusher and body of an object that are near each other."""

    robot: int  # indices of the bodies in the scene
    thing: int
    r: Vector  # nearest points on the robot and on the object [m]
    p: Vector
    normal: Vector  # unit vector from p to r
    gap: float  # distance [m]
    velocity: Vector  # velocity of p per unit of the object's motion to the target
    alignment: float  # cosine between the velocity and -normal

    @property
    def tangents(self) -> tuple[Vector, Vector]:
        """Two unit vectors that are orthogonal to the normal and to each other.

        They may turn about the normal between two steps: both count alike. Duff et al., "Building an
        Orthonormal Basis, Revisited" (2017).
        """
        x, y, z = self.normal
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = a * x * y
        return (1.0 + sign * a * x * x, sign * b, -sign * x), (b, sign + a * y * y, -y)


class ContactRates:
    """Derivatives of a contact over speeds: of the gap, and of the motion of a tip on the object.

    They follow from the twists of the touching body, of the object and of the hand, by one compiled function.
    """

    def __init__(self, slots: ContactSlots, columns: Sequence[int], hand: int) -> None:
        self._slots, self._hand = slots, hand
        twists = Target("push/twist", np.zeros((3, *slots.twist(hand).shape)))
        vectors = Target("push/vector", np.zeros((6, 3)))
        r, p, normal, tip, *tangents = vectors.expression
        robot, thing, carrier = (twist[:, list(columns)] for twist in twists.expression)
        rows = [_along(normal, r, robot) - _along(normal, p, thing)]
        rows += [_along(t, tip, carrier) - _along(t, tip, thing) for t in tangents]
        self._first = len(twists.parameters)
        inputs = (*twists.parameters, *vectors.parameters)
        self._rows = compile([array([e for row in rows for e in row])], inputs).bind()

    def __call__(self, contact: PushPair, tangents: tuple[Vector, Vector], tip: Vector) -> Array:
        """Return the derivatives (3 n) of the gap, and of the motion along both tangents.

        The array is overwritten by the next call.
        """
        rows, first = self._rows, self._first
        rows.input[:first] = self._slots.twists([contact.robot, contact.thing, self._hand]).ravel()
        one, other = tangents
        rows.input[first:] = [*contact.r, *contact.p, *contact.normal, *tip, *one, *other]
        rows()
        return np.asarray(rows.outputs[0])


def _along(direction: Expression, point: Expression, twist: Expression) -> Expression:
    """Return the speeds (n,) along a direction of a point of a body with a twist (6, n)."""
    return direction @ twist[:3] + np.cross(point, direction) @ twist[3:]


class PairFinder:
    """Search of the near pair of pusher and object that pushes best, and of the nearest other pair."""

    def __init__(
        self,
        bodies: Sequence[str],
        pusher: Collection[str],
        object_bodies: Collection[str],
        slots: ContactSlots,
        column: int,
        sign: float,
    ) -> None:
        pushers = np.array([b in pusher for b in bodies])
        pushed = np.array([b in object_bodies for b in bodies])
        forward = np.outer(pushers, pushed)
        # 1 for pairs of pusher and object, -1 for the other order, 0 for all others.
        kinds = forward.astype(np.int8) - forward.T.astype(np.int8)
        self._kinds: list[list[int]] = kinds.tolist()
        self._slots, self._column, self._sign = slots, column, sign

    def nearest(self, found: DistanceResults) -> tuple[PushPair | None, float]:
        """Return the pair that pushes best, and the clearance."""
        best, clearance = None, math.inf
        most, count = math.inf, 0
        gaps = found.distances.tolist()
        for row, (a, b) in enumerate(found.body_indices.tolist()):
            kind, gap = self._kinds[a][b], gaps[row]
            if not kind:
                clearance = min(clearance, gap)
            elif gap <= most and count < _MOST_PAIRS:
                if not count:
                    most = max(gap + TOUCHING, PRESS)
                count += 1
                pair = self._make_pair(found, row, gap, kind < 0)
                if best is None or pair.alignment > best.alignment:
                    best = pair
            if clearance < math.inf and gap > most:
                break
        return best, clearance

    def _make_pair(self, found: DistanceResults, row: int, gap: float, swapped: bool) -> PushPair:
        robot, thing = found.body_indices[row].tolist()
        a, b, c, d, e, f, u, v, w = found.witnesses[row].tolist()
        r, p, n = (a, b, c), (d, e, f), (-u, -v, -w)
        if swapped:
            robot, thing, r, p, n = thing, robot, p, r, (u, v, w)
        twist = self._slots.twist(thing)[:, self._column].tolist()
        velocity = scale(self._sign, move_point(twist, p))
        return PushPair(robot, thing, r, p, n, gap, velocity, find_alignment(n, velocity))
