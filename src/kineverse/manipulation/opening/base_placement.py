"""Base placement: a base, a grasp and a path of the arm along which a held object can be moved."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import count
from time import perf_counter

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.errors import InvalidValueError
from kineverse.geometry import Scene
from kineverse.grasping import Grasp, Gripper
from kineverse.lie import Array
from kineverse.manipulation.base_sampling import BaseSampler
from kineverse.manipulation.collision_rules import find_overlapping_links, furniture_rules
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

from .arm_paths import (
    OWN_MARGIN,
    TOLERANCE,
    CandidatePath,
    CartesianPaths,
    PathCheck,
    PathContacts,
    find_highest_passage,
    find_highest_reach,
    interpolate_poses,
)
from .contact_phases import Way

NO_PATH, NO_PLACE = "no path to the handle", "no free place of the base"  # reasons of refusals
_DIFFERENCE = 0.025  # difference of the values at the ends of a path and of its reversal [m], [rad]


@dataclass(frozen=True, slots=True, eq=False)
class BasePlacement:
    """Base, grasp and path of the arm, true if they were found.

    Attributes
    ----------
    grasp
        The grasp; None if nothing was found.
    coordinates
        Coordinates (n,) of the robot: base and arm.
    approach, line
        Configuration (n,) before the hand is at the handle, and those (L, n) from there to the grasp.
    way, path
        Values of the coordinates that move the handle, and configurations (K, n) of the robot there. They end
        at the target, or where the arm or an obstacle ends them.
    retreat
        Configurations (L, n) with which the hand goes away from the handle at the end.
    samples
        Number of sampled bases.
    reasons
        Number of samples by the reason of their failure.
    seconds
        Duration of the search [s].
    stands
        Whether the robot's base stands where it is, so that each sample is an arm instead of a base.

    See Also
    --------
    kineverse.manipulation.PlacementSearch
    """

    grasp: Grasp | None
    coordinates: tuple[Symbol, ...]
    approach: Array
    line: Array
    way: Way
    path: Array
    retreat: Array
    samples: int
    reasons: Counter[str]
    seconds: float
    stands: bool = False

    def __bool__(self) -> bool:
        return self.grasp is not None

    @property
    def values(self) -> Array:
        """Values (K,) of the object's coordinate along the path [m], [rad]."""
        return self.way.values[:, -1]

    def find_last_run(self) -> BasePlacement:
        """Return the part of the path on which the object's coordinate moves alone."""
        first = self.way.last_run
        return replace(self, way=self.way.cut(first, len(self.way)), path=self.path[first:])

    def find_end_backwards(self, value: float, target: float) -> float | None:
        """Return the value to which the reversed path leads towards a target; None if it leads nowhere.

        It begins where the path ends, and small differences [m], [rad] at both ends are made up for.
        """
        ahead = math.copysign(1.0, target - value)
        begin, end = float(self.values[-1]), float(self.values[0])
        if abs(value - begin) >= _DIFFERENCE or ahead * (end - value) <= 0.0:
            return None
        return target if ahead * (target - end) < _DIFFERENCE else end

    @property
    def failure(self) -> str:
        """Class of the failure: ``"collision"`` if an arm reaches along the path, otherwise ``"reach"``."""
        return "collision" if any(" at " in r or r in (NO_PATH, NO_PLACE) for r in self.reasons) else "reach"

    @property
    def why(self) -> str:
        """Text with the number of samples and the reasons of failures."""
        failed = ", ".join(f"{n} {reason}" for reason, n in self.reasons.most_common(6) if n)
        what = "arms of a robot that stands" if self.stands else "bases"
        result = (
            f"Found after {self.samples} {what}" if self else f"None of {self.samples} {what} goes through"
        )
        return f"{result}; failed: {failed}." if failed else f"{result}."


