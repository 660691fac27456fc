"""Initial belief of a tracker, and that of groups that start anew."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bounds import initial_deviations, initial_point
from .gaussian import InformationState
from .gaussian_sum import GaussianSum
from .measurements import require_positive
from .multi_start import find_periodic_coordinates, spread_starts
from .step import UpdateStep
from .tangent import TangentSpace

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


@dataclass(frozen=True, eq=False)
class InitialBelief:
    """Initial state and its standard deviations.

    Attributes
    ----------
    x
        Coordinates (n,).
    deviations
        Standard deviation of each tangent direction (t,).
    speed_variances
        Initial variance of each speed, if speeds are estimated.
    """

    x: Array
    deviations: Array
    speed_variances: Mapping[Symbol, float]

    def spread(self, update_step: UpdateStep, inputs: Array) -> GaussianSum:
        """Return the belief about several initial points, see :mod:`.multi_start`."""
        groups = len(update_step.layout.groups)
        belief = InformationState((len(self.x), len(self.deviations), groups))
        belief.x[:] = self.x
        belief.information[:] = np.diag(self.deviations**-2.0)
        if update_step.velocity is not None:
            update_step.velocity.initialise(belief, self.speed_variances)
        return spread_starts(update_step, belief, inputs)

    def with_values(
        self, tangent_space: TangentSpace, start: StateLike, uncertainty: StateLike
    ) -> InitialBelief:
        """Return the belief with other values of some coordinates, and other uncertainties.

        Raises
        ------
        UnknownNameError
            For a name that is not estimated.
        InvalidValueError
            For a value that is not finite, or an uncertainty that is not positive.
        """
        x, deviations = self.x.copy(), self.deviations.copy()
        for symbol, value in read_start(tangent_space, start).items():
            x[tangent_space.coordinates.index(symbol)] = value
        for k, value in read_uncertainty(tangent_space, uncertainty).items():
            deviations[k] = value
        return replace(self, x=x, deviations=deviations)


def make_initial_belief(
    model: ModelView, update_step: UpdateStep, start: StateLike, uncertainty: StateLike, inputs: Array
) -> InitialBelief:
    """Return the initial belief, and set the periodic coordinates and initial deviations of a tracker.

    Parameters
    ----------
    model
        The model, with default values of coordinates.
    update_step
        Components of the tracker.
    start, uncertainty
        Given values and standard deviations.
    inputs
        Values of the inputs.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :meth:`InitialBelief.with_values`.
    """
    tangent_space, limits = update_step.layout.tangent_space, update_step.limits
    x = initial_point(model, tangent_space, limits, read_start(tangent_space, start))
    update_step.periodic = find_periodic_coordinates(update_step, x, inputs)
    usual = initial_deviations(tangent_space, limits, update_step.periodic)
    belief = InitialBelief(x, usual, {}).with_values(tangent_space, {}, uncertainty)
    update_step.unobservable.deviations = belief.deviations
    return belief


def read_start(tangent_space: TangentSpace, start: StateLike) -> dict[Symbol, float]:
    """Return the given values of estimated coordinates.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :meth:`InitialBelief.with_values`.
    """
    state = start if isinstance(start, State) else State(start)
    given = {x: state[x] for x in tangent_space.coordinates if x in state}
    unknown = [] if isinstance(start, State) else [str(s) for s in state if s not in given]
    if unknown:
        hint = suggest(unknown[0], map(str, tangent_space.coordinates), "coordinate")
        raise UnknownNameError(f"'{unknown[0]}' is not estimated. {hint}")
    for symbol, value in given.items():
        if not math.isfinite(value):
            raise InvalidValueError(f"start= of '{symbol}' is {value!r}; it must be finite.")
    return given


def read_uncertainty(tangent_space: TangentSpace, uncertainty: StateLike) -> dict[int, float]:
    """Return the given standard deviations by number of the tangent direction.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :meth:`InitialBelief.with_values`.
    """
    names = {str(v): i for i, v in enumerate(tangent_space.tangent)}
    own = [v for v in tangent_space.tangent if v.position in tangent_space.coordinates]
    names.update({str(v.position): tangent_space.tangent.index(v) for v in own})
    result = {}
    for key, value in uncertainty.items():
        if str(key) not in names:
            raise UnknownNameError(f"'{key}' is not estimated. {suggest(str(key), names, 'coordinate')}")
        result[names[str(key)]] = require_positive(key, value)
    return result
