"""Unobservable directions, and states where the measurement Jacobian vanishes.

The cosine of an angle has zero slope at 0: a Gauss-Newton step does not move the angle, whatever is measured.
An arm that is stretched out has the same property at its elbow. Where a residual remains unexplained and some
direction is unobservable, the update therefore restarts on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kineverse.errors import KineverseError
from kineverse.lie import Array

from .bounds import GroupBounds
from .information_state import InformationState
from .map_update import MapResult
from .process_model import ProcessModel
from .residuals import MeasurementReader, Residuals
from .state_space import CoordinateGroup, Layout

# A direction is unobservable while its deviation exceeds this part of the initial one.
_UNOBSERVABLE = 0.05
# Rounding may cancel information; no step is longer than a hundred initial deviations.
_LEAST = 1e-4


class UnobservableDirections:
    """Classification of tangent directions by their information."""

    def __init__(self, layout: Layout) -> None:
        self._groups = layout.groups
        self.deviations: Array = np.ones(len(layout.tangent_space.tangent))

    def directions(self, number: int, information: Array) -> tuple[Array, Array]:
        """Return steps of one deviation in the tangent of a group: unobservable (k, t), others (t - k, t).

        They are orthogonal in the metric of the information (t, t).
        """
        scale = self.deviations[self._groups[number].t]
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        steps = (vectors * np.maximum(values, _LEAST) ** -0.5).T * scale
        is_unobservable = values < _UNOBSERVABLE**-2
        return steps[is_unobservable], steps[~is_unobservable]

    def is_in(self, number: int, belief: InformationState) -> bool:
        """Return True if a group has unobservable directions in a belief."""
        group = self._groups[number]
        information, scale = belief.information[group.block], self.deviations[group.t]
        if len(scale) == 1:
            return float(information[0, 0]) * float(scale[0]) ** 2 < _UNOBSERVABLE**-2
        return bool(np.linalg.eigvalsh(information * np.outer(scale, scale))[0] < _UNOBSERVABLE**-2)


class Components(NamedTuple):
    """Components of a tracker that its computations share."""

    layout: Layout
    residuals: Residuals
    process_model: ProcessModel
    reader: MeasurementReader
    group_bounds: Sequence[GroupBounds]
    unobservable: UnobservableDirections


# Residuals are explained if their χ² is fewer deviations than this above its mean.
_EXPLAINED = 3.0
# Restarts are limited to the directions of least information.
_MOST_DIRECTIONS = 2


def find_unexplained(result: MapResult) -> list[int]:
    """Return the groups whose residuals exceed the noise."""
    beyond = result.nis > result.dof + _EXPLAINED * np.sqrt(2 * result.dof)
    return np.flatnonzero(beyond).tolist()


def move_origin(
    belief: InformationState,
    number: int,
    group: CoordinateGroup,
    there: Array,
    step: Array,
    transport: Array | None,
) -> None:
    """Write the same belief of a group about other coordinates, at the end of a tangent step; in place."""
    belief.x[group.x] = there
    belief.set_group_cost(group.t, belief.group_cost(group.t).transported(step, transport))
    record = belief.records[number]
    if record is not None:
        belief.records[number] = replace(record, prior=record.prior.transported(step, transport))


class StationaryPoints:
    """Detection of states where the measurement Jacobian vanishes, and restarts near them."""

    def __init__(self, components: Components) -> None:
        self._layout, _, self._process_model, _, self._group_bounds, self._unobservable = components
        # The cost of such a group is convex: a restart ends where the update did.
        self._is_affine = [self._layout.is_affine(number) for number in range(len(self._layout.groups))]

    def unexplained(self, before: InformationState, result: MapResult) -> list[int]:
        """Return the groups whose residuals exceed the noise and that have unobservable directions."""
        return [
            n
            for n in find_unexplained(result)
            if not self._is_affine[n]
            and (before.records[n] is not None or self._unobservable.is_in(n, result.belief))
        ]

    def restart_states(
        self, before: InformationState, after: InformationState, groups: Sequence[int], inputs: Array
    ) -> list[InformationState]:
        """Return prior beliefs about points on both sides of the estimate, in unobservable directions."""
        beliefs: list[InformationState] = []
        for number in groups:
            group, record, index = self._layout.groups[number], before.records[number], 0
            x = before.x[group.x]
            # Unobservable now, or before the stored measurements.
            directions, _ = self._unobservable.directions(number, after.information[group.block])
            if not len(directions) and record is not None:
                directions, _ = self._unobservable.directions(number, record.prior.matrix)
            directions = directions[:_MOST_DIRECTIONS]
            for direction in (*directions, *-directions):
                try:
                    there, _ = self._process_model.retract(number, x, direction, inputs)
                    step = self._group_bounds[number].remaining(
                        x, self._group_bounds[number].clip(there), direction
                    )
                    there, transport = self._process_model.retract(number, x, step, inputs)
                except KineverseError:  # infeasible
                    continue
                if index == len(beliefs):
                    beliefs.append(before.copy())
                move_origin(beliefs[index], number, group, there, step, transport)
                index += 1
        return beliefs
