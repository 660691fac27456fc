"""Judge of a run: measurements in the true states of a world, independent of the skill and of the world.

- *limit violation*: largest excess of any constraint of the model. Positions are those of the states, speeds
  are differences of successive states by time; commanded speeds stand in where no coordinate is the integral
  of a speed. A limit of a speed that depends on the state, such as a lock, is violated if it was at the
  begin and at the end of a step.
- *penetration*: largest depth of any pair of bodies, furniture among itself included, but for the excepted
  pairs, which are listed. Of furniture that overlapped at the start, it is the depth beyond what is allowed
  by :class:`.FurnitureOverlaps`.
- *overlap*: a penetration beyond 0.5 mm that came on the way.
- *contact losses*: number of times that the robot touched the object and then did not, while pushing.
- *grasp error*: largest motion of the held body in the hand since the hold began, in the middle between the
  fingers.
- *jitter*: root mean square over time of the norm of the second differences of commanded speeds,
  ``|u_k - 2 u_{k-1} + u_{k-2}|``. That is the jerk times the squared period; integrated squared jerk is the
  usual measure of smoothness (Flash & Hogan 1985).
- *reversals*: sign changes of commanded speeds beyond 5 mm/s or mrad/s, by time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, finite_number
from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.geometry import Rule, Scene
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array, inverse, rotation_angle
from kineverse.model.frame import is_of_robot
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .furniture_overlaps import OVERLAP, FurnitureOverlaps


class LimitJudge:
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
        """Forget all measurements."""
        self.violation, self.limit = 0.0, ""
        self._stamp: float | None = None
        self._values: Array = np.zeros(len(self.symbols))

    def update(self, values: Array, stamp: float, commanded: Array | None = None) -> None:
        """Measure a state."""
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


CONTACT_GAP = 1e-3  # largest gap of a contact of a push [m]

_STILL = 5e-3
_TOUCHING = 1e-6  # depth up to which links of a robot touch and do not overlap [m]


class JudgedOverlap(NamedTuple):
    """Overlap that came in a run."""

    a: str  # names of the bodies
    b: str
    depth: float  # largest depth [m]
    value: float  # value of the judged coordinate at which it came [m], [rad]; NaN without a coordinate
    time: float  # stamp of the state in which it came [s]

    def __str__(self) -> str:
        where = "" if math.isnan(self.value) else f", from {self.value:.3f} on"
        return f"On the way '{self.a}' and '{self.b}' overlapped by {1e3 * self.depth:.3g} mm{where}."


class Judge:
    """Measurements of a run, updated after each step with the true state.

    Parameters
    ----------
    robot
        Prefix of the robot.
    gripper
        Gripper that grasps or pushes; its bodies may touch the handle.
    handle
        Body that is grasped or pushed. Contacts with all bodies that move with it are counted.
    coordinate
        Coordinate of the object, whose value is noted where an overlap occurs.
    start
        Earlier state in which furniture may have overlapped, such as the one before it was opened.
    scene
        Collision scene of the model, which from now on is the judge's; None for ``Scene(model)``.
    every
        Number of steps from one search of penetrations to the next.
    contact_gap
        Largest gap of a contact [m].

    Attributes
    ----------
    excepted
        Pairs of bodies whose penetration does not count: those of the robot that overlap at the begin of the
        run, and those of the gripper with the handle; and pairs of furniture that overlapped at the start,
        whose penetration counts as far as it exceeds what :class:`.FurnitureOverlaps` allows.

    Raises
    ------
    UnknownNameError
        If nothing of the model is below the prefix, or the handle is no body with shapes.
    """

    def __init__(
        self,
        model: ModelView,
        robot: str,
        gripper: Gripper | None = None,
        handle: str | None = None,
        *,
        coordinate: Symbol | None = None,
        start: State | None = None,
        scene: Scene | None = None,
        every: int = 1,
        contact_gap: float = CONTACT_GAP,
    ) -> None:
        self.model, self.robot, self.gripper = model, robot, gripper
        self._every = as_count("every=", every, 1)
        self._symbols = model.symbols
        self._scene = scene or Scene(model)
        self._robot_bodies = [b for b in self._scene.bodies if is_of_robot(b, robot)]
        if not self._robot_bodies:
            prefixes = {name.partition("/")[0] for name in model.frames}
            raise UnknownNameError(
                f"No body of the model is below '{robot}'. {suggest(robot, prefixes, 'prefix')}"
            )
        self._robot_speeds = [v for v in model.speeds if is_of_robot(v.path, robot)]
        self._limits = LimitJudge(model, self._robot_speeds)
        # Speeds are given by symbol or by name.
        self._speed_place: dict[Symbol | str, int] = {v: k for k, v in enumerate(self._robot_speeds)}
        self._speed_place |= {str(v): k for k, v in enumerate(self._robot_speeds)}
        self._scene_values = self._indices(self._scene.inputs)
        self._coordinate, self._start = coordinate, start
        self._penetrations = self._scene.watch(self._robot_bodies, radius=0.0)
        self._furniture = FurnitureOverlaps(self._scene, robot)
        self._first_overlapping: tuple[tuple[str, str], ...] = ()
        self._gripping: dict[str, set[str]] = {}
        self._touches: PreparedQuery | None = None
        if handle is not None:
            self._watch_handle(handle, contact_gap)
            self._gripping[handle] = {*self._gripper_bodies}
        self._select_pairs()
        # A few calls a step: compiling C takes longer than all of them.
        self._place = compile([model.fk(name)[:3, 3] for name in self._followed()], tier="interpreter")
        self._place_values = self._indices(self._place.inputs)
        self._in_hand: dict[str, tuple[CompiledFunction[Array], npt.NDArray[np.intp]]] = {}
        self.reset()

    # -- what is measured ----------------------------------------------------------------------------------

    @property
    def excepted(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies whose penetration does not count."""
        gripping = ((a, b) for b, ones in sorted(self._gripping.items()) for a in sorted(ones))
        return tuple(dict.fromkeys((*self._first_overlapping, *gripping, *self._furniture.excepted)))

    @property
    def overlap(self) -> JudgedOverlap | None:
        """The deepest of the overlaps beyond 0.5 mm that came since the last reset; None without any."""
        deep = (one for one in self._overlaps.values() if one.depth > OVERLAP)
        return max(deep, key=lambda one: one.depth, default=None)

    @property
    def measures(self) -> dict[str, Any]:
        """The figures since the last reset by name.

        - ``limit_violation`` in the unit of the constraint ``limit``, 0 without any
        - ``penetration`` [m] of the pair ``penetrating``, 0 without any, and ``penetration_from``, the value
          of the coordinate at which it came, NaN without any or without a coordinate
        - ``grasp_error`` [m] and ``grasp_rotation`` [rad], NaN if nothing was held
        - ``contact_losses``
        - ``jitter`` [m/s], [rad/s] and ``reversals`` [1/s], NaN without commands
        - ``distance`` and ``hand_distance``, the distances of the robot's root and of the hand [m]
        - ``excepted``, pairs of bodies that do not count
        """
        rms = math.sqrt(self._squares / self._seconds) if self._seconds else math.nan
        elapsed = 0.0 if self._first is None or self._stamp is None else self._stamp - self._first
        nothing = JudgedOverlap("", "", 0.0, math.nan, math.nan)
        deepest = max(self._overlaps.values(), key=lambda one: one.depth, default=nothing)
        return {
            "limit_violation": self._limits.violation,
            "limit": self._limits.limit,
            "penetration": deepest.depth,
            "penetrating": (deepest.a, deepest.b),
            "penetration_from": deepest.value,
            "grasp_error": self._slip,
            "grasp_rotation": self._turn,
            "contact_losses": self._losses,
            "jitter": rms,
            "reversals": self._reversals / elapsed if self._commanded and elapsed > 0 else math.nan,
            "distance": float(self._distances[0]),
            "hand_distance": float(self._distances[-1]) if self.gripper is not None else math.nan,
            "excepted": self.excepted,
        }

    def allow(self, bodies: Iterable[str], pusher: Iterable[str] | None = None) -> None:
        """Except penetrations of the gripper's bodies, or of other ones, into some that are pushed."""
        ones = self._gripper_bodies if pusher is None else tuple(pusher)
        for body in bodies:
            self._gripping.setdefault(body, set()).update(ones)
        self._select_pairs()

    def reset(self) -> None:
        """Forget all measurements."""
        self._limits.reset()
        self._overlaps: dict[tuple[str, str], JudgedOverlap] = {}
        self._slip = self._turn = math.nan
        self._losses, self._reversals = 0, 0
        self._squares, self._seconds = 0.0, 0
        self._first: float | None = None
        self._stamp: float | None = None
        self._steps = 0
        self._commanded: list[Array] = []
        self._signs = np.zeros(len(self._robot_speeds))
        self._touched = False
        self._held: str | None = None
        self._distances = np.zeros(2)
        self._places = np.zeros((0, 3))

    def update(
        self, state: State, speeds: StateLike | None = None, *, held: str | None = None, pushing: bool = False
    ) -> None:
        """Measure a state, the first one of a run or the one after a step.

        Parameters
        ----------
        state
            True state with its stamp.
        speeds
            Speeds that were commanded for the step by symbol or name [m/s], [rad/s]; None before the first.
            Those of objects are not read.
        held
            Frame of the body in the gripper: ``world.held``.
        pushing
            Whether the robot is to touch the object: else contacts that end are no losses.

        Raises
        ------
        InvalidValueError
            For a state without stamp, or not after the last one.
        """
        stamp = None if state.stamp is None else finite_number(state.stamp)
        if stamp is None or (self._stamp is not None and stamp <= self._stamp):
            raise InvalidValueError(
                f"Judged states have stamps that increase, and {state.stamp!r} s follows {self._stamp!r} s. "
                "reset() begins a new run."
            )
        values = state.vector(self._symbols)
        commanded = None if speeds is None else self._select_speeds(speeds)
        self._limits.update(values, stamp, commanded)
        if commanded is not None:
            self._measure_jitter(commanded)
        self._measure_hold(values, held)
        self._measure_distance(values)
        searches = self._steps % self._every == 0
        if searches or self._touches is not None:
            self._scene.update(values[self._scene_values])
        if self._first is None:
            self._begin()
        if searches:
            self._measure_penetration(state, stamp)
        if self._touches is not None:
            touched = len(self._touches()) > 0
            self._losses += pushing and self._touched and not touched
            self._touched = touched
        self._steps += 1
        if self._first is None:
            self._first = stamp
        self._stamp = stamp

    @property
    def _gripper_bodies(self) -> tuple[str, ...]:
        return () if self.gripper is None else tuple(self.gripper.bodies)

    # -- preparation ---------------------------------------------------------------------------------------

    def _indices(self, symbols: Iterable[Symbol]) -> npt.NDArray[np.intp]:
        place = {s: k for k, s in enumerate(self._symbols)}
        return np.array([place[s] for s in symbols], dtype=np.intp)

    def _watch_handle(self, handle: str, gap: float) -> None:
        """Prepare the query of contacts of the robot with what moves like the handle."""
        bodies = self._scene.bodies
        if handle not in bodies:
            raise UnknownNameError(
                f"The handle '{handle}' is no body with shapes. {suggest(handle, bodies, 'body')}"
            )
        motion = FrameDependence(self.model, self.model.speeds)
        group = [b for b in bodies if motion.moving_ancestors(b) == motion.moving_ancestors(handle)]
        rules = [Rule(a, b, True) for a in self._robot_bodies for b in group if a != b]
        self._touches = self._scene.watch(self._robot_bodies, group, gap, rules=rules)

    def _begin(self) -> None:
        """Except what overlaps at the first state: pairs of the robot, and of furniture as far as it does."""
        robot = set(self._robot_bodies)
        result = ((pair.a, pair.b) for pair in self._penetrations() if pair.distance < -_TOUCHING)
        self._first_overlapping = tuple((a, b) for a, b in result if a in robot and b in robot)
        self._furniture.begin(*(() if self._start is None else (self._start,)))
        self._select_pairs()

    def _select_pairs(self) -> None:
        number = {b: k for k, b in enumerate(self._scene.bodies)}
        self._is_excepted = np.zeros((len(number),) * 2, dtype=bool)
        for a, b in self.excepted:
            if a in number and b in number:
                self._is_excepted[number[a], number[b]] = self._is_excepted[number[b], number[a]] = True

    def _followed(self) -> tuple[str, ...]:
        """Return the frames whose paths are measured: the root of what moves of the robot, and the hand."""
        motion = FrameDependence(self.model, self._robot_speeds)
        moved = [b for b in self._robot_bodies if motion.moves(b)] or self._robot_bodies
        root = min(moved, key=lambda b: len(motion.moving_ancestors(b)))
        return (root,) if self.gripper is None else (root, self.gripper.hand)

    def _select_speeds(self, speeds: StateLike) -> Array:
        """Return the commanded speeds of the robot; 0 for missing ones."""
        result = np.zeros(len(self._robot_speeds))
        for v, value in speeds.items():
            k = self._speed_place.get(v)
            if k is not None:
                result[k] = value
        return result

    # -- measurements --------------------------------------------------------------------------------------

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

    def _measure_hold(self, values: Array, held: str | None) -> None:
        if held is None or self.gripper is None:
            self._held = None
            return
        if held not in self._in_hand:
            relative = compile(self.model.fk(held, self.gripper.hand), tier="interpreter")
            self._in_hand[held] = relative, self._indices(relative.inputs)
            if held not in self._gripping:
                self.allow([held])
        function, at = self._in_hand[held]
        pose = function(values[at])
        middle = self.gripper.grasp_pose[:, 3]
        if self._held != held:
            self._held, self._pose, self._middle = held, pose, inverse(pose) @ middle
            self._slip, self._turn = (0.0 if math.isnan(x) else x for x in (self._slip, self._turn))
            return
        apart = float(np.linalg.norm((pose @ self._middle - middle)[:3]))
        turned = float(rotation_angle(pose[:3, :3] @ self._pose[:3, :3].T))
        self._slip, self._turn = max(self._slip, apart), max(self._turn, turned)

    def _measure_distance(self, values: Array) -> None:
        places = np.array(self._place(values[self._place_values]))
        if self._first is not None:
            self._distances[: len(places)] += np.linalg.norm(places - self._places, axis=1)
        self._places = places

    def _measure_penetration(self, state: State, stamp: float) -> None:
        result = self._penetrations()
        for k in range(len(result)):
            i, j = result.body_indices[k].tolist()
            if not self._is_excepted[i, j]:
                pair = result[k]
                self._note_overlap(pair.a, pair.b, -pair.distance, state, stamp)
        for one in self._furniture.find(0.0):
            self._note_overlap(one.a, one.b, one.excess, state, stamp)

    def _note_overlap(self, a: str, b: str, depth: float, state: State, stamp: float) -> None:
        """Note a depth of two bodies, and where it came if it is the first one beyond 0.5 mm."""
        known = self._overlaps.get((a, b))
        if known is not None and (known.depth > OVERLAP or depth <= OVERLAP):
            self._overlaps[a, b] = known._replace(depth=max(depth, known.depth))
        elif depth > 0.0:
            value = math.nan if self._coordinate is None else float(state[self._coordinate])
            self._overlaps[a, b] = JudgedOverlap(a, b, depth, value, stamp)
