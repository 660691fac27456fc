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
from collections.abc import Callable, Iterable

import numpy as np

from kineverse._runtime import no_collection
from kineverse.control import Command
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.geometry import Scene
from kineverse.lie import Array
from kineverse.manipulation.collision_rules import find_overlapping_links, furniture_rules, match_bodies
from kineverse.manipulation.swept_volume import Obstacle, find_obstacle
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol
from kineverse.worlds import Observation, PlannedContact, Robot

from .contact_selection import (
    CONE,
    CONE_END,
    ContactSelection,
    PushPoint,
    PushSurface,
    find_push_tool,
)
from .guarded_contact import STOPPED, PushPress, TipAnchor
from .push_program import (
    LOST,
    NEAR,
    PRESS,
    TOUCHING,
    ContactRates,
    PairFinder,
    PushNumbers,
    PushPair,
    PushProgram,
)
from .vectors import ZERO, Vector, add, cross_product, inner_product, length, move_point, scale, subtract

_APART = 4e-3  # gap between pusher and object away from the contact [m]
_FUNNEL = 0.08  # largest height of the path to a contact above the surface [m]
_STANDOFF = 2e-3
_FAR = 0.05
_RETREAT = 0.1  # distance from the object at which a retreat ends [m]
_LOW = 0.03  # height of the tip above a contact point from which on the pusher may touch [m]
_HOLD_WEIGHT = 10.0
_LARGEST_DEVIATION = 0.01
_LEAST_DEVIATION = 1e-5  # deviation below which gaps count as exact [m]
_JAMMED = 2.0  # depth at which the object counts as not giving way, in depths of the press
_DEEPEST = 2e-4


