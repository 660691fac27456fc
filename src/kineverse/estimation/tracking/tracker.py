"""A tracker: where things are, from noisy observations of what a model says about them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, ValueRejectedError, suggest
from kineverse.estimation.noise import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .belief import Belief
from .chart import chart_of
from .charted import Charted
from .estimate import Estimate
from .layout import layout_of
from .limits import beginning, limits_of
from .observed import ObservedLike, observations
from .reading import Reader, Reading
from .residuals import Residuals
from .solving import Solver

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
        known: Iterable[Symbol | str] = (),
    ) -> None:
        handed = {k if isinstance(k, Symbol) else model.symbol(k) for k in known}
        seen = observations(model, observed)
        values = [one.value for one in seen]
        rates = model.rates
        chart = chart_of(rates, (s for v in values for s in v.symbols), handed)
        found = limits_of(model, chart, frozenset(handed))
        looked_at = {s for v in values for s in v.symbols}
        looked_at |= {s for c in found.curved for s in c.symbols}
        looked_at |= {
            s for x in chart.coordinates if x in rates for e in rates[x].values() for s in e.symbols
        }
        inputs = sorted(looked_at - set(chart.coordinates), key=lambda s: s.sort_key)
        self._layout = layout = layout_of(chart, seen, found.curved, inputs)
        self._limits = found
        self._charted = Charted(layout)
        self._residuals = Residuals(layout, layout.compiled())
        self._reader = Reader(seen)
        self._solver = Solver(layout, self._residuals, self._charted, found)
        self._noise = {self._charted.speed(k): _positive(k, v) for k, v in (process_noise or {}).items()}
        self._known = np.array([s.value if s.value is not None else np.nan for s in inputs])
        self._belief = self._first(model, start or {}, uncertainty or {})
        self._stamp: float | None = getattr(start, "stamp", None)

    def _first(
        self, model: ModelView, start: Mapping[Any, float], uncertainty: Mapping[Any, float]
    ) -> Belief:
        chart = self._layout.chart
        state = start if isinstance(start, State) else State(start)
        given = {x: state[x] for x in chart.coordinates if x in state}
        if not isinstance(start, State):
            strange = [str(s) for s in state if s not in given]
            if strange:
                hint = suggest(strange[0], map(str, chart.coordinates), "coordinate")
                raise UnknownNameError(f"'{strange[0]}' is not estimated. {hint}")
        x, deviations = beginning(model, chart, self._limits, given, frozenset())
        names = {str(v): i for i, v in enumerate(chart.tangent)}
        names.update(
            {str(v.position): i for i, v in enumerate(chart.tangent) if v.position in chart.coordinates}
        )
        for key, value in uncertainty.items():
            if str(key) not in names:
                raise UnknownNameError(f"'{key}' is not estimated. {suggest(str(key), names, 'coordinate')}")
            deviations[names[str(key)]] = _positive(key, value)
        count = len(self._layout.groups)
        return Belief(x, np.diag(deviations**-2.0), np.zeros(len(deviations)), np.zeros(count))

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
        return self._limits.by_symbol(self._layout.chart)

    @property
    def constraints(self) -> tuple[str, ...]:
        """The names of the constraints that limit the state."""
        return self._limits.names

    @property
    def observed(self) -> tuple[str, ...]:
        """The names of what is observed, in order."""
        return tuple(one.name for one in self._layout.observations)

    @property
    def estimate(self) -> Estimate:
        """What is believed now, without another observation."""
        return self._estimate(np.zeros(1), np.zeros(1), 0)

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
        if not (math.isfinite(dt) and dt >= 0):
            raise ValueRejectedError(
                f"Time goes on: a step of {dt!r} s is none. Steps are finite and not negative."
            )
        speeds = {}
        for key, value in (commands or {}).items():
            speeds[self._charted.speed(key)] = float(value)
            if not math.isfinite(value):
                raise ValueRejectedError(f"The commanded speed '{key}' is {value!r}; it must be finite.")
        known = self._values_of_known(given)
        belief = self._belief.copy()
        self._charted.predict(belief, known, dt, speeds, self._noise)
        if speeds or self._noise:
            belief = self._solver.inside(belief, known)
        self._belief, self._known = belief, known
        if self._stamp is not None:
            self._stamp += dt
        return self.estimate

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
        return self._take(self._reader.read(seen), at, commands, given)

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
        return self._take(self._reader.read_poses(poses, seen), at, commands, given)

    def _take(
        self,
        reading: Reading,
        at: float | None,
        commands: Mapping[Any, float] | None,
        given: Mapping[Any, float] | None,
    ) -> Estimate:
        before = self._belief, self._known, self._stamp
        try:
            self._advance(at, commands)
            self._known = self._values_of_known(given)
            groups = [
                number
                for number, group in enumerate(self._layout.groups)
                if any(reading.values[i] is not None for i in group.seen)
            ]
            found = self._solver.update(self._belief, reading, self._known, groups)
        except BaseException:
            self._belief, self._known, self._stamp = before
            raise
        self._belief = found.belief
        return self._estimate(found.nis, found.dof, found.rounds)

    def _advance(self, at: float | None, commands: Mapping[Any, float] | None) -> None:
        if at is None:
            if commands:
                raise ValueRejectedError("Commands need the time they lasted: give at=, or call predict.")
            return
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

    def _estimate(self, nis: Array, dof: Array, rounds: int) -> Estimate:
        return Estimate(
            self._belief,
            self._layout,
            self._charted,
            self._known,
            float(nis.sum()),
            int(dof.sum()),
            (),
            rounds,
            self._stamp,
        )

    def __repr__(self) -> str:
        sizes = f"{len(self.symbols)} coordinates in {len(self.groups)} groups"
        return f"<Tracker: {sizes}, {len(self.observed)} observed>"


def _positive(key: object, value: float) -> float:
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise ValueRejectedError(f"The uncertainty of '{key}' is positive and finite, not {value!r}.")
    return number
