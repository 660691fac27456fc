"""Metrics of a run in the true states of a simulated world, independent of the skill and of its belief.

- *limit violation*: largest excess of any constraint of the model. Positions are those of the states, speeds
  are differences of successive states by time; commanded speeds stand in where no coordinate is the integral
  of a speed. A limit of a speed that depends on the state, such as a lock, is violated if it was at the
  begin and at the end of a step.
- *penetration*: largest depth of any pair of bodies, furniture among itself included, but for the excepted
  pairs, which are listed. Of furniture that overlapped at the start, it is the depth beyond what is allowed
  by :class:`.FurnitureOverlaps`.
- *overlap*: a penetration beyond 0.5 mm that came on the way.
- *contact losses*: number of times that the robot touched the object and then did not, while the skill
  believed that it touches.
- *grasp error*: largest motion of the held body in the hand since the hold began, in the middle between the
  fingers.
- *jitter*: root mean square over time of the norm of the second differences of commanded speeds,
  ``|u_k - 2 u_{k-1} + u_{k-2}|``. That is the jerk times the squared period; integrated squared jerk is the
  usual measure of smoothness (Flash & Hogan 1985).
- *reversals*: sign changes of commanded speeds beyond 5 mm/s or mrad/s, by time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.geometry import Rule, Scene
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array, inverse, rotation_angle
from kineverse.model.frame import WORLD
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .furniture_overlaps import OVERLAP, FurnitureOverlaps
from .robot_interface import PlannedContact, SkillStep
from .simulated_world import SimulatedWorld

CONTACT_GAP = 1e-3  # largest gap of a contact of a push [m]

_STILL = 5e-3
_ROUNDING = 1e-9  # depth that is nothing but rounding [m]
_TOUCHING = 1e-6  # depth up to which links of a robot touch and do not overlap [m]


class RunOverlap(NamedTuple):
    """Overlap that came in a run.

    See Also
    --------
    kineverse.manipulation.open_object
    """

    a: str  # names of the bodies
    b: str
    depth: float  # largest depth [m]
    value: float  # value of the measured coordinate at which it came [m], [rad]; NaN without a coordinate
    time: float  # stamp of the state in which it came [s]

    def __str__(self) -> str:
        where = "" if math.isnan(self.value) else f", from {self.value:.3f} on"
        return f"On the way '{self.a}' and '{self.b}' overlapped by {1e3 * self.depth:.3g} mm{where}."


class RunMetrics:
    """Measures of a run in the true states of a simulated world, which no skill knows.

    They begin at the present state of the world. It is a callable for the steps of a session, and skips those
    in which the world's time stands still::

        metrics = RunMetrics(world, coordinate)
        session = Session(world, on_step=metrics)

    Parameters
    ----------
    world
        Simulated world, with a robot or without.
    coordinate
        Coordinate of the object, whose true value is noted where an overlap occurs, and compared with the
        believed one.
    gripper
        Gripper that grasps or pushes; its bodies may touch the handle, and its hand is followed.
    handle
        Body that is grasped or pushed. Contacts with all bodies that move with it are counted; without a
        handle, contacts with what a skill plans to push.
    part, point
        Frame whose true motion is measured, such as that of a part with an unknown joint, and a point in it
        (3,) [m].
    start
        Earlier state in which furniture may have overlapped, such as the one before it was opened.
    rules
        Further rules about pairs of bodies that do not collide, as for :class:`kineverse.geometry.Scene`.
    leave_out
        Bodies that are not measured.
    every
        Number of steps from one search of penetrations to the next.
    contact_gap
        Largest gap of a contact [m].

    Raises
    ------
    UnknownNameError
        If the handle is no body with shapes, or the model has no such part.
    InvalidValueError
        For a point that is none, or a number of steps below 1.

    See Also
    --------
    kineverse.manipulation.open_object
    """

    def __init__(
        self,
        world: SimulatedWorld,
        coordinate: Symbol | None = None,
        *,
        gripper: Gripper | None = None,
        handle: str | None = None,
        part: str | None = None,
        point: npt.ArrayLike = (0.0, 0.0, 0.0),
        start: State | None = None,
        rules: Iterable[Rule] = (),
        leave_out: Iterable[str] = (),
        every: int = 1,
        contact_gap: float = CONTACT_GAP,
    ) -> None:
        model, robot = world.model, world.robot
        self._world, self._model, self._coordinate = world, model, coordinate
        self._gripper, self._every, self._symbols = gripper, as_count("every=", every, 1), model.symbols
        self._bodies: _BodyMetrics | None = None
        # Mechanisms without shapes do not need the extra for geometry.
        if handle is not None or any(body.collisions or body.visuals for body in model.bodies.values()):
            scene = Scene(model, rules=rules, leave_out=leave_out)
            self._bodies = _BodyMetrics(world, gripper, handle, start, scene, contact_gap)
        self._limits = _LimitExcess(model, robot.speeds)
        self._speed_place = {v: k for k, v in enumerate(robot.speeds)}
        self._places = [self._compile_pose(frame) for frame in self._find_followed()]
        self._part = None if part is None else self._compile_pose(part)
        self._point = np.asarray(point, dtype=float)
        if self._point.shape != (3,) or not np.isfinite(self._point).all():
            raise InvalidValueError(f"point= has three coordinates in m, not {point!r:.60}.")
        self._in_hand: dict[str, Callable[[Array], Array]] = {}
        self.reset()

    # -- what is measured ----------------------------------------------------------------------------------

    @property
    def value(self) -> float:
        """True value of the coordinate [m], [rad]; NaN without a coordinate."""
        return self._value_at(self._world.state)

    @property
    def is_complete(self) -> bool:
        """True if the world has been measured up to its present time."""
        return self._world.time == self._stamp

    @property
    def violation(self) -> float:
        """Largest excess of a constraint of the model, in its unit."""
        return self._limits.violation

    @property
    def limit(self) -> str:
        """Name of this constraint; empty without any excess."""
        return self._limits.limit

    @property
    def excepted(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies whose penetration does not count.

        These are pairs of the robot that overlap at the start of the run; the gripper with the handle and
        with what it holds; the bodies of planned contacts; and pairs of furniture that overlapped at the
        start, whose penetration counts as far as it exceeds what :class:`.FurnitureOverlaps` allows.
        """
        return () if self._bodies is None else self._bodies.excepted

    @property
    def overlap(self) -> RunOverlap | None:
        """The deepest of the overlaps beyond 0.5 mm that came in the run; None without any."""
        deepest = None if self._bodies is None else self._bodies.find_deepest()
        return deepest if deepest is not None and deepest.depth > OVERLAP else None

    @property
    def way(self) -> float:
        """Distance of the part's point from where it was at the start [m]; NaN without a part."""
        return self._measure_part()[0]

    @property
    def turn(self) -> float:
        """Angle by which the part has turned since the start, from 0 to pi [rad]; NaN without a part."""
        return self._measure_part()[1]

    @property
    def measures(self) -> dict[str, Any]:
        """The figures of the run by name.

        - ``limit_violation`` in the unit of the constraint ``limit``, 0 without any
        - ``penetration`` [m] of the pair ``penetrating``, 0 without any, and ``penetration_from``, the value
          of the coordinate at which it came, NaN without any or without a coordinate
        - ``grasp_error`` [m] and ``grasp_rotation`` [rad], NaN if nothing was held
        - ``contact_losses``
        - ``jitter`` [m/s], [rad/s] and ``reversals`` [1/s], NaN without steps
        - ``distance`` and ``hand_distance``, the distances of the robot's root and of the hand [m], NaN
          without a robot or a gripper
        - ``excepted``, pairs of bodies that do not count
        - ``peak_force``, the largest force between the robot and another body [N], in a world with forces
        - ``pressed``, the largest depth of the pusher in what it pushes [m], if a contact was planned
        - ``estimate_mean`` and ``estimate_largest``, errors of the believed coordinate [m], [rad], if it was
          believed
        - ``way`` [m] and ``turn`` [rad] of the part, if there is one
        """
        rms = math.sqrt(self._squares / self._seconds) if self._seconds else math.nan
        elapsed, bodies = self._stamp - self._first, self._bodies
        deepest = (None if bodies is None else bodies.find_deepest()) or _NOTHING
        found = {
            "limit_violation": self._limits.violation,
            "limit": self._limits.limit,
            "penetration": deepest.depth,
            "penetrating": (deepest.a, deepest.b),
            "penetration_from": deepest.value,
            "grasp_error": self._slip,
            "grasp_rotation": self._turn,
            "contact_losses": 0 if bodies is None else bodies.losses,
            "jitter": rms,
            "reversals": self._reversals / elapsed if self._commanded and elapsed > 0 else math.nan,
            "distance": float(self._distances[0]) if self._world.robot.frames else math.nan,
            "hand_distance": float(self._distances[-1]) if self._gripper is not None else math.nan,
            "excepted": self.excepted,
        }
        if not math.isnan(self._peak_force):
            found["peak_force"] = self._peak_force
        if bodies is not None and bodies.pressed is not None:
            found["pressed"] = bodies.pressed
        if self._errors:
            mean = sum(self._errors) / len(self._errors)
            found |= {"estimate_mean": mean, "estimate_largest": max(self._errors)}
        if self._part is not None:
            found |= {"way": self.way, "turn": self.turn}
        return found

    def reset(self) -> None:
        """Forget all measurements, and begin again at the present state of the world."""
        self._limits.reset()
        if self._bodies is not None:
            self._bodies.reset()
        self._slip = self._turn = math.nan
        self._reversals, self._squares, self._seconds, self._steps = 0, 0.0, 0, 0
        self._commanded: list[Array] = []
        self._signs = np.zeros(len(self._world.robot.speeds))
        self._held: str | None = None
        self._errors: list[float] = []
        self._peak_force = math.nan if math.isnan(self._world.peak_force) else 0.0
        self._distances = np.zeros(2)
        state = self._world.state
        values = state.vector(self._symbols)
        self._at = np.array([pose(values)[:3, 3] for pose in self._places]).reshape(-1, 3)
        if self._part is not None:
            self._first_pose = self._part(values)
        self._first = self._stamp = -math.inf
        self._measure(state, None, None)
        self._first = self._stamp

    def __call__(self, step: SkillStep) -> None:
        """Measure the present state of the world after a step.

        Raises
        ------
        InvalidValueError
            If the world was reset since the last step: it would be another run.
        """
        state, now = self._world.state, self._world.time
        if now < self._stamp:
            raise InvalidValueError(
                f"The world was measured at {self._stamp:.6g} s, and now at {now:.6g} s. "
                "After a reset of the world, reset() of the metrics begins again."
            )
        if now == self._stamp:
            return
        commanded = np.zeros(len(self._signs))
        for v, value in step.commands.items():
            if (k := self._speed_place.get(v)) is not None:
                commanded[k] = value
        self._measure_jitter(commanded)
        if self._coordinate is not None and self._coordinate in step.state:
            self._errors.append(abs(step.state[self._coordinate] - state[self._coordinate]))
        if not math.isnan(force := self._world.peak_force):
            self._peak_force = max(self._peak_force, force)
        self._measure(state, commanded, step.contact)

    # -- measurements --------------------------------------------------------------------------------------

    def _measure(self, state: State, commanded: Array | None, contact: PlannedContact | None) -> None:
        stamp, values = self._world.time, state.vector(self._symbols)
        self._limits.update(values, stamp, commanded)
        self._measure_hold(values)
        places = np.array([pose(values)[:3, 3] for pose in self._places]).reshape(-1, 3)
        self._distances[: len(places)] += np.linalg.norm(places - self._at, axis=1)
        self._at = places
        if self._bodies is not None:
            searches = self._steps % self._every == 0
            self._bodies.measure(values, stamp, self._value_at(state), contact, searches)
        self._steps += 1
        self._stamp = stamp

    def _value_at(self, state: State) -> float:
        return math.nan if self._coordinate is None else float(state[self._coordinate])

    def _measure_jitter(self, commanded: Array) -> None:
        self._commanded = [*self._commanded[-2:], commanded]
        if len(self._commanded) == 3:
            u, v, w = self._commanded
            second = w - 2.0 * v + u
            self._squares += float(second @ second)
            self._seconds += 1
        signs = np.where(np.abs(commanded) > _STILL, np.sign(commanded), 0.0)
        self._reversals += int(np.count_nonzero(signs * self._signs < 0.0))
        self._signs = np.where(signs != 0.0, signs, self._signs)

    def _measure_hold(self, values: Array) -> None:
        held = self._world.held
        if held is None or self._gripper is None:
            self._held = None
            return
        if held not in self._in_hand:
            self._in_hand[held] = self._compile_pose(held, self._gripper.hand)
        if self._bodies is not None:
            self._bodies.permit(self._gripper.bodies, (held,))
        pose, middle = self._in_hand[held](values), self._gripper.grasp_pose[:, 3]
        if self._held != held:
            self._held, self._pose, self._middle = held, pose, inverse(pose) @ middle
            self._slip, self._turn = (0.0 if math.isnan(x) else x for x in (self._slip, self._turn))
            return
        apart = float(np.linalg.norm((pose @ self._middle - middle)[:3]))
        turned = float(rotation_angle(pose[:3, :3] @ self._pose[:3, :3].T))
        self._slip, self._turn = max(self._slip, apart), max(self._turn, turned)

    # -- preparation ---------------------------------------------------------------------------------------

    def _compile_pose(self, frame: str, relative_to: str = WORLD) -> Callable[[Array], Array]:
        """Return the pose (4, 4) of a frame as a function of the values of all symbols."""
        # A few calls a step: compiling C takes longer than all of them.
        function = compile(self._model.fk(frame, relative_to), tier="interpreter")
        at = np.array([self._symbols.index(s) for s in function.inputs], dtype=np.intp)

        def evaluate(values: Array) -> Array:
            return np.array(function(values[at]))

        return evaluate

    def _measure_part(self) -> tuple[float, float]:
        if self._part is None:
            return math.nan, math.nan
        now = self._part(self._world.state.vector(self._symbols))
        return measure_way(self._first_pose, now, self._point)

    def _find_followed(self) -> tuple[str, ...]:
        """Return the frames whose paths are measured: the root of what moves of the robot, and the hand."""
        robot = self._world.robot
        bodies = robot.bodies or robot.frames
        if not bodies:
            return ()
        motion = FrameDependence(self._model, robot.speeds)
        moved = [b for b in bodies if motion.moves(b)] or bodies
        root = min(moved, key=lambda b: len(motion.moving_ancestors(b)))
        return (root,) if self._gripper is None else (root, self._gripper.hand)


