"""Pushing controller: the papers' push (2020, eq. 5-11) with contacts that are touched, held and changed.

Per step the nearest points r on the pusher and p on the object with normal n (from p to r) are numbers, and
so are their derivatives over all speeds. They enter the quadratic program as parameters with gradients::

    d = (r - p)·n                                   eq. 5, gap
    ḋ >= -γ d                                       eq. 6, contact slots
    ∂p/∂q q̇·n <= 0                                  eq. 7, push, never pull
    q → target                                      eq. 8
    tip → w, along the tangent v = (-∇p × n) × n    eq. 9
    -V t <= q̇ <= V t,   t = (d ≺ ε) ∧ ...           eq. 10, 11, still unless touched

The trend of t is a goal, so the robot touches what it has to move. While touching, further rows keep the
prediction honest: the object does not run from the pusher (ḋ <= 0), and r stays where it touched p.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from kineverse._gc import no_collection
from kineverse.control import Command
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.objects import Exclusion
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .push_contact import PushContacts, PushPoint, PushSurface, cross_product, find_alignment, find_push_tool
from .push_program import LOST, NEAR, PRESS, TOUCHING, PushProgram
from .push_scene import find_overlapping_links, furniture_rules, match_bodies

_Contact: TypeAlias = tuple[int, int, Array, Array, Array, float, Array, float]
"""Bodies of robot and object, r, p, normal, gap, velocity of p, alignment."""
_CONE, _CONE_END = math.cos(math.radians(25.0)), math.cos(math.radians(40.0))
_APART = 4e-3
"""Gap between pusher and object away from the contact [m]."""
_FUNNEL = 0.08
"""Largest height of the way to a contact above the surface [m]."""
_STANDOFF = 2e-3
_FAR = 0.05
_SPEED = 0.25
"""Largest speed of the contact point [m/s]."""
_RETREAT = 0.1
"""Distance from the object at which a retreat ends [m]."""
_LOW = 0.03
"""Height of the tip above a contact point from which on the pusher may touch [m]."""
_HOLD_WEIGHT = 10.0
_DISTANCE_COST, _GIVEN_UP_COST = 0.5, 0.6
"""Cost of a contact point by its distance from the tip [1/m], and by the times that it was given up."""
_SURROUNDINGS = 0.1
"""Distance within which other points count as given up, too [m]."""
_LARGEST_DEVIATION = 0.01
_RAMP = 0.02
"""Speed of the contact point beyond the measured one that is tried [m/s]."""
_DEEPEST = 2e-4
_BLOCKED_STEPS = 60
_BLOCKED_WAY = 0.004


@dataclass(frozen=True, slots=True, eq=False)
class PushView:
    """Points and vectors of a push in the world, for drawings (2022 paper, Fig. 6).

    Attributes
    ----------
    p, r
        Nearest points on the object and on the robot (3,) [m].
    n
        Contact normal from p to r.
    push
        Direction -∇p in which p has to move.
    tangent
        Active tangent v, towards places where n opposes the push more.
    target
        Contact point that was chosen (3,) [m].
    distance
        Gap [m]; infinite beyond the radius of queries.
    """

    p: Array
    r: Array
    n: Array
    push: Array
    tangent: Array
    target: Array
    distance: float


class Pushing:
    """Controller that pushes an articulated object to a value of its coordinate.

    Parameters
    ----------
    model
        Model of robot and object.
    what
        The coordinate to change, as symbol or name.
    bodies
        Bodies of the robot that may touch the object, names or patterns: the pusher.
    state
        Present state.
    target
        Wanted value [m], [rad].
    robot
        Prefix of the robot; by default that of the first of ``bodies``.
    object_frames
        Bodies of the object that may be pushed, names or patterns; by default all that the coordinate moves.
    dt
        Time of a step [s].
    still
        Further coordinates that stay still.
    rules, leave_out
        Rules of the collision filter, and excluded bodies, as for :class:`.Scene`.
    logic
        ``"and"`` for the trend rule of :mod:`kineverse.logic`; for comparison ``"product"`` for the product
        rule, and None for no trends.
    deviation
        Standard deviation of the gap if the states are estimates [m]. A contact is then a gap of 1 mm and
        three deviations, or a touch that is reported, and rows give way by as much.

    Attributes
    ----------
    controller
        The controller.
    overlapping
        Rules that except pairs of the robot's own bodies whose shapes overlap at the given state or at every
        one of some random states: hulls of links around a joint.
    coordinate
        The coordinate.
    touching
        Whether the pusher touches where it should.
    touched
        Whether a touch sensor of the pusher reports a touch; set it before each step, if there is one.
    losses
        Number of contacts that were lost.
    blocked
        Number of contact points given up.
    jammed
        Number of those at which the pusher touched, and the object did not move.
    retreating
        Set it to True to take the pusher away from the object.
    contacts
        Number of contact points chosen.
    view
        Points and vectors of the last step.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For unknown names, a coordinate that moves no body, and a target beyond its limits.
    """

    def __init__(
        self,
        model: ModelView,
        what: Symbol | str,
        bodies: str | Iterable[str],
        state: StateLike,
        *,
        target: float,
        robot: str | None = None,
        object_frames: str | Iterable[str] | None = None,
        dt: float = 0.02,
        still: Iterable[Symbol | str] = (),
        rules: Iterable[Rule] = (),
        leave_out: Iterable[Exclusion] = (),
        logic: str | None = "and",
        deviation: float = 0.0,
    ) -> None:
        if logic not in ("and", "product", None):
            raise InvalidValueError(f"logic= is 'and', 'product' or None, not {logic!r}.")
        if not 0.0 <= deviation < _LARGEST_DEVIATION:
            raise InvalidValueError(
                f"deviation= is from 0 to {_LARGEST_DEVIATION:g} m, not {deviation!r}: with a larger one the "
                "pusher cannot tell whether it touches."
            )
        self.model, self.target = model, float(target)
        self.deviation, self._slack = float(deviation), 3.0 * float(deviation)
        self.coordinate = coordinate = model.symbol(what) if isinstance(what, str) else what
        lower, upper = model.limits(coordinate)
        if not lower - 1e-9 <= target <= upper + 1e-9:
            raise InvalidValueError(
                f"'{coordinate}' is between {lower:g} and {upper:g}, so it cannot be pushed to {target:g}."
            )
        self.rules, self.leave_out = tuple(rules), tuple(leave_out)
        plain = Scene(model, rules=self.rules, leave_out=self.leave_out)
        self.pusher = match_bodies(plain.bodies, bodies, "bodies=")
        self.robot = self.pusher[0].split("/")[0] if robot is None else robot
        own = tuple(b for b in plain.bodies if b.startswith(f"{self.robot}/"))
        moved = plain.bodies_moved_by([coordinate])
        self.object_bodies = tuple(b for b in moved if b not in own)
        if not self.object_bodies:
            raise InvalidValueError(f"'{coordinate}' moves no body with a shape, so nothing can be pushed.")
        pushed = self.object_bodies
        if object_frames is not None:
            pushed = match_bodies(pushed, object_frames, "object_frames=")
        at = model.default_state().updated(dict(state))
        self.tool = find_push_tool(model, self.pusher, at, self.leave_out)
        self.surface = PushSurface(
            model,
            coordinate,
            pushed,
            (*own, *self.leave_out),
            at,
            (at[coordinate], (at[coordinate] + target) / 2, target),
        )
        furniture = furniture_rules(plain.bodies, own)
        self.overlapping = find_overlapping_links(plain, own, at)
        self.scene = Scene(
            model, rules=(*furniture, *self.overlapping, *self.rules), leave_out=self.leave_out
        )
        self._program = PushProgram(
            model,
            coordinate,
            self.target,
            self.tool,
            self.scene,
            dt=dt,
            still=still,
            logic=logic,
            slack=self._slack,
        )
        self.controller = self._program.controller
        self.speeds = self.controller.speeds
        self._slots = slots = self.controller.contact_slots
        index = {b: k for k, b in enumerate(self.scene.bodies)}
        pushers = np.array([b in self.pusher for b in index])
        pushed_ones = np.array([b in self.object_bodies for b in index])
        forward = np.outer(pushers, pushed_ones)
        # 1 for pairs of pusher and object, -1 for the other order, 0 for all others.
        self._kinds = forward.astype(np.int8) - forward.T.astype(np.int8)
        self._body_names = tuple(index)
        self._hand = self.scene.bodies.index(self._hand_body())
        self._all = self.scene.watch(f"{self.robot}/*", "*", radius=0.0, moving=self.speeds)
        slots.set_margin(self.pusher, self.object_bodies, _APART)
        self._pressing = False
        self.reset()
        with contextlib.suppress(KineverseError):
            self.step(at)  # what is computed once is computed now
        self.reset()

    def _hand_body(self) -> str:
        """Return a body of the pusher that moves with its frame."""
        motion = FrameDependence(self.model, self.model.speeds)
        own = motion.moving_ancestors(self.tool.frame)
        return next((b for b in self.pusher if motion.moving_ancestors(b) == own), self.pusher[0])

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until everything is compiled, at most for a time [s], and return whether it is."""
        return self.controller.wait(timeout)

    def reset(self) -> None:
        """Forget all contacts."""
        self.controller.reset()
        self.touching, self.losses, self.blocked, self.contacts, self.jammed = False, 0, 0, 0, 0
        self.retreating = self.touched = False
        self._chosen: int | None = None
        self._given_up: dict[int, int] = {}
        self._anchor: tuple[int, Array] | None = None
        self._aside = math.inf
        self._moved = 0.0
        self._value: float | None = None
        self._best, self._since = math.inf, 0
        self._view: tuple[Array, Array, Array, Array, Array, float] | None = None

    # -- the step ------------------------------------------------------------------------------------------

    def done(self, state: State, tolerance: float = 0.02) -> bool:
        """Return True if the coordinate is within a tolerance of the target."""
        return abs(state[self.coordinate] - self.target) < tolerance

    def first_contact(self, state: State) -> str:
        """Return which body of the robot penetrates something at a state; empty if none does."""
        self.scene.update(state)
        found = self._all()
        deep = [pair for pair in found if pair.distance < -_DEEPEST]
        return f"contact of {deep[0].a} and {deep[0].b}" if deep else ""

    @property
    def penetration(self) -> float:
        """Deepest penetration at the last step of pairs that may not touch [m], 0 if there is none."""
        found = self._slots.found
        a, b = found.body_indices.T
        distances = found.distances[self._kinds[a, b] == 0]
        return max(0.0, -float(distances[0])) if len(distances) else 0.0

    def step(self, state: State) -> Command:
        """Return the command for one time step at a state.

        Raises
        ------
        InfeasibleError, NotFiniteError
            As :meth:`.Controller.step`.
        """
        with no_collection():
            return self._step(state)

    def _step(self, state: State) -> Command:
        value = state[self.coordinate]
        self._moved = max(self.surface.sign * (value - self._value), 0.0) if self._value is not None else 0.0
        self._value = value
        found = self._program.load(state)
        tip = self._program.tip(state)
        point = None if self._chosen is None else self.surface.point_at(state, self._chosen)
        if point is not None and not self.retreating and self._is_stuck(state, tip, point):
            self._give_up()
            point = None
        if point is None:
            point = self.choose(state)
        offset = tip - point.point
        offset = offset - point.normal * float(point.normal @ offset)
        self._aside = math.sqrt(float(offset @ offset))
        contact = self._nearest(found)
        if not self.retreating:
            self._update_touching(contact)
        self._write(tip, point, contact)
        return self._program.step()

    def _nearest(self, found: DistanceResults) -> _Contact | None:
        """Return the near pair of pusher and object that pushes best; see :data:`_Contact`."""
        if not len(found):
            return None
        a, b = found.body_indices.T
        kinds = self._kinds[a, b]
        rows = np.flatnonzero(kinds)
        if not len(rows):
            return None
        least = found.distances[rows[0]]
        best = None
        for row in rows[:6].tolist():
            gap = float(found.distances[row])
            if gap > max(least + TOUCHING, PRESS):
                break
            if kinds[row] > 0:
                robot, thing = int(a[row]), int(b[row])
                r, p, normal = found.points_a[row], found.points_b[row], -found.normals[row]
            else:
                robot, thing = int(b[row]), int(a[row])
                r, p, normal = found.points_b[row], found.points_a[row], found.normals[row]
            velocity = self._velocity(thing, p)
            alignment = find_alignment(normal, velocity)
            if best is None or alignment > best[-1]:
                best = (robot, thing, r, p, normal, gap, velocity, alignment)
        return best

    def _velocity(self, body: int, point: Array) -> Array:
        """Return the velocity (3,) of a point of the object per unit of its motion to the target."""
        column = self._slots.point_jacobian(body, point)[:, self._program.object_column]
        return np.asarray(self.surface.sign * column)

    def _update_touching(self, contact: _Contact | None) -> None:
        """Note that the pusher has come to touch, or has lost its contact."""
        if self.touching:
            if contact is None or (contact[5] > LOST + self._slack and not self.touched):
                self.losses += 1
                self._release()
            elif contact[7] < _CONE_END:
                self._give_up()
        elif self._aside < 2 * NEAR and contact is not None and contact[5] < TOUCHING and contact[7] > _CONE:
            self.touching = True
            self._best, self._since = math.inf, 0
            self._anchor = None

    def _release(self) -> None:
        self.touching, self._anchor = False, None
        self._best, self._since = math.inf, 0

    def _give_up(self) -> None:
        """Leave the present contact point for another one."""
        self.jammed += self.touching
        if self._chosen is not None:
            self._given_up[self._chosen] = self._given_up.get(self._chosen, 0) + 1
            self.blocked += 1
        self._chosen = None
        self._release()

    def rank(self, state: State, limit: float = 0.1) -> list[int]:
        """Return contact points at a state, the best first, each some distance from better ones [m]."""
        points = self.surface.at(state)
        tip = self._program.tip(state)
        score = self.score(points) - _DISTANCE_COST * np.sqrt(((points.points - tip) ** 2).sum(axis=1))
        for k, times in self._given_up.items():
            near = ((points.points - points.points[k]) ** 2).sum(axis=1) < _SURROUNDINGS**2
            score = score - np.where(near, _GIVEN_UP_COST * times, 0.0)
        ranked: list[int] = []
        while score.max() > -math.inf:
            best = int(np.argmax(score))
            ranked.append(best)
            near = ((points.points - points.points[best]) ** 2).sum(axis=1) < limit**2
            score = np.where(near, -math.inf, score)
        return ranked

    def choose(self, state: State, index: int | None = None) -> PushPoint:
        """Choose a contact point, by default the best, and return it."""
        self._chosen = self.rank(state, math.inf)[0] if index is None else index
        self.contacts += 1
        self._best, self._since = math.inf, 0
        return self.surface.point_at(state, self._chosen)

    def score(self, points: PushContacts) -> Array:
        """Return how well the object can be pushed at each point (N,)."""
        inside = points.alignment > _CONE
        return np.asarray(
            np.where(inside, 0.0, -3.0)
            + points.alignment
            + np.minimum(points.leverage, 0.8)
            + 0.7 * self.surface.room
        )

    def _is_stuck(self, state: State, tip: Array, point: PushPoint) -> bool:
        """Return True without progress for a while, or if the push has left the cone of the contact point."""
        if self.touching:
            rest = abs(state[self.coordinate] - self.target)
        else:
            if point.alignment < _CONE_END:
                return True
            offset = point.point - tip
            rest = math.sqrt(float(offset @ offset))
        if rest < self._best - _BLOCKED_WAY:
            self._best, self._since = rest, 0
        else:
            self._since += 1
        return self._since > _BLOCKED_STEPS

    def _write(self, tip: Array, point: PushPoint, contact: _Contact | None) -> None:
        """Set the parameters of the program."""
        c, m, velocity = point.point, point.normal, point.velocity
        near, height = self._aside < NEAR and not self.retreating, float((tip - c) @ m)
        standoff = _STANDOFF if near else min(_FUNNEL, _STANDOFF + 1.5 * max(self._aside - NEAR, 0.0))
        if self.retreating:
            self.touching, standoff = False, _RETREAT
        self._program.set("target", c + standoff * m)
        self._program.set("normal", m)
        self._program.set("facing", -m)
        leverage = max(math.sqrt(float(velocity @ velocity)), 1e-3)
        # An object that does not give way is not pushed further than a ramp of speed leads in a step.
        self._program.set("pace", min(_SPEED, self._moved * leverage / self.controller.dt + _RAMP) / leverage)
        self._press(self.touching or (near and height < _LOW))
        self._program.set("reach", 0.0 if self.touching else 1.0)
        self._program.set("touch", 0.0 if self.touching or self.retreating else 1.0)
        self._program.set("hold", _HOLD_WEIGHT if self.touching else 0.0)
        self._program.set("engaged", float(self.touching))
        distance, r, p, normal = math.inf, tip, c, m
        if contact is None:
            for name in ("relative", "slip", "pushed"):
                self._program.set(name, 0.0)
            self._program.set("gap", _FAR)
        else:
            robot, thing, r, p, normal, distance, velocity, _ = contact
            across, up = _tangents(normal)
            slots = self._slots
            J = slots.point_jacobian(thing, p)
            relative = np.empty((3, len(self.speeds)))
            relative[0] = normal @ (slots.point_jacobian(robot, r) - J)
            tangents = np.array([across, up])
            relative[1:] = tangents @ (
                slots.point_jacobian(self._hand, tip) - slots.point_jacobian(thing, tip)
            )
            self._program.set("relative", relative[:, self._program.columns].ravel())
            self._program.set("gap", distance)
            self._program.set("pushed", float(normal @ J[:, self._program.object_column]))
            self._program.set("slip", tangents @ self._drift(thing, tip))
        self._view = (r, p, normal, velocity, c, distance)

    @property
    def view(self) -> PushView | None:
        """Points and vectors of the last step; None before the first."""
        if self._view is None:
            return None
        r, p, normal, velocity, c, distance = self._view
        push = velocity / max(math.sqrt(float(velocity @ velocity)), 1e-9)
        return PushView(p, r, normal, push, cross_product(cross_product(push, normal), normal), c, distance)

    def _drift(self, thing: int, tip: Array) -> Array:
        """Return how far the tip has moved on the object since the first touch, (3,) [m]."""
        pose = self.scene.pose(self._body_names[thing])
        if not self.touching:
            self._anchor = None
            return np.zeros(3)
        if self._anchor is None or self._anchor[0] != thing:
            self._anchor = (thing, pose[:3, :3].T @ (tip - pose[:3, 3]))
        return np.asarray(tip - pose[:3, :3] @ self._anchor[1] - pose[:3, 3])

    def _press(self, pressing: bool) -> None:
        """Let the pusher touch the object, or keep it away."""
        if pressing != self._pressing:
            self._pressing = pressing
            self._slots.set_margin(
                self.pusher, self.object_bodies, -PRESS - self._slack if pressing else _APART
            )


def _tangents(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors that are orthogonal to a normal and to each other."""
    across = cross_product(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= math.sqrt(float(across @ across))
    return across, cross_product(normal, across)
