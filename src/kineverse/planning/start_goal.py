"""Starts and goals of a plan: checks, and sampling of configurations that meet holds and goals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.compilation.build_queue import working_seconds
from kineverse.lie import Array

from .collision_checker import CollisionChecker
from .manifold import EXACT, Manifold
from .planning_space import PlanningSpace
from .query import unique_rows
from .state_validity import SceneJudge, describe_contacts

_LIMIT = 1e-6
_ROUNDING = 1e-5
_SAMPLES, _ENOUGH = 4096, 50
"""Number of random configurations, and of free ones among them that are enough to find barriers."""
_NEAR = 0.01  # largest residual of an end that is brought onto a manifold [m], [rad]


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Start or goal of a plan."""

    q: Array  # configuration (n,), on the manifold if there is one
    reason: str = ""  # why it cannot be used; empty if it can


class Endpoints:
    """Checks of starts and goals."""

    def __init__(
        self, space: PlanningSpace, checker: CollisionChecker, judge: SceneJudge, manifold: Manifold | None
    ) -> None:
        self._space, self._checker, self._judge, self._manifold = space, checker, judge, manifold

    def check(self, what: str, q: Array) -> Endpoint:
        """Check a start or goal (n,); return it with the reason why it cannot be used."""
        outside = self._beyond_limits(q)
        if outside:
            return Endpoint(q, f"{what} is out of limits: {outside}.")
        if self._manifold is not None:
            original = q
            off = float(self._manifold.residuals(q[None])[0])
            if off <= _NEAR:
                points, residuals = self._manifold.polish(q[None])
                q, off = points[0], float(residuals[0])
            if not off <= EXACT or self._beyond_limits(q):
                why = f"{what} does not meet the holds: it is off by {off:.3g}."
                return Endpoint(original, f"{why} planner.solutions(holds) finds configurations that do.")
        checker = self._checker
        narrow = np.ascontiguousarray(np.clip(q, checker.lower, checker.upper)[None], dtype=np.float32)
        if checker.valid(narrow)[0]:
            return Endpoint(q)
        _, conditions = checker.outputs(narrow[0])
        names = self._space.condition_names
        broken = [name for name, c in zip(names, conditions, strict=False) if not c <= 0]
        if broken:
            return Endpoint(q, f"{what} violates {', '.join(map(repr, broken[:6]))}.")
        contacts = self._judge.contacts(q)
        if len(contacts):
            return Endpoint(q, f"{what} is in collision: {describe_contacts(contacts)}.")
        nearest = self._judge.contacts(q, checker.struct.margin + _ROUNDING)
        pairs = ", ".join(f"'{c.a}' and '{c.b}' are {1e3 * c.distance:.4g} mm apart" for c in nearest[:3])
        return Endpoint(q, f"{what} is free, but nearer to a contact than margin= allows: {pairs}.")

    def check_goals(self, ends: Array) -> list[Endpoint] | str:
        """Return the goals among configurations (K, n) that can be used, or why there are none.

        Of several, those that need no closer look are enough.
        """
        if len(ends) > 1:
            inside = ((ends >= self._checker.lower) & (ends <= self._checker.upper)).all(axis=1)
            if self._manifold is not None:
                inside &= self._manifold.residuals(ends) <= EXACT
            inside &= self._checker.valid(np.ascontiguousarray(ends, dtype=np.float32))
            if inside.any():
                return [Endpoint(end) for end in ends[inside]]
        names = ["The goal"] if len(ends) == 1 else [f"Goal {k}" for k in range(len(ends))]
        result = [self.check(name, end) for name, end in zip(names, ends, strict=True)]
        return [end for end in result if not end.reason] or " ".join(end.reason for end in result[:3])

    def _beyond_limits(self, q: Array) -> str:
        lower, upper = self._space.lower, self._space.upper
        if ((q >= lower - _LIMIT) & (q <= upper + _LIMIT)).all():
            return ""
        wrong = [
            f"'{s}' is {value:.6g}, and its range is {low:.6g} to {high:.6g}"
            for s, value, low, high in zip(self._space.symbols, q, lower, upper, strict=True)
            if not low - _LIMIT <= value <= high + _LIMIT
        ]
        return "; ".join(wrong[:4])


