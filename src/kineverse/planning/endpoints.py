"""Starts and goals of a plan: whether they are free, and ways out of spheres where only these touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.lie import Array

from .checker import CollisionChecker
from .configuration import PlanningSpace
from .constrained_path import polish
from .judge import FINE, SceneJudge, describe_contacts
from .manifold import EXACT, Manifold

_DISTANCES = (0.01, 0.02, 0.04, 0.08, 0.15, 0.3, 0.5)
_TRIES, _WAYS = 256, 6
_LIMIT = 1e-6
_NEAR = 0.01
"""Largest residual of an end that is brought onto a manifold [m], [rad]."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Start or goal of a plan.

    Attributes
    ----------
    way
        Configurations (K, n) from the given one to one in which no sphere touches; the given one alone if
        none does.
    reason
        Why it cannot be used; empty if it can.
    """

    way: Array
    reason: str = ""

    @property
    def inner(self) -> Array:
        """The configuration (n,) from which the search goes on."""
        return np.asarray(self.way[-1])


class Endpoints:
    """Checks of starts and goals.

    Parameters
    ----------
    space
        Coordinates and their limits.
    checker
        Collision checker with spheres.
    judge
        Collision scene.
    manifold
        Manifold that they are on; None for the whole space.
    """

    def __init__(
        self, space: PlanningSpace, checker: CollisionChecker, judge: SceneJudge, manifold: Manifold | None
    ) -> None:
        self._space, self._checker, self._judge, self._manifold = space, checker, judge, manifold

    def check(self, what: str, q: Array) -> Endpoint:
        """Return a start or goal (n,), with the reason why it cannot be used, or its way out of spheres."""
        way = q[None].astype(float)
        outside = self._beyond_limits(q)
        if outside:
            return Endpoint(way, f"{what} is out of limits: {outside}.")
        if self._manifold is not None:
            off = float(self._manifold.residuals(way)[0])
            way, residuals = self._manifold.polish(way) if off <= _NEAR else (way, np.array([off]))
            if not residuals[0] <= EXACT or self._beyond_limits(way[0]):
                return Endpoint(
                    q[None],
                    f"{what} does not meet the holds: it is off by {off:.3g}. planner.solutions(holds) "
                    "finds some.",
                )
            q = way[0]
        narrow = np.ascontiguousarray(
            np.clip(way, self._checker.lower, self._checker.upper), dtype=np.float32
        )
        if self._checker.valid(narrow)[0]:
            touching = self._judge.uncovered_contacts(q)
            if touching is not None:
                return Endpoint(way, f"{what} is in collision: {describe_contacts(touching)}.")
            return Endpoint(way)
        _, conditions = self._checker.outputs(narrow[0])
        broken = [
            name for name, c in zip(self._space.condition_names, conditions, strict=False) if not c <= 0
        ]
        if broken:
            return Endpoint(way, f"{what} violates {', '.join(map(repr, broken[:6]))}.")
        contacts = self._judge.contacts(q)
        if len(contacts):
            return Endpoint(way, f"{what} is in collision: {describe_contacts(contacts)}.")
        found = self._leave_spheres(q)
        if found is None:
            return Endpoint(
                way,
                f"{what} is free by the scene, but nearer to a contact than the spheres of the planner or "
                "its margin allow, and no way out was found. A smaller protrusion= or margin= helps.",
            )
        return Endpoint(found)

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
                return [Endpoint(end[None]) for end in ends[inside]]
        names = ["The goal"] if len(ends) == 1 else [f"Goal {k}" for k in range(len(ends))]
        found = [self.check(name, end) for name, end in zip(names, ends, strict=True)]
        return [end for end in found if not end.reason] or " ".join(end.reason for end in found[:3])

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

    def _leave_spheres(self, q: Array) -> Array | None:
        """Return a way (K, n), free by the scene, to a near configuration in which no sphere touches."""
        generator = np.random.default_rng(0)
        low, high = self._checker.lower, self._checker.upper
        for distance in _DISTANCES:
            step = generator.standard_normal((_TRIES, len(q)))
            step *= distance / np.linalg.norm(step, axis=1)[:, None]
            tries = np.ascontiguousarray(np.clip(q + step, low, high), dtype=np.float32)
            if self._manifold is not None:
                tries = np.ascontiguousarray(tries[self._manifold.project(tries)])
            free = tries[self._checker.valid(tries)][:_WAYS].astype(float)
            if self._manifold is not None and len(free):
                free = self._manifold.polish(free)[0]
            for other in free:
                way: Array | None = np.array([q, other])
                if self._manifold is not None and way is not None:
                    way = polish(self._manifold, way)
                if way is not None and self._judge.first_contact(way, FINE * 4) is None:
                    return way
        return None