_BASE_EASE, _BASE_SPEED = (0.1, 0.01), 1.0
"""Weights of a base that can move relative to those of joints, so that it moves where they are not enough, or
nearly stands where there is little room; and its speed where the model has no limit [m/s]."""
_WHOLE_ARM, _STANDING_EASE = 6, (0.1, 0.0, 0.0)  # joints of an arm that needs no base, weights of its base
_QUICK, _SOON = 0.5, 4.0  # speed of joints with full weight [m/s], [rad/s]; time to reach most arms [s]


class PlacementSampler:
    """Random bases, arms and grasps."""

    def __init__(
        self, model: ModelView, moving: Sequence[Symbol], standing: Sequence[Symbol], base: Sequence[Symbol]
    ) -> None:
        self.moving, self.standing, self.base = tuple(moving), tuple(standing), tuple(base)
        limits = np.array([model.limits(s) for s in moving], dtype=float).reshape(-1, 2)
        self.lower, self.upper = limits.T
        self._bounded = np.isfinite(limits).all(axis=1)
        speeds = [min(abs(v) for v in model.limits(s.derivative())) for s in moving]
        self.speeds = np.array([v if 0.0 < v < math.inf else _BASE_SPEED for v in speeds])
        on_base = np.array([s in self.base for s in moving], dtype=bool)
        joints = np.minimum(1.0, self.speeds / _QUICK)
        whole_arm = on_base.any() and (~on_base).sum() >= _WHOLE_ARM
        weights = _STANDING_EASE if whole_arm else _BASE_EASE
        self.eases = tuple(np.where(on_base, weight, joints) for weight in weights)
        self._on_base = on_base

    def stands(self, ease: Array) -> bool:
        """Return True if the base stands along paths with weights (n,)."""
        return not ease[self._on_base].any()

    def choose_grasps(
        self,
        random: np.random.Generator,
        grasps: Sequence[Grasp],
        free: npt.NDArray[np.int_],
        count: int,
        upright: bool,
    ) -> npt.NDArray[np.intp]:
        """Return indices (N,) of grasps: good ones mostly, or all tilts alike; none if none is free."""
        usable = np.flatnonzero(free > 0)
        if not len(usable):
            return np.zeros(0, dtype=np.intp)
        size = len(usable)
        if upright:
            rank = random.geometric(min(1.0, 4.0 / size), count) - 1
            return usable[np.where(rank < size, rank, random.integers(size, size=count))]
        # Some paths need a hand that comes from above or from the side, and few grasps are such.
        tilts = np.array([grasp.tilt for grasp in grasps])[usable]
        wanted = random.uniform(tilts.min(), tilts.max(), count)
        order = np.argsort(tilts, kind="stable")
        near = np.searchsorted(tilts[order], wanted) + random.integers(-2, 3, count)
        return np.asarray(usable[order[np.clip(near, 0, size - 1)]])

    def draw(
        self,
        random: np.random.Generator,
        states: Sequence[State],
        hands: Array,
        approaches: Array,
        starts: int,
        bases: BaseSampler,
    ) -> tuple[Array, Array]:
        """Return random arms (N, n), and bases (N, m) in front of poses of the hand (N, 4, 4)."""
        count = len(hands)
        Q = self._draw_arms(random, states[0], count)
        still = np.tile(states[0].vector(self.standing), (count, 1))
        if self.base:
            first = slice(None, None, starts)
            places = bases.draw(random, states, hands[first, :2, 3], (approaches - hands)[first, :2, 3])
            places = np.repeat(places, starts, axis=0)[:count]
            for k, s in enumerate(self.base):
                columns, array = (self.moving, Q) if s in self.moving else (self.standing, still)
                array[:, columns.index(s)] = places[:, k]
        return Q, still

    def find_places(self, Q: Array, still: Array) -> Array:
        """Return the places of the base (N, 3) in arms (N, n) and values (N, m) of what stands."""
        columns = [
            Q[:, self.moving.index(s)] if s in self.moving else still[:, self.standing.index(s)]
            for s in self.base
        ]
        return np.stack(columns, axis=1)

    def stay(self, random: np.random.Generator, state: State, count: int) -> tuple[Array, Array]:
        """Return arms (N, n) on a base that stays, (N, m): half of them as in a state, the others random."""
        kept = self._on_base | (random.random((count, 1)) < 0.5)
        Q = np.where(kept, state.vector(self.moving), self._draw_arms(random, state, count))
        return Q, np.tile(state.vector(self.standing), (count, 1))

    def _draw_arms(self, random: np.random.Generator, state: State, count: int) -> Array:
        here = state.vector(self.moving)
        lower = np.where(self._bounded, self.lower, here - math.pi)
        upper = np.where(self._bounded, self.upper, here + math.pi)
        soon = random.random((count, 1)) < 0.75
        span = _SOON * self.speeds
        low = np.where(soon, np.minimum(np.maximum(lower, here - span), upper), lower)
        high = np.where(soon, np.maximum(np.minimum(upper, here + span), lower), upper)
        return random.uniform(low, high)

    def cost(self, state: State, paths: Array, approaches: Array, ends: npt.NDArray[np.int_]) -> Array:
        """Return the costs (N,) of paths (N, K, n) until indices (N,): their times, and nearness to limits.

        ``approaches`` (N, n) are the configurations before the hand is at the handle; the time [s] to get
        there from a state counts as well.
        """
        away = approaches - state.vector(self.moving)
        away = np.where(self._bounded, away, (away + math.pi) % (2 * math.pi) - math.pi)
        for s in self.base[:2]:
            if s in self.moving:
                k = self.moving.index(s)
                away[:, k] = approaches[:, k] - state[s]
        there = (np.abs(away) / self.speeds).max(axis=1, initial=0.0)
        steps = (np.abs(np.diff(paths, axis=1)) / self.speeds).max(axis=2, initial=0.0)
        used = np.arange(steps.shape[1]) < ends[:, None]
        along = (steps * used).sum(axis=1)
        # Joints that their limits hold are as near to them everywhere.
        has_range = self._bounded & (self.lower < self.upper)
        lower, upper, bounded = self.lower[has_range], self.upper[has_range], paths[:, :, has_range]
        room = np.minimum(bounded - lower, upper - bounded) / (upper - lower)
        room = np.where(np.append(used, used[:, -1:], axis=1)[:, :, None], room, 1.0)
        least = room.min(axis=(1, 2), initial=1.0)
        return np.asarray(along + there - 40.0 * np.minimum(least, 0.1))


