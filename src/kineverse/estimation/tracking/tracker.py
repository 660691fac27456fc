"""Recursive state estimation of a model from noisy measurements."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.lie import Array
from kineverse.model.rate_nodes import to_plain
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bindings import native_library
from .bounds import SpeedLocks, StateBounds, collect_bounds, initial_deviations, initial_point
from .estimate import Estimate
from .gaussian import InformationState
from .gaussian_sum import GaussianSum
from .layout import Layout, build_layout
from .measurements import (
    MeasurementModel,
    ObservedLike,
    build_measurement_models,
    require_number,
    require_positive,
)
from .multi_start import find_periodic_coordinates, spread_starts
from .residuals import Measurements
from .step import StepResult, UpdateStep
from .tangent import build_tangent_space

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


def arrange_state(
    model: ModelView, observations: tuple[MeasurementModel, ...], given: frozenset[Symbol]
) -> tuple[Layout, StateBounds]:
    """Choose the estimated coordinates, and collect their limits.

    Parameters
    ----------
    model, observations
        The model, and its measurement models.
    given
        Coordinates that are measured elsewhere.

    Raises
    ------
    InvalidValueError
        If an observation depends on no estimated coordinate.
    """
    rates = model.rates
    values = [rates.resolve(to_plain(one.value)) for one in observations]
    tangent_space = build_tangent_space(rates, values, given, model.default_state())
    limits = collect_bounds(model, tangent_space, given)
    dependencies = {s for value in values for s in value.symbols}
    dependencies |= {s for c in limits.curved for s in c.symbols}
    dependencies |= {
        s for x in tangent_space.coordinates if x in rates for e in rates[x].values() for s in e.symbols
    }
    inputs = sorted(dependencies - set(tangent_space.coordinates), key=lambda s: s.sort_key)
    return build_layout(tangent_space, observations, limits.curved, inputs), limits


class Tracker:
    """Recursive MAP estimator of the coordinates of a model from observed frames.

    It finds the coordinates, splits them into independent groups, and takes limits from the model's
    constraints.

    Parameters
    ----------
    model
        The model. Later edits of it have no effect.
    observed
        Names of frames whose poses are measured, or :class:`.ObservedPose`, :class:`.ObservedPosition`,
        :class:`.ObservedExpression`.
    start
        Initial values of some coordinates; others start in the middle of the limits, or at the default state.
    uncertainty
        Initial standard deviations [m], [rad], by coordinate, or by speed for directions that are no
        coordinate's; by default half the width of the limits, π for angles, 10 m.
    process_noise
        Process noise as variance per second, by speed.
    outliers
        Outlier model: :class:`Outliers`, or True for the default one. None without outliers.
    locks
        True if coordinates held by a lock of the model ignore commands and process noise.
    inputs
        Coordinates that are measured elsewhere, such as a robot's joints. Each step takes their values as
        ``inputs``.
    """

    def __init__(
        self,
        model: ModelView,
        observed: Iterable[ObservedLike],
        *,
        start: StateLike | None = None,
        uncertainty: StateLike | None = None,
        process_noise: StateLike | None = None,
        outliers: Outliers | bool | None = None,
        locks: bool = False,
        inputs: Symbol | str | Iterable[Symbol | str] = (),
    ) -> None:
        keys = (inputs,) if isinstance(inputs, str | Symbol) else inputs
        given = frozenset(k if isinstance(k, Symbol) else model.symbol(k) for k in keys)
        layout, limits = arrange_state(model, build_measurement_models(model, observed), given)
        self._layout = layout
        self._update_step = UpdateStep(layout, limits, as_outliers(outliers))
        process_model = self._update_step.process_model
        self._noise = {
            process_model.speed(k): require_positive(k, v) for k, v in (process_noise or {}).items()
        }
        self._inputs = np.array([np.nan if s.value is None else s.value for s in layout.inputs])
        self._locks = SpeedLocks(model, layout, process_model) if locks else None
        self._stamp: float | None = getattr(start, "stamp", None)
        self._mixture = self._initial_mixture(model, start or {}, uncertainty or {})
        self._result = StepResult(self._mixture, 0.0, 0, (), 0)

    def _initial_mixture(self, model: ModelView, start: StateLike, uncertainty: StateLike) -> GaussianSum:
        layout, tangent_space = self._layout, self._layout.tangent_space
        update_step = self._update_step
        state = start if isinstance(start, State) else State(start)
        given = {x: state[x] for x in tangent_space.coordinates if x in state}
        unknown = [] if isinstance(start, State) else [str(s) for s in state if s not in given]
        if unknown:
            hint = suggest(unknown[0], map(str, tangent_space.coordinates), "coordinate")
            raise UnknownNameError(f"'{unknown[0]}' is not estimated. {hint}")
        for symbol, value in given.items():
            if not math.isfinite(value):
                raise InvalidValueError(f"start= of '{symbol}' is {value!r}; it must be finite.")
        x = initial_point(model, tangent_space, update_step.limits, given)
        inputs = np.nan_to_num(self._inputs)
        update_step.periodic = find_periodic_coordinates(update_step, x, inputs)
        deviations = initial_deviations(tangent_space, update_step.limits, update_step.periodic)
        names = {str(v): i for i, v in enumerate(tangent_space.tangent)}
        own = [v for v in tangent_space.tangent if v.position in tangent_space.coordinates]
        names.update({str(v.position): tangent_space.tangent.index(v) for v in own})
        for key, value in uncertainty.items():
            if str(key) not in names:
                raise UnknownNameError(f"'{key}' is not estimated. {suggest(str(key), names, 'coordinate')}")
            deviations[names[str(key)]] = require_positive(key, value)
        update_step.unobservable.deviations = deviations
        belief = InformationState((len(x), len(deviations), len(layout.groups)))
        belief.x[:] = x
        belief.information[:] = np.diag(deviations**-2.0)
        return spread_starts(update_step, belief, inputs)

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """Estimated coordinates, sorted."""
        return self._layout.tangent_space.coordinates

    @property
    def groups(self) -> tuple[tuple[Symbol, ...], ...]:
        """Independent groups of coordinates that share observations or limits."""
        return tuple(group.coordinates for group in self._layout.groups)

    @property
    def limits(self) -> dict[Symbol, tuple[float, float]]:
        """Bounds of single coordinates; ±inf without constant bounds."""
        return self._update_step.limits.by_symbol(self._layout.tangent_space)

    @property
    def periodic(self) -> frozenset[Symbol]:
        """Periodic coordinates; their values stay within half a turn."""
        return self._update_step.periodic

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the constraints that limit the state."""
        return self._update_step.limits.names

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the observations, in order."""
        return tuple(one.name for one in self._layout.observations)

    @property
    def estimate(self) -> Estimate:
        """Present estimate; innovations and outliers are those of the last update."""
        return Estimate(self._result, self._mixture, self._update_step, self._inputs, self._stamp)

    @property
    def log_evidence(self) -> float:
        """Log density of all measurements so far, given the model."""
        return self._mixture.log_evidence

    def copy(self) -> Tracker:
        """Return an independent tracker in the same state; compiled code is shared, also between threads."""
        return copy.copy(self)

    def predict(
        self, dt: float, commands: StateLike | None = None, inputs: StateLike | None = None
    ) -> Estimate:
        """Predict the state with commanded speeds and process noise.

        Parameters
        ----------
        dt
            Time step [s], not negative.
        commands
            Commanded speeds by symbol or name [m/s], [rad/s]; others are 0.
        inputs
            Values of the inputs.

        Raises
        ------
        InvalidValueError
            If time goes backwards or a number is not finite.
        UnknownNameError
            For a speed with which no estimated coordinate moves.
        """
        dt = require_number(dt, "The length of a step")
        if not (math.isfinite(dt) and dt >= 0):
            raise InvalidValueError(
                f"Time goes on: a step of {dt!r} s is none. Steps are finite and not negative."
            )
        speeds = {}
        for key, value in (commands or {}).items():
            speed = require_number(value, f"The commanded speed '{key}'")
            if not math.isfinite(speed):
                raise InvalidValueError(f"The commanded speed '{key}' is {value!r}; it must be finite.")
            speeds[self._update_step.process_model.speed(key)] = speed
        self._inputs, self._mixture = self._predicted(dt, speeds, self._read_inputs(inputs))
        if self._stamp is not None:
            self._stamp += dt
        return self.estimate

    def _predicted(
        self, dt: float, speeds: Mapping[Symbol, float], inputs: Array
    ) -> tuple[Array, GaussianSum]:
        if not speeds and not self._noise:
            return inputs, self._mixture

        def moved(belief: InformationState) -> InformationState:
            free = self._locks.free(belief, inputs) if self._locks else None
            moving, noise = (_only(values, free) for values in (speeds, self._noise))
            return self._update_step.predict(belief, inputs, dt, moving, noise)

        return inputs, self._mixture.map(moved)

    def update(
        self,
        seen: Mapping[str, Any],
        *,
        at: float | None = None,
        commands: StateLike | None = None,
        inputs: StateLike | None = None,
    ) -> Estimate:
        """Update the state with measurements.

        Parameters
        ----------
        seen
            Measurements by name of the observation: poses 4×4, vectors or numbers, or pairs of these and a
            covariance of their own. Absent names are missing.
        at
            Time of the measurements [s]; the state is predicted to it first.
        commands
            Speeds during this prediction.
        inputs
            Values of the inputs.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For an invalid measurement, naming it, or if time goes backwards. The belief does not change then.
        """
        return self._update(self._update_step.reader.read(seen), at, commands, inputs)

    def update_poses(
        self,
        poses: npt.ArrayLike,
        seen: npt.ArrayLike | None = None,
        *,
        at: float | None = None,
        commands: StateLike | None = None,
        inputs: StateLike | None = None,
    ) -> Estimate:
        """Update with poses in an array (m, 4, 4), in the order of the observations; see :meth:`update`.

        Parameters
        ----------
        poses
            Poses of all frames; entries of missing ones are ignored.
        seen
            True for each measured pose (m,); all if None.
        at, commands, inputs
            As in :meth:`update`.
        """
        return self._update(self._update_step.reader.read_poses(poses, seen), at, commands, inputs)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for compiled code; return whether updates use it.

        Parameters
        ----------
        timeout
            In seconds; no limit if None.
        """
        if self._update_step.native is None:
            return False
        self._update_step.function.wait(timeout)
        self._update_step.process_model.wait(timeout)
        native_library.prepare(wait=True)
        return self._update_step.is_native

    def _update(
        self,
        reading: Measurements,
        at: float | None,
        commands: StateLike | None,
        inputs: StateLike | None,
    ) -> Estimate:
        native = self._update_step.native
        if native is None or not native.are_rigid(reading):
            self._update_step.reader.check_poses(reading)
        before = self._mixture, self._inputs, self._stamp
        try:
            values = self._read_inputs(inputs)
            # The prediction uses the previous values of the inputs, if there are any.
            if not np.isfinite(self._inputs).all():
                self._inputs = values
            self._advance(at, commands)
            self._inputs = values
            result = self._update_step.update(self._mixture, reading, self._inputs)
        except BaseException:
            self._mixture, self._inputs, self._stamp = before
            raise
        self._mixture, self._result = result.mixture, result
        return self.estimate

    def _advance(self, at: float | None, commands: StateLike | None) -> None:
        if at is None:
            if commands:
                raise InvalidValueError("Commands need the time they lasted: give at=, or call predict.")
            return
        at = require_number(at, "The time of an observation")
        if not math.isfinite(at):
            raise InvalidValueError(f"The time of an observation is a finite number of seconds, not {at!r}.")
        if self._stamp is not None:
            if at < self._stamp:
                raise InvalidValueError(
                    f"Time goes backwards: an observation at {at:g} s after one at {self._stamp:g} s."
                )
            self.predict(at - self._stamp, commands, None)
        self._stamp = at

    def _read_inputs(self, given: StateLike | None) -> Array:
        symbols = self._layout.inputs
        values = self._inputs.copy()
        if given is not None:
            state = given if isinstance(given, State) else State(given)
            names = {str(s): i for i, s in enumerate(symbols)}
            for key in state:
                if str(key) in names:
                    values[names[str(key)]] = state[key]
                elif not isinstance(given, State):
                    raise UnknownNameError(f"'{key}' is not in inputs=. {suggest(str(key), names, 'symbol')}")
        missing = [str(s) for s, v in zip(symbols, values.tolist(), strict=True) if not math.isfinite(v)]
        if missing and (given is not None or symbols):
            raise InvalidValueError(f"There is no finite value of '{missing[0]}'; give it in inputs=.")
        return values

    def __repr__(self) -> str:
        sizes = f"{len(self.symbols)} coordinates in {len(self.groups)} groups"
        return f"<Tracker: {sizes}, {len(self.observed)} observed>"


def _only(values: Mapping[Symbol, float], free: frozenset[Symbol] | None) -> Mapping[Symbol, float]:
    return values if free is None else {v: value for v, value in values.items() if v in free}
