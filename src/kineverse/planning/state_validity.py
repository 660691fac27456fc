"""Validity of configurations and paths: by the collision scene, and by the compiled check of a planner."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock
from kineverse.compilation.build_queue import working_seconds
from kineverse.errors import InvalidValueError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.results import DistanceResult, DistanceResults
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .collision_checker import RESOLUTION, BodyPairs, CollisionChecker, LateCheckError

if TYPE_CHECKING:
    from .manifold import Manifold

_AT_ONCE = 512  # number of samples between two looks at the clock
_ROUNDING = 1e-6
_TOUCHING = 5e-5  # depth up to which a contact is called a touch [m]


class SceneJudge:
    """Contacts of configurations of some coordinates, by the scene."""

    def __init__(self, scene: Scene, coordinates: Sequence[Symbol], rules: Sequence[Rule]) -> None:
        self._scene, self._coordinates = scene, tuple(coordinates)
        self._query = scene.watch(moving=coordinates, rules=rules, radius=0.0)
        place = {s: k for k, s in enumerate(scene.inputs)}
        self._columns = np.array([place.get(s, -1) for s in coordinates], dtype=int)
        self._moved = self._columns >= 0
        self._values = np.zeros(len(scene.inputs))
        self._state: State | None = None

    def place(self, state: State) -> None:
        """Set the values of everything else."""
        if state is not self._state:
            self._state = state
            self._values[:] = state.vector(self._scene.inputs)

    def contacts(self, q: Array, radius: float = 0.0) -> DistanceResults:
        """Return the pairs of bodies within a radius [m] at a configuration (n,), deepest first."""
        self._update(q)
        return self._query(radius)

    def _update(self, q: Array) -> None:
        self._values[self._columns[self._moved]] = q[self._moved]
        self._scene.update(self._values)

    def first_contact(
        self, points: Array, step: float, until: float = math.inf
    ) -> tuple[Array, DistanceResult] | None:
        """Return the first sample of a polyline (N, n) with a contact, and the contact."""
        if not len(points):
            return None
        samples = sample_path(points, step)
        for begin in range(0, len(samples), _AT_ONCE):
            some = samples[begin : begin + _AT_ONCE]
            self._update(some[0])
            k = self._query.first_within(self._coordinates, some)
            if k is not None:
                return some[k], self._query()[0]
            if working_seconds() > until:
                raise LateCheckError
        return None

    def clearance(self, points: Array, step: float) -> float:
        """Return the least distance of a pair at samples of a polyline [m]; infinite beyond .5 m."""
        samples = densify(points, step)
        self._update(samples[0])
        return self._query.least_distance(self._coordinates, samples, 0.5)


class PathChecks:
    """Checks of configurations in the surroundings of a path, wherever things are placed now."""

    def __init__(
        self,
        model: ModelView,
        state: State,
        checker: CollisionChecker,
        judge: SceneJudge,
        manifold: Manifold | None,
        touching: BodyPairs,
        restore: Callable[[], None],
        lock: CallLock,
    ) -> None:
        self.model, self.state, self._version = model, state, model.version
        self._checker, self._judge, self._manifold = checker, judge, manifold
        self._targets = None if manifold is None else manifold.targets
        self._touching, self._restore, self._lock = touching, restore, lock

    def clearance(self, points: Array) -> float:
        """Return the least signed distance of bodies along a polyline (N, n) by the scene [m]."""
        self.ensure_current()
        with self._lock:
            self._judge.place(self.state)
            return self._judge.clearance(points, 1 / RESOLUTION)

    def ensure_current(self) -> None:
        """Ensure that the model is the one for which the path was planned."""
        if self.model.version != self._version:
            raise InvalidValueError("The model has been edited since this path was planned. Plan it again.")

    @contextmanager
    def placed(self, points: Array) -> Iterator[None]:
        """Place the checker for a path, with limits about its points (N, n), while the context lasts."""
        checker = self._checker
        with self._lock:
            limits = checker.lower.copy(), checker.upper.copy()
            checker.place(self.state)
            if self._manifold is not None and self._targets is not None:
                self._manifold.place(self.state, self._targets)
            narrow = points.astype(np.float32)
            checker.lower[:] = narrow.min(axis=0) - _ROUNDING
            checker.upper[:] = narrow.max(axis=0) + _ROUNDING
            try:
                with checker.excepting(self._touching):
                    yield
            finally:
                checker.lower[:], checker.upper[:] = limits
                self._restore()

    def valid(self, Q: Array, residual: float) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of configurations (N, n) that are free and meet holds up to a residual."""
        flags = self._checker.valid(np.ascontiguousarray(Q, dtype=np.float32))
        if self._manifold is not None:
            flags &= self._manifold.residuals(Q) <= residual
        return flags

    def find_collision(self, points: Array) -> int | None:
        """Return the first edge of a polyline (N, n) that is not certainly free; None if all are."""
        result = self._checker.find_collision(np.ascontiguousarray(points, dtype=np.float32))
        return None if result is None else result[0]


def describe_contacts(contacts: Sequence[DistanceResult]) -> str:
    """Name touching pairs of bodies, with the depth of their penetration."""
    depths = [
        f"{-1e3 * c.distance:.1f} mm deep" if -c.distance >= _TOUCHING else "touching" for c in contacts
    ]
    pairs = [f"'{c.a}' and '{c.b}' ({depth})" for c, depth in zip(contacts, depths[:3], strict=False)]
    more = f" and {len(contacts) - 3} more pairs" if len(contacts) > 3 else ""
    return ", ".join(pairs) + more


def densify(points: Array, step: float) -> Array:
    """Return the points of a polyline (N, n) with others between them, at most a step apart."""
    return _interpolate(points, np.arange(float(len(points))), dense_places(points, step))


def dense_places(points: Array, step: float) -> Array:
    """Return the places of these on the polyline: indices of its points, and fractions between them."""
    if len(points) < 2:
        return np.zeros(len(points))
    counts = np.maximum(np.ceil(np.diff(lengths_along(points)) / step), 1).astype(int)
    ends = np.cumsum(counts)
    shares = (np.arange(ends[-1]) - np.repeat(ends - counts, counts)) / np.repeat(counts, counts)
    return np.append(np.repeat(np.arange(len(counts)), counts) + shares, len(counts))


def sample_path(points: Array, step: float) -> Array:
    """Return samples of a polyline (N, n), at most a step apart: its points and others, or some of many."""
    along = lengths_along(points)
    count = int(np.ceil(along[-1] / step)) + 1
    if len(points) <= 4 * count:
        return densify(points, step)
    return _interpolate(points, along, np.linspace(0.0, along[-1], count))


def lengths_along(points: Array) -> Array:
    """Return the lengths (N,) of a polyline from its first point to each."""
    return np.append(0.0, np.cumsum(np.sqrt(((points[1:] - points[:-1]) ** 2).sum(axis=1))))


def _interpolate(points: Array, along: Array, at: Array) -> Array:
    """Return rows of a polyline (N, n) with knots at (N,), at places (M,) from the first to the last."""
    lengths = along[1:] - along[:-1]
    slopes = np.zeros(points.shape)
    slopes[:-1] = (points[1:] - points[:-1]) / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    k = np.searchsorted(along, at, side="right") - 1
    return np.asarray(slopes[k] * (at - along[k])[:, None] + points[k])
