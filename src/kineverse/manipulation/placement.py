"""Base placement: a base, a grasp and a way of the arm along which a held object can be moved."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.prepared_query import PreparedQuery
from kineverse.grasping import Grasp, Gripper
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .hand_paths import HandPaths
from .push_scene import find_overlapping_links, furniture_rules

_NEAREST, _FARTHEST = 0.3, 1.1
"""Distance of a base from the hand [m]."""
_SIDE, _TURN = math.radians(80.0), math.radians(60.0)
"""Largest angles of a base beside the approach of the hand, and of its front beside the hand [rad]."""
_BASE_EASE = 0.1
"""Weight of a base that can move beside those of joints, so that it moves where they are not enough."""
_STEP = 0.05
"""Distance of neighbouring values of the object along its way [m], [rad]."""
_LINE = 5
_OWN_MARGIN, _RANDOM_STATES = 0.003, 24
"""Least distance of the robot's own links [m]; pairs that are nearer in all of some states do not count."""
_START_ITERATIONS = 30
_BETWEEN = 4
"""Number of samples between neighbouring configurations that are checked."""
_STARTS = 4
"""Arms that are tried for each base."""


@dataclass(frozen=True, slots=True, eq=False)
class BasePlacement:
    """Base, grasp and way of the arm, true if they were found.

    Attributes
    ----------
    grasp
        The grasp; None if nothing was found.
    coordinates
        Coordinates (n,) of the robot: base and arm.
    approach, line
        Configuration (n,) before the hand is at the handle, and those (L, n) from there to the grasp.
    values, way
        Values (K,) of the object's coordinate [m], [rad], and configurations (K, n) of the robot there.
    samples
        Number of sampled bases.
    reasons
        Number of samples by the reason of their failure.
    seconds
        Duration of the search [s].
    """

    grasp: Grasp | None
    coordinates: tuple[Symbol, ...]
    approach: Array
    line: Array
    values: Array
    way: Array
    samples: int
    reasons: Counter[str]
    seconds: float

    def __bool__(self) -> bool:
        return self.grasp is not None

    @property
    def why(self) -> str:
        """Text with the number of samples and the reasons of failures."""
        failed = ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common(6))
        found = f"Found after {self.samples} bases" if self else f"None of {self.samples} bases goes through"
        return f"{found}; failed: {failed}." if failed else f"{found}."


