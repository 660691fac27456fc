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
    model: ModelView, seen: tuple[MeasurementModel, ...], handed: frozenset[Symbol]
) -> tuple[Layout, StateBounds]:
    """Return what is estimated, and the limits of that.

    Parameters
    ----------
    model, seen
        What is tracked, and what is observed of it.
    handed
        The coordinates that are measured elsewhere.

    Raises
    ------
    InvalidValueError
        If an observation depends on nothing that could be estimated.
    """
    rates = model.rates
    values = [rates.resolve(to_plain(one.value)) for one in seen]
    chart = build_tangent_space(rates, values, handed, model.default_state())
    limits = collect_bounds(model, chart, handed)
    looked_at = {s for value in values for s in value.symbols}
    looked_at |= {s for c in limits.curved for s in c.symbols}
    looked_at |= {s for x in chart.coordinates if x in rates for e in rates[x].values() for s in e.symbols}
    inputs = sorted(looked_at - set(chart.coordinates), key=lambda s: s.sort_key)
    return build_layout(chart, seen, limits.curved, inputs), limits


class Tracker:
    """Estimates the coordinates behind what is observed of a model.

    It finds the symbols, splits them into groups that share observations, and reads limits off constraints.

    Parameters
    ----------
    model
        What is tracked. The tracker stays with the version it was given.
    observed
        Names of frames whose poses are seen, or :class:`ObservedPose`, :class:`ObservedPosition`,
        :class:`ObservedExpression`.
    start
        Where to begin, as far as that is known; else the middle of the limits, or the default state.
    uncertainty
        Standard deviations at the start [m], [rad], by coordinate, or by speed for directions that are no
        coordinate's; by default half the width of the limits, π for angles, 10 m.
    process_noise
        Variances by speed and second, of what moves without being told.
    outliers
        How observations may be wrong: :class:`Outliers`, or True for the usual ones. None if they never are.
    locks
        Whether what a lock of the model holds at the estimate stays, whatever noise and commands say.
    known
        Coordinates that are measured elsewhere, such as a robot's joints, and handed in as ``given`` at each
        step.
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
        known: Symbol | str | Iterable[Symbol | str] = (),
    ) -> None:
        known = (known,) if isinstance(known, str | Symbol) else known
        handed = frozenset(k if isinstance(k, Symbol) else model.symbol(k) for k in known)
        layout, limits = arrange_state(model, build_measurement_models(model, observed), handed)
        self._layout = layout
        self._filter = UpdateStep(layout, limits, as_outliers(outliers))
        charted = self._filter.charted
        self._noise = {charted.speed(k): require_positive(k, v) for k, v in (process_noise or {}).items()}
        self._known = np.array([np.nan if s.value is None else s.value for s in layout.known])
        self._locks = SpeedLocks(model, layout, charted) if locks else None
        self._stamp: float | None = getattr(start, "stamp", None)
        self._modes = self._first(model, start or {}, uncertainty or {})
        self._outcome = StepResult(self._modes, 0.0, 0, (), 0)

    def _first(self, model: ModelView, start: StateLike, uncertainty: StateLike) -> GaussianSum:
        layout, chart = self._layout, self._layout.chart
        filter_ = self._filter
        state = start if isinstance(start, State) else State(start)
        given = {x: state[x] for x in chart.coordinates if x in state}
        strange = [] if isinstance(start, State) else [str(s) for s in state if s not in given]
        if strange:
            hint = suggest(strange[0], map(str, chart.coordinates), "coordinate")
            raise UnknownNameError(f"'{strange[0]}' is not estimated. {hint}")
        for key, value in given.items():
            if not math.isfinite(value):
                raise InvalidValueError(f"start= of '{key}' is {value!r}; it must be finite.")
        x = initial_point(model, chart, filter_.limits, given)
        known = np.nan_to_num(self._known)
        filter_.turns = find_periodic_coordinates(filter_, x, known)
        deviations = initial_deviations(chart, filter_.limits, filter_.turns)
        names = {str(v): i for i, v in enumerate(chart.tangent)}
        own = [v for v in chart.tangent if v.position in chart.coordinates]
        names.update({str(v.position): chart.tangent.index(v) for v in own})
        for symbol, value in uncertainty.items():
            if str(symbol) not in names:
                raise UnknownNameError(
                    f"'{symbol}' is not estimated. {suggest(str(symbol), names, 'coordinate')}"
                )
            deviations[names[str(symbol)]] = require_positive(symbol, value)
        filter_.openness.deviations = deviations
        belief = InformationState((len(x), len(deviations), len(layout.groups)))
        belief.x[:] = x
        belief.information[:] = np.diag(deviations**-2.0)
        return spread_starts(filter_, belief, known)

    # -- what it is about ----------------------------------------------------------------------------------

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The coordinates that are estimated, sorted."""
        return self._layout.chart.coordinates

    @property
    def groups(self) -> tuple[tuple[Symbol, ...], ...]:
        """The coordinates that share observations or limits; groups are independent of each other."""
        return tuple(group.coordinates for group in self._layout.groups)

    @property
    def limits(self) -> dict[Symbol, tuple[float, float]]:
        """The bounds of single coordinates; ±inf where there are none, or only others that move."""
        return self._filter.limits.by_symbol(self._layout.chart)

    @property
    def turning(self) -> frozenset[Symbol]:
        """The coordinates that come back after a turn; they stay within half a turn."""
        return self._filter.turns

    @property
    def constraints(self) -> tuple[str, ...]:
        """The names of the constraints that limit the state."""
        return self._filter.limits.names

    @property
    def observed(self) -> tuple[str, ...]:
        """The names of what is observed, in order."""
        return tuple(one.name for one in self._layout.observations)

    @property
    def estimate(self) -> Estimate:
        """What is believed now; innovations and outliers are those of the last update."""
        return Estimate(self._outcome, self._modes, self._filter, self._known, self._stamp)

    @property
    def log_evidence(self) -> float:
        """The log density of all that was seen so far, given what this tracker assumes."""
        return self._modes.log_evidence

    def copy(self) -> Tracker:
        """Return another one that goes on from here; all that is compiled is shared, with any threads."""
        return copy.copy(self)

    # -- steps ---------------------------------------------------------------------------------------------

    def predict(
        self, dt: float, commands: StateLike | None = None, given: StateLike | None = None
    ) -> Estimate:
        """Move on in time, at commanded speeds and with the process noise.

        Parameters
        ----------
        dt
            [s], not negative.
        commands
            Speeds by symbol or name [m/s], [rad/s]; those not given are 0.
        given
            Values of what is known.

        Raises
        ------
        InvalidValueError
            If time goes backwards or a number is not finite.
        UnknownNameError
            For a speed that moves nothing here.
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
            speeds[self._filter.charted.speed(key)] = speed
        self._known, self._modes = self._predicted(dt, speeds, self._values_of_known(given))
        if self._stamp is not None:
            self._stamp += dt
        return self.estimate

    def _predicted(
        self, dt: float, speeds: Mapping[Symbol, float], known: Array
    ) -> tuple[Array, GaussianSum]:
        if not speeds and not self._noise:
            return known, self._modes

        def moved(belief: InformationState) -> InformationState:
            free = self._locks.free(belief, known) if self._locks else None
            moving, noise = (_only(values, free) for values in (speeds, self._noise))
            return self._filter.predict(belief, known, dt, moving, noise)

        return known, self._modes.each(moved)

    def update(
        self,
        seen: Mapping[str, Any],
        *,
        at: float | None = None,
        commands: StateLike | None = None,
        given: StateLike | None = None,
    ) -> Estimate:
        """Take in what was seen.

        Parameters
        ----------
        seen
            From names of observations to poses 4×4, vectors or numbers, or to pairs of these and a covariance
            of their own. What is absent was not seen.
        at
            When [s]; the state is predicted up to then.
        commands
            Speeds on the way there.
        given
            Values of what is known.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For what was not seen right, naming it, or if time goes backwards. The belief stays as it was.
        """
        return self._take(self._filter.reader.read(seen), at, commands, given)

    def update_poses(
        self,
        poses: npt.ArrayLike,
        seen: npt.ArrayLike | None = None,
        *,
        at: float | None = None,
        commands: StateLike | None = None,
        given: StateLike | None = None,
    ) -> Estimate:
        """Take in poses as an array (m, 4, 4), in the order of what is observed; see :meth:`update`.

        Parameters
        ----------
        poses
            Of all frames; what stands for those that were not seen is not looked at.
        seen
            A mask (m,) of those that were; all if None.
        at, commands, given
            As in :meth:`update`.
        """
        return self._take(self._filter.reader.read_poses(poses, seen), at, commands, given)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until updates run in compiled code, as far as they can; return whether they do.

        Parameters
        ----------
        timeout
            For the compiler, in seconds; as long as it takes if None.
        """
        if self._filter.native is None:
            return False
        self._filter.function.wait(timeout)
        self._filter.charted.wait(timeout)
        native_library.prepare(wait=True)
        return self._filter.is_native

    def _take(
        self,
        reading: Measurements,
        at: float | None,
        commands: StateLike | None,
        given: StateLike | None,
    ) -> Estimate:
        native = self._filter.native
        if native is None or not native.are_rigid(reading):
            self._filter.reader.check_poses(reading)
        before = self._modes, self._known, self._stamp
        try:
            known = self._values_of_known(given)
            # On the way there, what is known was what it was before, if anybody has said so.
            if not np.isfinite(self._known).all():
                self._known = known
            self._advance(at, commands)
            self._known = known
            outcome = self._filter.update(self._modes, reading, self._known)
        except BaseException:
            self._modes, self._known, self._stamp = before
            raise
        self._modes, self._outcome = outcome.modes, outcome
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

    def _values_of_known(self, given: StateLike | None) -> Array:
        known = self._layout.known
        values = self._known.copy()
        if given is not None:
            state = given if isinstance(given, State) else State(given)
            names = {str(s): i for i, s in enumerate(known)}
            for key in state:
                if str(key) in names:
                    values[names[str(key)]] = state[key]
                elif not isinstance(given, State):
                    raise UnknownNameError(f"'{key}' is not known=. {suggest(str(key), names, 'symbol')}")
        missing = [str(s) for s, v in zip(known, values.tolist(), strict=True) if not math.isfinite(v)]
        if missing and (given is not None or known):
            raise InvalidValueError(f"There is no finite value of '{missing[0]}'; hand it in as given=.")
        return values

    def __repr__(self) -> str:
        sizes = f"{len(self.symbols)} coordinates in {len(self.groups)} groups"
        return f"<Tracker: {sizes}, {len(self.observed)} observed>"


def _only(values: Mapping[Symbol, float], free: frozenset[Symbol] | None) -> Mapping[Symbol, float]:
    return values if free is None else {v: value for v, value in values.items() if v in free}