def describe_barrier(space: PlanningSpace, checker: CollisionChecker, start: Array, ends: Array) -> str:
    """Describe a coordinate whose values between start (n,) and goals (K, n) are not free; empty without one.

    Random configurations are checked, so this is no proof.
    """
    generator = np.random.default_rng(0)
    lower, upper = checker.lower.astype(float), checker.upper.astype(float)
    samples = generator.uniform(lower, upper, (_SAMPLES, len(start)))
    free = samples[checker.valid(samples.astype(np.float32))]
    for i in np.flatnonzero(~space.turning & (lower < upper)) if len(free) >= _ENOUGH else ():
        values = np.sort(np.concatenate([free[:, i], ends[:, i], start[i : i + 1]]))
        low, high = values[:-1], values[1:]
        above, below = ends[:, i].min(), ends[:, i].max()
        beyond = (low >= start[i]) & (high <= above) | (high <= start[i]) & (low >= below)
        if not beyond.any():
            continue
        k = int(np.argmax(np.where(beyond, high - low, -1.0)))
        # Its ends are free.
        inner = (3 * low[k] + high[k]) / 4, (low[k] + 3 * high[k]) / 4
        samples[:, i] = generator.uniform(*inner, _SAMPLES)
        if not checker.valid(samples.astype(np.float32)).any():
            where = f"'{space.symbols[i]}' between {inner[0]:.4g} and {inner[1]:.4g}"
            return (
                f" The goal may be out of reach: every path leads through {where}, and {_SAMPLES} random "
                "configurations there are not free."
            )
        samples[:, i] = generator.uniform(lower[i], upper[i], _SAMPLES)
    return ""


_BATCH = 2048
MOST_BATCHES = 1_000_000  # number of batches of a search that is limited by time alone
_IDLE = 8  # number of batches without anything new after which there is nothing more to find
_APART = 0.05  # least distance of two solutions that count as different [rad], [m]


def find_solutions(
    checker: CollisionChecker,
    manifold: Manifold,
    near: Array,
    count: int,
    seconds: float,
    seed: int,
    batches: int = MOST_BATCHES,
) -> Array:
    """Find different configurations (K, n) on a manifold, free of collisions; the nearest come first."""
    generator = np.random.default_rng(seed)
    begin = working_seconds()
    lower, upper = checker.lower.astype(float), checker.upper.astype(float)
    result, idle = np.zeros((0, len(near))), 0
    tries = near + generator.standard_normal((_BATCH, len(near))) * (upper - lower) / 8
    tries[0] = near
    for _ in range(batches):
        rows = np.ascontiguousarray(np.clip(tries, lower, upper), dtype=np.float32)
        rows = np.ascontiguousarray(rows[manifold.project(rows)])
        rows, before = rows[checker.valid(rows)], len(result)
        if len(rows):
            exact, residuals = manifold.polish(rows[: 4 * count].astype(float))
            inside = (exact >= lower - 1e-9).all(axis=1) & (exact <= upper + 1e-9).all(axis=1)
            exact = exact[inside & (residuals <= EXACT)]
            # Polishing moves them a little.
            free = checker.valid(np.ascontiguousarray(np.clip(exact, lower, upper), dtype=np.float32))
            result = np.vstack([result, exact[free]])
            result = result[unique_rows(result, _APART)]
        idle = 0 if len(result) > before else idle + 1
        if len(result) >= count or (len(result) and idle >= _IDLE) or working_seconds() - begin > seconds:
            break
        tries = generator.uniform(lower, upper, (_BATCH, len(near)))
    return result[np.argsort(np.linalg.norm(result - near, axis=1), kind="stable")][:count]