_RANDOM_STATES = 24  # number of random states in which links that are always near to each other are sought
_OFFSET = 0.1  # largest change of each coordinate of the base in these states [m], [rad]
_START_ITERATIONS = 30
_CORRECTIONS = 6  # iterations from a configuration to one near it
_STARTS = 4  # arms that are tried for each base
_MIDDLES = (0.5, 0.5, 0.25, 0.5, 0.0)  # shares of the motion from which arms of successive batches follow it
_WHOLE = 300
"""Number of bases after which a path to a part of the motion is taken, and after which the search ends if no
arm has reached the handle anywhere: at the middle of its motion, or at a quarter of it."""
_NOWHERE = 300  # number of bases after which the search ends if each one touched something
_AROUND, _HERE = 0.6, 100  # distance of the hand up to which the base may stay [m], and number of arms there
_LEAST_SHARE = 0.2  # least share of the motion that one grasp is for
_MOST_CHECKS, _MOST_REFUSED = 150, 3  # most paths checked after a batch, and most that may be refused


class PlacementSearch:
    """Search of base placements for a gripper of a robot in a model.

    Parameters
    ----------
    model
        Model of the robot and of everything around it.
    robot
        The robot, or the prefix of its names.
    gripper
        The gripper that is to hold the object.
    state
        State of everything; the robot's idle coordinates keep these values.
    margin
        Least distance of the robot from everything else on its way [m].

    Attributes
    ----------
    moving, standing
        Coordinates that move along paths, and those of a base that only stands somewhere.
    scene
        Scene of the checks, with the rules for pairs that overlap always.

    Examples
    --------
    >>> model = kv.load("hsr")
    >>> tags = model.include("kitchen")
    >>> gripper = kv.grasping.find_gripper(model, "hsr")
    >>> handle = kv.grasping.find_handle(model, "kitchen/fridge_door")
    >>> state = model.default_state()
    >>> search = kv.manipulation.PlacementSearch(model, "hsr", gripper, state)
    >>> grasps = kv.grasping.sample_grasps(model, gripper, handle, count=16)
    >>> placement = search.find(state, grasps, 0.3)
    >>> bool(placement), placement.values[-1].round(2)
    (True, np.float64(0.3))
    """

    def __init__(
        self, model: ModelView, robot: Robot | str, gripper: Gripper, state: State, margin: float = 0.006
    ) -> None:
        self.model, self.gripper, self.margin = model, gripper, margin
        self.robot = robot = Robot.of(model, robot)
        symbols = model.symbols_of(gripper.hand)
        free = {s for s in symbols if s in model.degrees_of_freedom and s not in gripper.joints}
        self.standing = tuple(s for s in symbols if s in model.rates and s in free)
        self.moving = tuple(s for s in symbols if s in free and s not in self.standing)
        self.base = robot.planar_base if {*robot.planar_base} <= {*symbols} else ()
        self.coordinates = (*self.moving, *self.standing)
        self.samples = PlacementSampler(model, self.moving, self.standing, self.base)
        self.paths = CartesianPaths(model, gripper.hand, self.moving, self.standing, self.samples.eases[0])
        self.scene = Scene(model)
        bodies = self.scene.bodies
        self.robot_bodies = tuple(b for b in bodies if robot.owns(b))
        others = tuple(b for b in bodies if not robot.owns(b))
        if not others:
            raise InvalidValueError("The model has nothing but the robot, so there is nothing to hold.")
        self.others = others
        add_rules = self.scene.collision_world.add_rules
        overlapping = find_overlapping_links(self.scene, self.robot_bodies, state)
        add_rules((*overlapping, *furniture_rules(bodies, self.robot_bodies)))
        add_rules(self.scene.find_always_colliding(self._random_states(state), OWN_MARGIN))
        self.contacts = PathContacts(self.scene, gripper, self.robot_bodies, others, margin)
        self.bases = BaseSampler(self.scene, robot, self.base, margin)
        self._reach: float | None = None

    def _random_states(self, state: State) -> Iterator[State]:
        """Yield states with random arms, and the base a little off its place.

        So what is always near is the robot's own or the floor, and not a wall that it stands at.
        """
        random = np.random.default_rng(0)
        bounded = [s for s in self.moving if np.isfinite(self.model.limits(s)).all() and s not in self.base]
        lower, upper = np.array([self.model.limits(s) for s in bounded]).reshape(-1, 2).T
        for _ in range(_RANDOM_STATES):
            arm = dict(zip(bounded, random.uniform(lower, upper).tolist(), strict=True))
            off = random.uniform(-_OFFSET, _OFFSET, len(self.base)).tolist()
            yield state.updated(arm | {s: state[s] + by for s, by in zip(self.base, off, strict=True)})

    def find_too_high(self, state: State, coordinate: Symbol, values: Array) -> str:
        """Return why an object is out of reach above the hand at some of its values; empty if it is not."""
        moved = [b for b in self.scene.bodies_moved_by([coordinate]) if b in self.others]
        value, lowest = find_highest_passage(self.scene, moved, state, coordinate, values)
        if self._reach is None:
            self._reach = find_highest_reach(self.scene, self.paths, self.gripper, state)
        if lowest <= self._reach:
            return ""
        return (
            f"Too high: at {value:.3f} '{coordinate}' is nowhere lower than {lowest:.2f} m, and "
            f"'{self.gripper.hand}' reaches {self._reach:.2f} m at most."
        )

    def find(
        self,
        state: State,
        grasps: Sequence[Grasp],
        target: float | Way,
        *,
        accept: Callable[[BasePlacement], bool] = lambda placement: True,
        stays: bool = False,
        samples: int = 600,
        batch: int = 100,
        seed: int = 0,
        report: Callable[[str], object] = lambda text: None,
    ) -> BasePlacement:
        """Return a placement from which the object can be moved from its value to a target, or towards it.

        Bases are sampled in front of the handle, arms at random. Where none of the first batch leads to the
        target and the hand is near, so that it has just let go, the base may stay as well. All of them
        follow the path of the handle at once, and the straight paths to it and from it; those that arrive are
        checked for contacts, the quickest first. Where none of many bases arrives, the one with the longest
        path is returned. The search ends early if no arm reaches the handle anywhere, or if the base touches
        something at all of the first places.

        Parameters
        ----------
        state
            State of everything at the beginning.
        grasps
            Grasps that may be taken, the best first.
        target
            Wanted value of the object's coordinate [m], [rad], or the whole way of the handle.
        accept
            Function that says whether a placement is taken; the search goes on if not.
        stays
            Whether a mobile base stays where it is.
        samples, batch
            Largest number of bases, and how many are tried at once.
        seed
            Seed of the samples.
        report
            Is called with a text on the progress after each batch.

        Raises
        ------
        InvalidValueError
            For less than one sample.
        """
        samples, batch = as_count("samples", samples, 1), as_count("batch", batch, 1)
        random = np.random.default_rng(as_count("seed", seed, 0))
        search = _Search(self, state, grasps, target, accept, random, stands=stays or not self.base)
        if search.stands:
            samples = batch
        for number in count():
            whole = number * batch < min(_WHOLE, samples)
            result = search.take(whole)
            ended = number * batch >= samples or (not whole and not search.reached)
            ended = ended or (number * batch >= _NOWHERE and search.nowhere)
            if number and result is None and not ended:
                report(search.nothing.why)
            if result is not None or ended or search.refused >= _MOST_REFUSED:
                break
            self.paths.ease = self.samples.eases[number % len(self.samples.eases)]
            if stays:
                search.add_here(batch * _STARTS)
                continue
            search.add(min(batch, samples - number * batch), _MIDDLES[number % len(_MIDDLES)])
            if number == 1 and search.is_near:
                search.add_here(_HERE)
        return result or search.nothing

    def retrace(
        self,
        state: State,
        earlier: BasePlacement,
        target: float | Way,
        accept: Callable[[BasePlacement], bool] = lambda placement: True,
    ) -> BasePlacement | None:
        """Return the path of an earlier placement backwards, from the object's value to a target.

        What was possible once is possible backwards, also where an open door leaves no path to another place.
        Contacts are checked again, and None is returned if there are any.

        Parameters
        ----------
        state
            State of everything at the beginning.
        earlier
            Placement whose path leads back to the target, see :meth:`.BasePlacement.find_end_backwards`.
        target, accept
            As for :meth:`find`.

        Raises
        ------
        InvalidValueError
            For a placement of another hand, or one that was not found.
        """
        grasp = earlier.grasp
        if grasp is None or grasp.gripper.hand != self.gripper.hand:
            raise InvalidValueError(f"The earlier placement must be one of '{self.gripper.hand}'.")
        self.paths.ease = self.samples.eases[0]
        return _Search(self, state, [grasp], target, accept, np.random.default_rng(0)).retrace(earlier)