_NOTHING = RunOverlap("", "", 0.0, math.nan, math.nan)


class _BodyMetrics:
    """Overlaps and contacts of bodies in the states of a run."""

    def __init__(
        self,
        world: SimulatedWorld,
        gripper: Gripper | None,
        handle: str | None,
        start: State | None,
        scene: Scene,
        gap: float,
    ) -> None:
        self._robot, self._scene, self._start, self._gap = world.robot, scene, start, gap
        place = {s: k for k, s in enumerate(world.model.symbols)}
        self._values = np.array([place[s] for s in scene.inputs], dtype=np.intp)
        self._own = [b for b in scene.bodies if self._robot.owns(b)]
        self._penetrations = scene.watch(self._own, radius=0.0) if self._own else None
        self._furniture = FurnitureOverlaps(scene, self._robot)
        self._handle = handle
        self._permitted_at_first: dict[str, set[str]] = {}
        self._touches: PreparedQuery | None = None
        self._presses: dict[tuple[tuple[str, ...], tuple[str, ...]], PreparedQuery] = {}
        if handle is not None:
            if handle not in scene.bodies:
                raise UnknownNameError(
                    f"The handle '{handle}' is no body with shapes. {suggest(handle, scene.bodies, 'body')}"
                )
            self._permitted_at_first[handle] = {*(() if gripper is None else gripper.bodies)}
            self._touches = self._watch_contacts(handle)

    def reset(self) -> None:
        self._overlaps: dict[tuple[str, str], RunOverlap] = {}
        self.losses = 0
        self.pressed: float | None = None  # largest depth of a planned contact [m]; None without any
        self._permitted = {body: {*others} for body, others in self._permitted_at_first.items()}
        self._overlapping_at_first: tuple[tuple[str, str], ...] = ()
        self._touched, self._begun = False, False
        if self._handle is None:
            self._touches = None

    def find_deepest(self) -> RunOverlap | None:
        return max(self._overlaps.values(), key=lambda one: one.depth, default=None)

    @property
    def excepted(self) -> tuple[tuple[str, str], ...]:
        permitted = ((a, b) for b, ones in sorted(self._permitted.items()) for a in sorted(ones))
        return tuple(dict.fromkeys((*self._overlapping_at_first, *permitted, *self._furniture.excepted)))

    def permit(self, ones: Iterable[str], others: Iterable[str]) -> None:
        """Except penetrations of bodies into some others from now on."""
        ones, added = frozenset(ones), False
        for body in others:
            known = self._permitted.setdefault(body, set())
            added |= not ones <= known
            known |= ones
        if added and self._begun:
            self._select_pairs()

    def measure(
        self, values: Array, stamp: float, value: float, contact: PlannedContact | None, searches: bool
    ) -> None:
        """Measure a state by the values of all symbols.

        Its stamp [s] and the value of the coordinate [m], [rad] are noted with overlaps. Those are searched
        if ``searches`` says so.
        """
        if contact is not None:
            self.permit(contact.pusher, contact.pushed)
        if searches or contact is not None or self._touches is not None:
            self._scene.update(values[self._values])
        if not self._begun:
            self._begin()
        if searches:
            self._measure_penetration(stamp, value)
        if contact is not None:
            self._measure_press(contact)
        if self._touches is not None:
            touched = len(self._touches()) > 0
            self.losses += contact is not None and contact.touching and self._touched and not touched
            self._touched = touched

    def _begin(self) -> None:
        """Except what overlaps at the first state: pairs of the robot, and of furniture as far as it does."""
        found = () if self._penetrations is None else self._penetrations()
        deep = ((pair.a, pair.b) for pair in found if pair.distance < -_TOUCHING)
        self._overlapping_at_first = tuple(
            (a, b) for a, b in deep if self._robot.owns(a) and self._robot.owns(b)
        )
        self._furniture.begin(*(() if self._start is None else (self._start,)))
        self._begun = True
        self._select_pairs()

    def _select_pairs(self) -> None:
        number = {b: k for k, b in enumerate(self._scene.bodies)}
        self._is_excepted = np.zeros((len(number),) * 2, dtype=bool)
        for a, b in self.excepted:
            if a in number and b in number:
                self._is_excepted[number[a], number[b]] = self._is_excepted[number[b], number[a]] = True

    def _watch_contacts(self, body: str) -> PreparedQuery:
        """Return the query for contacts of the robot with what moves like a body."""
        model, bodies = self._scene.model, self._scene.bodies
        motion = FrameDependence(model, model.speeds)
        group = [b for b in bodies if motion.moving_ancestors(b) == motion.moving_ancestors(body)]
        rules = [Rule(a, b, True) for a in self._own for b in group if a != b]
        return self._scene.watch(self._own, group, self._gap, rules=rules)

    def _measure_press(self, contact: PlannedContact) -> None:
        """Measure the depth of a planned contact, as far as the true model has its bodies."""
        known = self._scene.bodies
        pusher, pushed = (tuple(b for b in names if b in known) for names in contact[:2])
        if not pusher or not pushed:
            return
        if self._touches is None:
            self._touches = self._watch_contacts(pushed[0])
        if (pusher, pushed) not in self._presses:
            self._presses[pusher, pushed] = self._scene.watch(pusher, pushed, radius=0.0)
        found = self._presses[pusher, pushed]()
        depth = -float(found.distances[0]) if len(found) else 0.0
        self.pressed = max(depth, self.pressed or 0.0)

    def _measure_penetration(self, stamp: float, value: float) -> None:
        if self._penetrations is not None:
            result = self._penetrations()
            for k in range(len(result)):
                i, j = result.body_indices[k].tolist()
                if not self._is_excepted[i, j]:
                    pair = result[k]
                    self._note(RunOverlap(pair.a, pair.b, -pair.distance, value, stamp))
        for one in self._furniture.find(0.0):
            self._note(RunOverlap(one.a, one.b, one.excess, value, stamp))

    def _note(self, found: RunOverlap) -> None:
        """Note the depth of two bodies, and where it came if it is the first one beyond 0.5 mm."""
        known = self._overlaps.get((found.a, found.b))
        if known is not None and (known.depth > OVERLAP or found.depth <= OVERLAP):
            self._overlaps[found.a, found.b] = known._replace(depth=max(found.depth, known.depth))
        elif found.depth > _ROUNDING:
            self._overlaps[found.a, found.b] = found


