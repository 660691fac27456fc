"""A tracker: where things are, from noisy observations of what a model says about them."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, ValueRejectedError, suggest
from kineverse.estimation.noise import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .arrangement import arranged
from .belief import Belief
from .estimate import Estimate
from .filtering import Filter
from .limits import first_deviations, first_place
from .locks import Locks
from .modes import Modes
from .native import native_library
from .observed import ObservedLike, checked_number, checked_positive, observations
from .outcome import Outcome
from .outliers import Outliers, as_outliers
from .reading import Reading
from .starts import starts, turning

if TYPE_CHECKING:
    from kineverse.model.view import ModelView


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
        start: Mapping[Any, float] | None = None,
        uncertainty: Mapping[Any, float] | None = None,
        process_noise: Mapping[Any, float] | None = None,
        outliers: Outliers | bool | None = None,
        locks: bool = False,
        known: Symbol | str | Iterable[Symbol | str] = (),
    ) -> None:
        known = (known,) if isinstance(known, str | Symbol) else known
        handed = frozenset(k if isinstance(k, Symbol) else model.symbol(k) for k in known)
        layout, limits = arranged(model, observations(model, observed), handed)
        self._layout = layout
        self._filter = Filter(layout, limits, as_outliers(outliers))
        charted = self._filter.charted
        self._noise = {charted.speed(k): checked_positive(k, v) for k, v in (process_noise or {}).items()}
        self._known = np.array([np.nan if s.value is None else s.value for s in layout.known])
        self._locks = Locks(model, layout, charted) if locks else None
        self._stamp: float | None = getattr(start, "stamp", None)
        self._modes = self._first(model, start or {}, uncertainty or {})
        self._outcome = Outcome(self._modes, 0.0, 0, (), 0)

    def _first(self, model: ModelView, start: Mapping[Any, float], uncertainty: Mapping[Any, float]) -> Modes:
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
                raise ValueRejectedError(f"start= of '{key}' is {value!r}; it must be finite.")
        x = first_place(model, chart, filter_.limits, given)
        known = np.nan_to_num(self._known)
        filter_.turns = turning(filter_, x, known)
        deviations = first_deviations(chart, filter_.limits, filter_.turns)
        names = {str(v): i for i, v in enumerate(chart.tangent)}
        own = [v for v in chart.tangent if v.position in chart.coordinates]
        names.update({str(v.position): chart.tangent.index(v) for v in own})
        for key, value in uncertainty.items():
            if str(key) not in names:
                raise UnknownNameError(f"'{key}' is not estimated. {suggest(str(key), names, 'coordinate')}")
            deviations[names[str(key)]] = checked_positive(key, value)
        filter_.openness.deviations = deviations
        belief = Belief((len(x), len(deviations), len(layout.groups)))
        belief.x[:] = x
        belief.information[:] = np.diag(deviations**-2.0)
        return starts(filter_, belief, known)

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
        self, dt: float, commands: Mapping[Any, float] | None = None, given: Mapping[Any, float] | None = None
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
        ValueRejectedError
            If time goes backwards or a number is not finite.
        UnknownNameError
            For a speed that moves nothing here.
        """
        dt = checked_number(dt, "The length of a step")
        if not (math.isfinite(dt) and dt >= 0):
            raise ValueRejectedError(
                f"Time goes on: a step of {dt!r} s is none. Steps are finite and not negative."
            )
        speeds = {}
        for key, value in (commands or {}).items():
            speed = checked_number(value, f"The commanded speed '{key}'")
            if not math.isfinite(speed):
                raise ValueRejectedError(f"The commanded speed '{key}' is {value!r}; it must be finite.")
            speeds[self._filter.charted.speed(key)] = speed
        self._known, self._modes = self._predicted(dt, speeds, self._values_of_known(given))
        if self._stamp is not None:
            self._stamp += dt
        return self.estimate

    def _predicted(self, dt: float, speeds: Mapping[Symbol, float], known: Array) -> tuple[Array, Modes]:
        if not speeds and not self._noise:
            return known, self._modes

        def moved(belief: Belief) -> Belief:
            free = self._locks.free(belief, known) if self._locks else None
            moving, noise = (_only(values, free) for values in (speeds, self._noise))
            return self._filter.predict(belief, known, dt, moving, noise)

        return known, self._modes.each(moved)

    def update(
        self,
        seen: Mapping[str, Any],
        *,
        at: float | None = None,
        commands: Mapping[Any, float] | None = None,
        given: Mapping[Any, float] | None = None,
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
        UnknownNameError, ShapeError, ValueRejectedError
            For what was not seen right, naming it, or if time goes backwards. The belief stays as it was.
        """
        return self._take(self._filter.reader.read(seen), at, commands, given)

    def update_poses(
        self,
        poses: npt.ArrayLike,
        seen: npt.ArrayLike | None = None,
        *,
        at: float | None = None,
        commands: Mapping[Any, float] | None = None,
        given: Mapping[Any, float] | None = None,
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
        reading: Reading,
        at: float | None,
        commands: Mapping[Any, float] | None,
        given: Mapping[Any, float] | None,
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

    def _advance(self, at: float | None, commands: Mapping[Any, float] | None) -> None:
        if at is None:
            if commands:
                raise ValueRejectedError("Commands need the time they lasted: give at=, or call predict.")
            return
        at = checked_number(at, "The time of an observation")
        if not math.isfinite(at):
            raise ValueRejectedError(f"The time of an observation is a finite number of seconds, not {at!r}.")
        if self._stamp is not None:
            if at < self._stamp:
                raise ValueRejectedError(
                    f"Time goes backwards: an observation at {at:g} s after one at {self._stamp:g} s."
                )
            self.predict(at - self._stamp, commands, None)
        self._stamp = at

    def _values_of_known(self, given: Mapping[Any, float] | None) -> Array:
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
            raise ValueRejectedError(f"There is no finite value of '{missing[0]}'; hand it in as given=.")
        return values

    def __repr__(self) -> str:
        sizes = f"{len(self.symbols)} coordinates in {len(self.groups)} groups"
        return f"<Tracker: {sizes}, {len(self.observed)} observed>"


def _only(values: Mapping[Symbol, float], free: frozenset[Symbol] | None) -> Mapping[Symbol, float]:
    return values if free is None else {v: value for v, value in values.items() if v in free}