class _Search:
    """Search for one grasped motion: candidates, the best first, and why the others failed."""

    def __init__(
        self,
        owner: PlacementSearch,
        state: State,
        grasps: Sequence[Grasp],
        target: float | Way,
        accept: Callable[[BasePlacement], bool],
        random: np.random.Generator,
        stands: bool = False,
    ) -> None:
        self.stands = stands
        self.owner, self.state, self.grasps, self.random = owner, state, grasps, random
        self.begin, self.tried, self.reached = perf_counter(), 0, False
        self.nowhere = not stands
        self.accept, self.refused = accept, 0
        coordinate = grasps[0].handle.coordinate
        if not isinstance(target, Way):
            target = Way.straight(coordinate, float(state[coordinate]), float(target))
        self.way = way = target
        self.last = len(way) - 1
        # What is not past its latch when it is let go is latched again.
        self.least = max(1, way.last_run + math.ceil(_LEAST_SHARE * (self.last - way.last_run)))
        handle = owner.model.fk(grasps[0].handle.frame)
        self.handles = np.array([handle(state.updated(way.at(k))) for k in range(len(way))])
        self.poses = np.array([grasp.pose for grasp in grasps])
        self.approaches = np.array([grasp.approach for grasp in grasps])
        self.check = PathCheck(owner.contacts, owner.paths, state, grasps, way, self.handles)
        self.free, self.reasons = self.check.free, self.check.reasons
        self.heap: list[tuple[int, float, int, CandidatePath]] = []
        self.number = count()

    @property
    def nothing(self) -> BasePlacement:
        none = np.zeros((0, len(self.owner.coordinates)))
        return BasePlacement(
            None, self.owner.coordinates, none, none, self.way, none, none, self.tried, self.reasons,
            perf_counter() - self.begin, self.stands,
        )  # fmt: skip

    # -- sampling ------------------------------------------------------------------------------------------

    @property
    def is_near(self) -> bool:
        hand = np.asarray(self.owner.model.fk(self.grasps[0].gripper.hand)(self.state))
        return bool(np.linalg.norm(hand[:3, 3] - self.handles[0, :3, 3]) <= _AROUND)

    def add_here(self, count: int) -> None:
        """Sample arms and grasps where the base stands."""
        samples = self.owner.samples
        self.tried += count // _STARTS if self.stands else 0
        choice = samples.choose_grasps(self.random, self.grasps, self.free, count, True)
        if len(choice):
            self._keep(*samples.stay(self.random, self.state, count), choice, 0)

    def add(self, batch: int, middle_share: float) -> None:
        """Sample bases, arms and grasps, and keep those that reach along the path."""
        paths, handles = self.owner.paths, self.handles
        middle = round(middle_share * self.last)
        samples = self.owner.samples
        choice = samples.choose_grasps(self.random, self.grasps, self.free, batch * _STARTS, not self.tried)
        self.tried += batch
        if not len(choice):
            return
        hands = handles[middle] @ self.poses[choice]
        outside = handles[middle] @ self.approaches[choice]
        # A base that stands has to be free along the whole motion.
        stops = (middle, 0, self.last) if samples.stands(paths.ease) else (middle,)
        states = [self.state.updated(self.way.at(k)) for k in stops]
        Q, base = samples.draw(self.random, states, hands, outside, _STARTS, self.owner.bases)
        if self.nowhere:
            places = samples.find_places(Q, base)[::_STARTS]
            self.nowhere = bool(self.owner.bases.find_touching(states, places).all())
            if self.nowhere:
                self.reasons[NO_PLACE] += len(places)
                return
        self._keep(Q, base, choice, middle)

    def _keep(self, Q: Array, base: Array, choice: npt.NDArray[np.intp], middle: int) -> None:
        """Keep those arms (N, n) that reach along the path, from a value with the index ``middle`` on."""
        paths, handles = self.owner.paths, self.handles
        Q, error = paths.solve(Q, base, handles[middle] @ self.poses[choice], _START_ITERATIONS)
        good = self._count(error < 1e-3, "out of reach")
        self.reached |= bool(good.any())
        Q, base, choice = Q[good], base[good], choice[good]
        before, reached = paths.follow(Q, base, handles[None, middle::-1] @ self.poses[choice, None])
        good = self._count(reached == middle + 1, "the arm ends on the way")
        Q, base, choice, before = Q[good], base[good], choice[good], before[good]
        line = interpolate_poses(handles[0] @ self.poses[choice], handles[0] @ self.approaches[choice])
        back, reached = paths.follow(before[:, -1], base, line)
        good = self._count(reached == line.shape[1], "no straight approach")
        Q, base, choice, before, back = Q[good], base[good], choice[good], before[good], back[good]
        poses = self.poses[choice]
        after, passed = paths.follow(Q, base, handles[None, middle:] @ poses[:, None])
        ends = np.minimum(middle + passed - 1, self.free[choice])
        good = self._count(ends >= self.least, "the arm ends on the way")
        path = np.concatenate([before[:, :0:-1], after], axis=1)
        if not good.any():
            return
        score = self.owner.samples.cost(self.state, path, back[:, -1], ends) + 0.02 * choice
        for k in np.flatnonzero(good):
            self._push(
                CandidatePath(int(choice[k]), base[k], back[k], path[k], int(ends[k])), float(score[k])
            )

    def _count(self, good: npt.NDArray[np.bool_], reason: str) -> npt.NDArray[np.bool_]:
        self.reasons[reason] += int((~good).sum()) // _STARTS
        return good

    def _push(self, candidate: CandidatePath, score: float) -> None:
        heappush(self.heap, (-candidate.end, score, next(self.number), candidate))

    def retrace(self, earlier: BasePlacement) -> BasePlacement | None:
        """Return the path of an earlier placement backwards, without contacts; None if there is none."""
        paths, count = self.owner.paths, len(self.owner.moving)
        base = earlier.path[0, count:]
        order = np.argsort(earlier.values)
        values = self.way.values[:, -1]
        rows = [np.interp(values, earlier.values[order], q[order]) for q in earlier.path.T[:count]]
        hands = self.handles @ self.poses[0]
        path = self._correct(np.stack(rows, axis=1), base, hands)
        # The hand comes on the path on which it left, at the same place at the handle.
        retreat = earlier.retreat[:, :count]
        poses = paths.find_poses(retreat, base)
        back = self._correct(retreat, base, hands[0] @ np.linalg.inv(poses[0]) @ poses)
        if path is None or back is None:
            return None
        result = self._check(CandidatePath(0, base, back, path, self.last))
        if result is None or len(result.way) <= self.last or not self.accept(result):
            return None
        return result

    def _correct(self, Q: Array, base: Array, poses: Array) -> Array | None:
        """Return configurations near to some (K, n) at which the hand is at poses; None if one fails."""
        result, error = self.owner.paths.solve(Q, np.tile(base, (len(Q), 1)), poses, _CORRECTIONS)
        return result if error.max() < TOLERANCE else None

    # -- checks --------------------------------------------------------------------------------------------

    def take(self, whole: bool) -> BasePlacement | None:
        """Return the best candidate without contacts, None without any."""
        for _ in range(_MOST_CHECKS):
            if not self.heap or (whole and -self.heap[0][0] < self.last) or self.refused >= _MOST_REFUSED:
                break
            _, score, _, candidate = heappop(self.heap)
            free = int(self.free[candidate.choice])
            if candidate.end <= free:
                result = self._check(candidate)
                if result is not None and self.accept(result):
                    return result
                if result is not None:
                    self.refused += 1
                    self.reasons[NO_PATH] += 1
                    continue
            candidate.end = min(candidate.end, int(self.free[candidate.choice]))
            if candidate.end >= self.least:
                self._push(candidate, score)
        return None

    def _check(self, candidate: CandidatePath) -> BasePlacement | None:
        """Return the placement of a candidate without contacts; otherwise shorten its path."""
        retreat = self.check.find_retreat(candidate)
        if retreat is None:
            return None
        end, base = candidate.end, candidate.base
        parts = (candidate.back[::-1], candidate.path[: end + 1], retreat)
        full = [np.hstack([a, np.tile(base, (len(a), 1))]) for a in parts]
        return BasePlacement(
            self.grasps[candidate.choice], self.owner.coordinates, full[0][0], full[0],
            self.way.cut(0, end + 1), full[1], full[2], self.tried, self.reasons, perf_counter() - self.begin,
        )  # fmt: skip