def measure_way(first: Array, last: Array, point: Array) -> tuple[float, float]:
    """Return the distance [m] of a point (3,) of a part between two poses (4, 4), and the angle [rad]."""
    a, b = (pose @ np.append(point, 1.0) for pose in (first, last))
    return float(np.linalg.norm((b - a)[:3])), float(rotation_angle(first[:3, :3].T @ last[:3, :3]))


class _LimitExcess:
    """Largest excess of any constraint of a model in successive states, see *limit violation* above."""

    violation: float  # largest excess since the last reset, in the unit of its constraint
    limit: str  # the constraint's name

    def __init__(self, model: ModelView, commanded: Sequence[Symbol] = ()) -> None:
        self.symbols, columns = model.symbols, model.speeds
        self._checker = model.constraint_checker((*self.symbols, *columns))
        known = model.constraints
        orders = [known[n].order if n in known else 0 for n in self._checker.names]
        self._about_speeds: npt.NDArray[np.bool_] = np.array(orders, dtype=int) > 0
        place = {s: k for k, s in enumerate(self.symbols)}
        own = [(k, place.get(v.position)) for k, v in enumerate(columns) if v.position not in model.rates]
        pairs = [(k, at) for k, at in own if at is not None]
        self._differed = np.array([k for k, _ in pairs], dtype=np.intp)
        self._coordinate = np.array([at for _, at in pairs], dtype=np.intp)
        column = {v: k for k, v in enumerate(columns)}
        self._commanded = np.array([column[v] for v in commanded], dtype=np.intp)
        self._vector = np.zeros(len(self.symbols) + len(columns))
        self.reset()

    def reset(self) -> None:
        self.violation, self.limit = 0.0, ""
        self._stamp: float | None = None
        self._values: Array = np.zeros(len(self.symbols))

    def update(self, values: Array, stamp: float, commanded: Array | None = None) -> None:
        vector, count = self._vector, len(self.symbols)
        rates = vector[count:]
        rates[:] = 0.0
        before = np.full(len(self._about_speeds), -np.inf)
        if self._stamp is not None:
            if commanded is not None:
                rates[self._commanded] = commanded
            moved = values[self._coordinate] - self._values[self._coordinate]
            rates[self._differed] = moved / (stamp - self._stamp)
            vector[:count] = self._values
            before = self._excesses(vector)
        vector[:count] = values
        excess = self._excesses(vector)
        self._stamp, self._values = stamp, np.array(values)
        # A lock that closes or opens within the step may have been open while it moved.
        excess[self._about_speeds] = np.minimum(excess, before)[self._about_speeds]
        if not len(excess):
            return
        worst = int(np.argmax(excess))
        if excess[worst] > self.violation:
            self.violation, self.limit = float(excess[worst]), self._checker.names[worst]

    def _excesses(self, vector: Array) -> Array:
        """Return the excess of each constraint: a constraint without a value is violated beyond measure."""
        self._checker(vector)
        return np.where(np.isnan(self._checker.excess), np.inf, self._checker.excess)
