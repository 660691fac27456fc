"""Steps in the tangent, and predictions, of a state whose coordinates may be driven by others' speeds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kineverse.errors import UnknownNameError, suggest
from kineverse.estimation.noise import Array
from kineverse.expressions.expression import as_expression
from kineverse.symbols import Symbol

from .belief import Belief, inverse
from .layout import Group, Layout
from .motion import Motion


class Charted:
    """A layout that can move.

    Parameters
    ----------
    layout
        Where coordinates are.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        chart, rates = layout.chart, layout.chart.rates
        one = as_expression(1.0)
        self._steps: dict[int, Motion] = {}
        self._flows: dict[int, Motion] = {}
        by_name: dict[str, Symbol] = {}
        for number, group in enumerate(layout.groups):
            rows = [rates[x] if x in rates else {x.derivative(): one} for x in group.coordinates]
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            by_name.update({str(v): v for v in speeds})
            if any(x in rates for x in group.coordinates):
                self._flows[number] = Motion(group.coordinates, rows, speeds, layout.known)
            if group.by_speeds:
                charted = [chart.row(x) for x in group.coordinates]
                self._steps[number] = Motion(group.coordinates, charted, group.tangent, layout.known)
        self.speeds: Mapping[str, Symbol] = by_name

    def speed(self, key: Symbol | str) -> Symbol:
        """Return the speed of a name.

        Raises
        ------
        UnknownNameError
            If it moves nothing here.
        """
        found = self.speeds.get(str(key))
        if found is None:
            raise UnknownNameError(
                f"Nothing that is estimated moves with '{key}'. {suggest(str(key), self.speeds, 'speed')}"
            )
        return found

    def only_shakes(self, number: int, speeds: Mapping[Symbol, float]) -> bool:
        """Whether a group moves by noise alone, in directions that are its coordinates."""
        group = self._layout.groups[number]
        return number not in self._flows and not any(speeds.get(v, 0.0) for v in group.tangent)

    def wait(self, timeout: float | None) -> None:
        """Wait until steps run in compiled code."""
        for motion in self._steps.values():
            motion.wait(timeout)

    def motion(self, number: int) -> Motion | None:
        """Return how a group moves with its tangent; None if its coordinates are that."""
        return self._steps.get(number)

    @property
    def is_driven(self) -> bool:
        """Whether some coordinates move by rates, and not by speeds of their own alone."""
        return bool(self._flows)

    def moving(self, speeds: Mapping[Symbol, float], noise: Mapping[Symbol, float]) -> list[int]:
        """Return the numbers of the groups that move at speeds or with noise."""
        active = {v for by in (speeds, noise) for v, value in by.items() if value}
        found = []
        for number, group in enumerate(self._layout.groups):
            flow = self._flows.get(number)
            if not active.isdisjoint(group.tangent if flow is None else flow.speeds):
                found.append(number)
        return found

    def step(self, number: int, x: Array, step: Array, known: Array) -> tuple[Array, Array | None]:
        """Return a group's coordinates after a step in its tangent, and how the tangent turns on the way.

        That is J with: a bit more of the step, dξ, is J dξ in the tangent where it ends; None for identity.
        """
        motion = self._steps.get(number)
        if motion is None:
            return x + step, None
        after, _, gain = motion.along(x, step, known)
        return after, np.linalg.pinv(motion.rates(after, known)) @ gain

    def basis(self, number: int, x: Array, known: Array) -> Array:
        """Return how a group's coordinates move with its tangent (n, t)."""
        motion = self._steps.get(number)
        return np.eye(len(x)) if motion is None else motion.rates(x, known)

    def predict(
        self,
        belief: Belief,
        known: Array,
        dt: float,
        speeds: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        """Move a belief on by ``dt`` seconds at speeds, with variances per second that add to them."""
        for number, group in enumerate(self._layout.groups):
            flow = self._flows.get(number)
            order = group.tangent if flow is None else flow.speeds
            moved = np.array([speeds.get(v, 0.0) for v in order]) * dt
            grown = np.array([noise.get(v, 0.0) for v in order]) * dt
            if moved.any() or grown.any():
                self._predict(number, group, belief, known, moved, grown)

    def _predict(
        self, number: int, group: Group, belief: Belief, known: Array, moved: Array, grown: Array
    ) -> None:
        flow, block = self._flows.get(number), np.ix_(group.t, group.t)
        x = belief.x[group.x]
        covariance = inverse(belief.information[block])
        mean = covariance @ belief.vector[group.t]
        if flow is None:
            after = x + moved
            covariance = covariance + np.diag(grown)
        else:
            after, slope, gain = flow.along(x, moved, known)
            back = np.linalg.pinv(self.basis(number, after, known))
            slope, gain = back @ slope @ self.basis(number, x, known), back @ gain
            mean = slope @ mean
            covariance = slope @ covariance @ slope.T + (gain * grown) @ gain.T
        information = inverse(covariance)
        belief.x[group.x] = after
        belief.information[block] = information
        belief.vector[group.t] = information @ mean