class Pushing:
    """Controller that pushes an articulated object to a value of its coordinate.

    Parameters
    ----------
    model
        Model of robot and object.
    robot
        The robot, or the prefix of its names.
    what
        The coordinate to change, as symbol or name.
    bodies
        Bodies of the robot that may touch the object, names or patterns: the pusher.
    state
        State in which the surface of the object is sampled, from there to the target.
    target
        Wanted value [m], [rad].
    dt
        Time of a step [s].
    fixed
        Further coordinates that stay fixed.
    logic
        ``"and"`` for the trend rule of :mod:`kineverse.logic`; for comparison ``"product"`` for the product
        rule, and None for no trends.

    Attributes
    ----------
    overlapping
        Rules that except pairs of the robot's own bodies whose shapes overlap at the given state or at every
        one of some random states: hulls of links around a joint.
    touching, losses
        Whether the pusher touches where it should, and number of contacts that were lost.
    retreating
        Set it to True to take the pusher away from the object.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For unknown names, a coordinate that moves no body, and a target beyond its limits.

    See Also
    --------
    kineverse.manipulation.push
    """

    def __init__(
        self,
        model: ModelView,
        robot: Robot | str,
        what: Symbol | str,
        bodies: str | Iterable[str],
        state: StateLike,
        *,
        target: float,
        dt: float = 0.02,
        fixed: Iterable[Symbol | str] = (),
        logic: str | None = "and",
    ) -> None:
        if logic not in ("and", "product", None):
            raise InvalidValueError(f"logic= is 'and', 'product' or None, not {logic!r}.")
        self.model, self.robot, self.target = model, Robot.of(model, robot), float(target)
        self.coordinate = coordinate = model.symbol(what) if isinstance(what, str) else what
        self._limits = lower, upper = model.limits(coordinate)
        if not lower - 1e-9 <= target <= upper + 1e-9:
            raise InvalidValueError(
                f"'{coordinate}' is between {lower:g} and {upper:g}, so it cannot be pushed to {target:g}."
            )
        plain = Scene.of(model)
        self.pusher = match_bodies(plain.bodies, bodies, "bodies=")
        robot_bodies = tuple(b for b in plain.bodies if self.robot.owns(b))
        moved = plain.bodies_moved_by([coordinate])
        self.object_bodies = tuple(b for b in moved if not self.robot.owns(b))
        if not self.object_bodies:
            raise InvalidValueError(f"'{coordinate}' moves no body with a shape, so nothing can be pushed.")
        at = model.default_state().updated(dict(state))
        self.tool = find_push_tool(model, self.pusher, at)
        self.surface = PushSurface(
            model,
            coordinate,
            self.object_bodies,
            robot_bodies,
            at,
            (at[coordinate], (at[coordinate] + target) / 2, target),
            self.tool.locate_tip(model),
        )
        furniture = furniture_rules(plain.bodies, robot_bodies)
        self.overlapping = find_overlapping_links(plain, robot_bodies, at)
        self.scene = Scene(model, rules=(*furniture, *self.overlapping))
        self._program = PushProgram(
            model, coordinate, self.target, self.tool, self.scene, dt=dt, fixed=fixed, logic=logic
        )
        self.controller = self._program.controller
        self.speeds = self.controller.speeds
        self._slots = slots = self.controller.contact_slots
        self._pairs = PairFinder(
            self.scene.bodies,
            self.pusher,
            self.object_bodies,
            slots,
            self._program.object_column,
            self.surface.sign,
        )
        self._hand = self.scene.bodies.index(self._hand_body())
        self._rates = ContactRates(slots, self._program.columns, self._hand)
        self._all = self.scene.watch(robot_bodies, "*", radius=0.0, moving=self.speeds)
        self._swept: tuple[tuple[float, ...], Obstacle | None] = (), None
        self.choice = ContactSelection(self.surface)
        self.press = PushPress(dt, self.surface.sign)
        self.reset()
        with contextlib.suppress(KineverseError):
            self.step(at)  # what is computed once is computed now
        self.reset()

    def _hand_body(self) -> str:
        motion = FrameDependence(self.model, self.model.speeds)
        own = motion.moving_ancestors(self.tool.frame)
        return next((b for b in self.pusher if motion.moving_ancestors(b) == own), self.pusher[0])

    def reset(self) -> None:
        """Forget all contacts."""
        self.controller.reset()
        self.choice.reset()
        self.press.reset()
        self.press.deviation = 0.0
        self.touching, self.losses, self.retreating = False, 0, False
        self._anchor = TipAnchor()
        self._aside = math.inf
        self._margin = math.nan
        self.clearance = math.inf  # least distance at the last step of pairs that may not touch [m]
        self._contact: PushPair | None = None
        self._stamp: float | None = None  # time of the last step [s]

    def first_contact(self, state: State) -> str:
        """Return which body of the robot penetrates something at a state; empty if none does."""
        self.scene.update(state)
        result = self._all()
        deep = [pair for pair in result if pair.distance < -_DEEPEST]
        return f"contact of {deep[0].a} and {deep[0].b}" if deep else ""

    def find_obstacle(self, state: State) -> Obstacle | None:
        """Return the first thing in the way of the object to its target; None if the path is free."""
        others = tuple(v for s, v in state.items() if not self.robot.moves(s))
        if others != self._swept[0]:  # roll-outs begin where the object is, with the robot elsewhere
            result = find_obstacle(self.model, self.coordinate, state, self.target, robot=self.robot)
            self._swept = others, result
        return self._swept[1]

    def find_deviation(self, state: State, deviation: Callable[[Symbol], float]) -> float:
        """Return the standard deviation of gaps [m] at a state, by those of its coordinates [m], [rad]."""
        symbols, jacobian = self._program.tip_jacobian(state)
        normal = velocity = ZERO
        if self.choice.chosen is not None:
            _, point = self.surface.locate(state, self.choice.chosen)
            normal, velocity = point.normal, point.velocity
        rates = dict(zip(symbols, (np.array(normal) @ jacobian).tolist(), strict=True))
        rates[self.coordinate] = inner_product(normal, velocity)
        # The deviation of what was never seen is infinite, and counts only where it changes the gap.
        return math.hypot(*(rate * deviation(s) for s, rate in rates.items() if rate))

    def step(self, state: State, observation: Observation | None = None, deviation: float = 0.0) -> Command:
        """Return the command for one time step at a state, or an estimate with the deviation of its gaps [m].

        An estimate comes with the readings of encoders and touch sensors.
        """
        with no_collection():
            return self._step(state, deviation, observation)

    def _step(self, state: State, deviation: float, observation: Observation | None) -> Command:
        press, choice = self.press, self.choice
        press.deviation = min(deviation, _LARGEST_DEVIATION) if deviation > _LEAST_DEVIATION else 0.0
        senses = press.deviation > 0.0
        read = None if observation is None else observation.joints
        touched = senses and observation is not None and not observation.touching.isdisjoint(self.pusher)
        tip, point = self._locate(state)
        felt = tip if read is None else self._program.tip(state, read)
        value = press.advance(
            state[self.coordinate], felt, self.touching, touched=touched, passed=self._count_time(state)
        )
        if senses:
            state = state.updated({self.coordinate: min(max(value, self._limits[0]), self._limits[1])})
            tip, point = self._locate(state)
        contact, self.clearance = self._pairs.nearest(self._program.load(state))
        if point is not None and not self.retreating and self._is_stuck(state, tip, point):
            reaches = self.touching or point.alignment < CONE_END
            self._give_up(ZERO if reaches else subtract(point.point, tip))
            point = None
        if point is None:
            point = choice.choose(state, tip)
        offset = subtract(tip, point.point)
        self._aside = length(add(offset, point.normal, -inner_product(point.normal, offset)))
        if not self.retreating:
            self._update_touching(contact)
        command = self._program.step(*self._numbers(tip, point, contact))
        moved: list[float] = (self._slots.twist(self._hand) @ command.vector).tolist()
        press.plan(point.velocity, move_point(moved, tip))
        self._contact = contact
        return command

    def _count_time(self, state: State) -> float:
        """Return the time since the last step [s]; after a stop, speeds grow from 0 again."""
        dt, before, self._stamp = self.controller.dt, self._stamp, state.stamp
        passed = dt if before is None or state.stamp is None else state.stamp - before
        if passed >= STOPPED * dt:
            self.controller.reset()
        return passed if passed > 0.0 else dt

    def _locate(self, state: State) -> tuple[Vector, PushPoint | None]:
        chosen = self.choice.chosen
        tip, point = self.surface.locate(state, chosen or 0)
        return tip, None if chosen is None else point

    def _update_touching(self, contact: PushPair | None) -> None:
        """Note that the pusher has come to touch, or has lost its contact."""
        press = self.press
        if self.touching:
            if contact is None or (contact.gap > LOST + press.slack and not press.touched):
                self.losses += 1
                self._release()
            elif contact.alignment < CONE_END:
                self._give_up(ZERO)
        elif self._aside < 2 * NEAR and contact is not None and contact.alignment > CONE:
            certain = press.deviation == 0.0 or press.certain
            if contact.gap < (TOUCHING if certain else TOUCHING + press.slack) and (certain or press.touched):
                self.touching = True
                self.choice.restart()
                self._anchor = TipAnchor()
        if contact is not None:
            press.correct(contact.gap, -inner_product(contact.normal, contact.velocity) * self.surface.sign)

    def _release(self) -> None:
        self.touching = False
        self.choice.restart()

    def _give_up(self, rest: Vector) -> None:
        """Leave the present contact point, to which a vector from the tip is left, for another one."""
        self.choice.give_up(self.touching, rest)
        self._release()

    def rank(self, state: State, limit: float = 0.1) -> list[int]:
        """Return contact points at a state, the best first, each some distance from better ones [m]."""
        return self.choice.rank(state, self._program.tip(state), limit)

    def choose(self, state: State, index: int | None = None) -> PushPoint:
        """Choose a contact point, by default the best, and return it."""
        return self.choice.choose(state, self._program.tip(state), index)

    def _is_stuck(self, state: State, tip: Vector, point: PushPoint) -> bool:
        """Return True without progress, outside of the contact point's cone, or if the robot gets pinched."""
        if self.touching:
            if self.clearance < -self.press.slack:
                return True
            rest = abs(state[self.coordinate] - self.target)
        else:
            if point.alignment < CONE_END:
                return True
            rest = length(subtract(point.point, tip))
        return self.choice.is_stuck(rest)

    def _numbers(
        self, tip: Vector, point: PushPoint, contact: PushPair | None
    ) -> tuple[PushNumbers, Array | None]:
        c, m, press = point.point, point.normal, self.press
        near, height = self._aside < NEAR and not self.retreating, inner_product(subtract(tip, c), m)
        standoff = _STANDOFF
        if not near:
            standoff = min(_FUNNEL, _STANDOFF + press.slack + 1.5 * max(self._aside - NEAR, 0.0))
        if self.retreating:
            self.touching, standoff = False, _RETREAT
        self._keep_apart(contact, self.touching or (near and height < _LOW + press.slack))
        numbers = PushNumbers(
            gap=_FAR,
            slip=(0.0, 0.0),
            pushed=0.0,
            target=add(c, m, standoff),
            facing=scale(-1.0, m),
            normal=m,
            reach=0.0 if self.touching else 1.0,
            touch=0.0 if self.touching or self.retreating else 1.0,
            hold=_HOLD_WEIGHT if self.touching else 0.0,
            engaged=float(self.touching),
            # The pusher goes on until it touches: where the object is believed to be, there may be none.
            near=TOUCHING if press.deviation == 0.0 else -1.0,
            pace=press.pace() / max(length(point.velocity), 1e-3),
            free=0.0,
        )
        return numbers, None if contact is None else self._add_contact(numbers, contact, tip)

    def _add_contact(self, numbers: PushNumbers, contact: PushPair, tip: Vector) -> Array:
        press, thing = self.press, contact.thing
        allowed = -_JAMMED * press.depth - press.slack < contact.gap < LOST + press.slack
        numbers.free = float(self.touching and allowed)
        # A press that is late enough is not increased by the goal about the gap either.
        most = -PRESS * (1.0 - min(max(press.reserve, 0.0), 1.0))
        deeper = press.depth - PRESS
        numbers.gap = most if press.touched and self.touching else contact.gap + deeper
        numbers.pushed = inner_product(contact.normal, contact.velocity) * self.surface.sign
        drift = self._anchor.drift(thing, self._fixed_to(thing), tip, press.weight)
        one, other = tangents = contact.tangents
        numbers.slip = inner_product(one, drift), inner_product(other, drift)
        return self._rates(contact, tangents, tip)

    def _fixed_to(self, thing: int) -> list[list[float]]:
        """Return the pose (3, 4) of a shape of a body."""
        world = self.scene.collision_world
        pose: list[list[float]] = world.table.poses[world.members[thing][0]].tolist()
        return pose

    @property
    def gap(self) -> float:
        """Distance of pusher and object at the last step [m]; infinite if they are far apart."""
        return math.inf if self._contact is None else self._contact.gap

    @property
    def contact(self) -> PlannedContact:
        """The bodies that the push brings together."""
        return PlannedContact(self.pusher, self.object_bodies, self.touching)

    @property
    def vectors(self) -> dict[str, tuple[Array, Array]]:
        """Vectors at the last step by name, each with its origin, for drawings (2022 paper, Fig. 6).

        The nearest point p of the object is the origin of all: of the normal n, of the direction -∇p of the
        push, of the active tangent, and of ``r - p`` to the nearest point of the pusher. There are none where
        the pusher is far away.
        """
        if (contact := self._contact) is None:
            return {}
        n, push = contact.normal, scale(1.0 / max(length(contact.velocity), 1e-9), contact.velocity)
        tangent = cross_product(cross_product(push, n), n)
        named = {"n": n, "push": push, "tangent": tangent, "r - p": subtract(contact.r, contact.p)}
        return {name: (np.array(contact.p), np.array(vector)) for name, vector in named.items()}

    def _keep_apart(self, contact: PushPair | None, pressing: bool) -> None:
        """Set the distance of pusher and object: of both apart, or of a pusher that feels for the object."""
        margin = _APART + self.press.slack
        if pressing:
            gap = math.inf if contact is None else contact.gap
            margin = self.press.margin(gap, self.touching, self._slots.gain)
        if margin != self._margin:
            self._margin = margin
            self._slots.set_margin(self.pusher, self.object_bodies, margin)