class PlacementSearch:
    """Search of base placements for a gripper of a robot in a model.

    Parameters
    ----------
    model
        Model of the robot and of everything around it.
    gripper
        The gripper.
    state
        State of everything; the robot's idle coordinates keep these values.
    margin
        Least distance of the robot from everything else on its way [m].

    Attributes
    ----------
    moving, standing
        Coordinates that move along ways, and those of a base that only stands somewhere.
    scene
        Scene of the checks, with the rules for pairs that overlap always.
    """

    def __init__(self, model: ModelView, gripper: Gripper, state: State, margin: float = 0.006) -> None:
        self.model, self.gripper, self.margin = model, gripper, margin
        own = model.symbols_of(gripper.hand)
        free = {s for s in own if s in model.degrees_of_freedom and s not in gripper.joints}
        self.standing = tuple(s for s in own if s in model.rates and s in free and not _is_free(model, s))
        self.moving = tuple(s for s in own if s in free and s not in self.standing)
        self.base = find_planar_base(model, own)
        ease = np.array([_BASE_EASE if s in self.base else 1.0 for s in self.moving])
        self.paths = HandPaths(model, gripper.hand, self.moving, self.standing, ease)
        self.coordinates = (*self.moving, *self.standing)
        self.scene = Scene(model)
        prefix = f"{gripper.robot}/" if gripper.robot else ""
        bodies = self.scene.bodies
        self.own = tuple(b for b in bodies if b.startswith(prefix) and prefix)
        others = tuple(b for b in bodies if b not in self.own)
        if not others:
            raise InvalidValueError("The model has nothing but the robot, so there is nothing to hold.")
        self.others = others
        rules = (
            *find_overlapping_links(self.scene, self.own, state),
            *furniture_rules(bodies, self.own),
        )
        self.scene = Scene(model, rules=rules)
        near = self.scene.find_always_colliding(self._random_states(state), _OWN_MARGIN)
        rules = (*rules, *near)
        self.scene = Scene(model, rules=rules)

    def _random_states(self, state: State) -> Iterator[State]:
        """Yield states with random arms."""
        random = np.random.default_rng(0)
        bounded = [s for s in self.moving if np.isfinite(self.model.limits(s)).all() and s not in self.base]
        lower, upper = np.array([self.model.limits(s) for s in bounded]).reshape(-1, 2).T
        for _ in range(_RANDOM_STATES):
            yield state.updated(dict(zip(bounded, random.uniform(lower, upper).tolist(), strict=True)))

    def find(
        self,
        state: State,
        grasps: Sequence[Grasp],
        target: float,
        *,
        samples: int = 1000,
        batch: int = 100,
        seed: int = 0,
    ) -> BasePlacement:
        """Return a placement from which the object can be moved from its value to a target.

        Bases are sampled in front of the handle, arms at random. All of them follow the approach and the way
        of the handle at once; then those that arrive are checked for contacts, the roomiest first.

        Parameters
        ----------
        state
            State of everything at the beginning.
        grasps
            Grasps that may be taken, the best first.
        target
            Wanted value of the object's coordinate [m], [rad].
        samples, batch
            Largest number of bases, and how many are tried at once.
        seed
            Seed of the samples.
        """
        begin, reasons = perf_counter(), Counter[str]()
        random = np.random.default_rng(seed)
        coordinate = grasps[0].handle.coordinate
        values = _divide(state[coordinate], target)
        handle = self.model.fk(grasps[0].handle.frame)
        handles = np.array([handle(state.updated({coordinate: v})) for v in values])
        tried, middle = 0, len(values) // 2
        if not self.base:
            samples = batch
        while tried < samples:
            choice = self._choose(random, grasps, batch * _STARTS, upright=not tried)
            poses = np.array([grasps[k].pose for k in choice])
            approaches = np.array([grasps[k].approach for k in choice])
            tried += batch
            Q, base = self._sample(random, state, handles[middle] @ poses, handles[middle] @ approaches)
            Q, error = self.paths.solve(Q, base, handles[middle] @ poses, _START_ITERATIONS)
            good = error < 1e-3
            reasons["out of reach"] += int((~good).sum()) // _STARTS
            Q, base, poses, approaches = (a[good] for a in (Q, base, poses, approaches))
            choice = choice[good]
            before, reached = self.paths.follow(Q, base, handles[None, middle::-1] @ poses[:, None])
            after, passed = self.paths.follow(Q, base, handles[None, middle:] @ poses[:, None])
            good = (reached == before.shape[1]) & (passed == after.shape[1])
            reasons["the arm ends on the way"] += int((~good).sum()) // _STARTS
            way = np.concatenate([before[:, :0:-1], after], axis=1)[good]
            base, poses, approaches = (a[good] for a in (base, poses, approaches))
            choice = choice[good]
            line = _interpolate(handles[0] @ poses, handles[0] @ approaches)
            back, reached = self.paths.follow(way[:, 0], base, line)
            good = reached == line.shape[1]
            reasons["no straight approach"] += int((~good).sum()) // _STARTS
            base, back, way = (a[good] for a in (base, back, way))
            choice = choice[good]
            for k in self._rank(way, choice):
                problem = self._check(state, grasps[choice[k]], values, base[k], back[k], way[k])
                if not problem:
                    full = [np.hstack([a, np.tile(base[k], (len(a), 1))]) for a in (back[k][::-1], way[k])]
                    return BasePlacement(
                        grasps[choice[k]], self.coordinates, full[0][0], full[0], values, full[1],
                        tried, reasons, perf_counter() - begin,
                    )  # fmt: skip
                reasons[problem] += 1
        nothing = np.zeros((0, len(self.coordinates)))
        return BasePlacement(
            None, self.coordinates, nothing, nothing, values, nothing, tried, reasons, perf_counter() - begin
        )

    def _choose(
        self, random: np.random.Generator, grasps: Sequence[Grasp], count: int, upright: bool
    ) -> npt.NDArray[np.intp]:
        """Return indices (N,) of grasps: good ones mostly, or all tilts alike."""
        if upright:
            chosen = random.geometric(min(1.0, 4.0 / len(grasps)), count) - 1
            return np.where(chosen < len(grasps), chosen, random.integers(len(grasps), size=count)).astype(
                int
            )
        # Some ways need a hand that comes from above or from the side, and few grasps are such.
        tilts = np.array([grasp.tilt for grasp in grasps])
        wanted = random.uniform(tilts.min(), tilts.max(), count)
        order = np.argsort(tilts, kind="stable")
        near = np.searchsorted(tilts[order], wanted) + random.integers(-2, 3, count)
        return np.asarray(order[np.clip(near, 0, len(grasps) - 1)])

    def _sample(
        self, random: np.random.Generator, state: State, hands: Array, approaches: Array
    ) -> tuple[Array, Array]:
        """Return random arms (N, n), and bases (N, m) in front of poses of the hand (N, 4, 4)."""
        count = len(hands)
        bounded = np.isfinite(self.paths.lower) & np.isfinite(self.paths.upper)
        here = state.vector(self.moving)
        lower = np.where(bounded, self.paths.lower, here - math.pi)
        upper = np.where(bounded, self.paths.upper, here + math.pi)
        Q = random.uniform(lower, upper, (count, len(self.moving)))
        still = np.tile(state.vector(self.standing), (count, 1))
        if self.base:
            out = (approaches - hands)[:, :2, 3]
            angle = np.where(
                np.hypot(*out.T) > 0.02, np.arctan2(out[:, 1], out[:, 0]), random.uniform(-3.2, 3.2, count)
            )
            angle = np.repeat((angle + random.uniform(-_SIDE, _SIDE, count))[::_STARTS], _STARTS)[:count]
            distance = np.repeat(random.uniform(_NEAREST, _FARTHEST, count)[::_STARTS], _STARTS)[:count]
            turn = np.repeat(random.uniform(-_TURN, _TURN, count)[::_STARTS], _STARTS)[:count]
            place = hands[:, :2, 3] + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            values = np.column_stack([place, angle + math.pi + turn])
            for k, s in enumerate(self.base):
                columns, array = (self.moving, Q) if s in self.moving else (self.standing, still)
                array[:, columns.index(s)] = values[:, k]
        return Q, still

    def _rank(self, way: Array, choice: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Return the order in which ways are checked: good grasps, far from limits, with little motion."""
        if not len(way):
            return np.zeros(0, dtype=int)
        width = self.paths.upper - self.paths.lower
        width = np.where(np.isfinite(width), width, 1e9)
        room = np.minimum(way - self.paths.lower, self.paths.upper - way) / width
        travel = np.abs(np.diff(way, axis=1)).sum(axis=(1, 2))
        score = travel - 40.0 * np.minimum(room.min(axis=(1, 2)), 0.1) + 0.02 * choice
        return np.argsort(score, kind="stable")

    def _check(self, state: State, grasp: Grasp, values: Array, base: Array, back: Array, way: Array) -> str:
        """Return the pair that touches on a way, empty if it is free."""
        coordinate, fingers = grasp.handle.coordinate, self.gripper.joints
        columns = (*self.coordinates, *fingers, coordinate)

        def rows(Q: Array, gap: dict[Symbol, float], where: Array) -> Array:
            full = np.hstack(
                [
                    Q,
                    np.tile(base, (len(Q), 1)),
                    np.tile([gap[s] for s in fingers], (len(Q), 1)),
                    where[:, None],
                ]
            )
            share = np.arange(_BETWEEN) / _BETWEEN
            dense = full[:-1, None] + share[:, None] * (full[1:] - full[:-1])[:, None]
            return np.vstack([dense.reshape(-1, full.shape[1]), full[-1:]])

        opened = {s: self.gripper.opened[s] for s in fingers}
        holding = self.gripper.values_at(grasp.thickness)
        here = [state.vector(self.moving)[None]] if self.standing else []
        parts = (
            *(rows(home, opened, values[:1]) for home in here),
            rows(back[::-1], opened, np.full(len(back), values[0])),
            rows(way, holding, values),
            rows(back[:1], opened, values[:1]),
        )
        around, inside = self.watches(grasp)
        for part in reversed(parts):
            self.scene.update(state.updated(dict(zip(columns, part[0].tolist(), strict=True))))
            for watch, radius in (around, self.margin), (inside, _OWN_MARGIN):
                if watch.first_within(columns, part, radius) is not None:
                    pair = watch(radius)[0]
                    return f"{pair.a} at {pair.b}"
        return ""

    def watches(self, grasp: Grasp) -> tuple[PreparedQuery, PreparedQuery]:
        """Return the queries of the robot's distance from everything else, and of its own links."""
        frame = grasp.handle.frame
        if frame not in self._watches:
            allowed = [Rule(b, frame, False, "grasped") for b in self.gripper.bodies]
            self._watches[frame] = (
                self.scene.watch(self.own, self.others, self.margin, rules=allowed),
                self._own_watch,
            )
        return self._watches[frame]

    @cached_property
    def _watches(self) -> dict[str, tuple[PreparedQuery, PreparedQuery]]:
        return {}

    @cached_property
    def _own_watch(self) -> PreparedQuery:
        return self.scene.watch(self.own, self.own, _OWN_MARGIN)


def find_planar_base(model: ModelView, symbols: Sequence[Symbol]) -> tuple[Symbol, ...]:
    """Return the coordinates x, y and angle of a mobile base among some; empty without one."""
    for joint in model.articulations.values():
        names = tuple(s.path.rpartition("/")[2] for s in joint.coordinates)
        if names == ("x", "y", "angle") and {*joint.coordinates} <= {*symbols}:
            return tuple(joint.coordinates)
    return ()


def _is_free(model: ModelView, symbol: Symbol) -> bool:
    """Return True if a coordinate moves by a speed of its own."""
    return symbol not in model.rates


def _divide(start: float, end: float) -> Array:
    """Return values from a start to an end, close enough for the arm to follow."""
    return np.linspace(start, end, max(2, math.ceil(abs(end - start) / _STEP) + 1))


def _interpolate(a: Array, b: Array) -> Array:
    """Return poses (N, L, 4, 4) on the straight way between poses of one orientation, a first."""
    share = np.linspace(0.0, 1.0, _LINE)
    poses = np.repeat(a[:, None], _LINE, axis=1)
    poses[:, :, :3, 3] += share[:, None] * (b - a)[:, None, :3, 3]
    return poses
