"""Selection of a grasp, an arm and a base in front of a handle: random samples, and costs of their paths."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.grasping import Grasp
from kineverse.lie import Array
from kineverse.manipulation.base_sampling import BaseSampler
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

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
