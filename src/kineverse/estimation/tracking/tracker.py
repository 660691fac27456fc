"""Recursive state estimation of a model from noisy measurements, and a bank of trackers of several models."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, as_tolerance, finite_number
from kineverse._names import answer_foreign_names
from kineverse._runtime import CallLock, one_at_a_time
from kineverse._synonyms import TRACKER_SYNONYMS
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.noise import Outliers, as_outliers
from kineverse.lie import Array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bounds import SpeedLocks, arrange_state
from .estimate import Estimate, RecentPoses, Step, TrackLoss, collect_recent_poses
from .gaussian_sum_filter import UpdateStep
from .initialization import InitialValues, make_initial_belief
from .measurements import ObservedLike, build_measurement_models, list_observed, require_mapping, require_time
from .native import native_library
from .process_model import (
    INITIAL_SPEED_TIME,
    SPEED_DECAY,
    Process,
    choose_processes,
    default_process_noise,
)
from .recursion import FixedLag, Recursion
from .residuals import Measurements
from .speed_process import SpeedProcess, SpeedUpdate, SpeedValue, build_speed_models
from .state_space import InformationState

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


@answer_foreign_names("A tracker", TRACKER_SYNONYMS)
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
        Speeds, if these are estimated, start at 0 by default.
    uncertainty
        Initial standard deviations [m], [rad], by coordinate, or by speed for directions that are no
        coordinate's; by default half the width of the limits, π for angles, 10 m. Those of estimated speeds
        [m/s], [rad/s] by speed.
    process
        ``"position"`` for positions that move at random, ``"velocity"`` for speeds that change at random and
        are estimated, ``"static"`` for a state that is constant unless it is commanded. By default decaying
        speeds are estimated where rates, as of wheels, move a part or speeds are measured; other positions
        move at random.
    process_noise
        Process noise by speed or coordinate: the variance per second, or for ``process="velocity"`` the
        spectral density of the acceleration [m²/s³], [rad²/s³]; 0 for a part that never moves. By default
        that of furniture that a hand moves. Without ``process=`` it is that of positions.
    outliers
        Outlier model: :class:`Outliers`, or True for the default one. None if all errors have the stated
        noise.
    locks
        True if coordinates held by a lock of the model ignore commands and process noise.
    inputs
        Coordinates that are measured elsewhere, such as a robot's joints; each step takes their values.
    lost_after
        Number of updates in a row that refute a group of coordinates until it is lost: all of its
        measurements are rejected, or without an outlier model, their normalised innovation squared is one in
        a million.
    restart
        True if lost groups restart from the initial uncertainty where that explains the measurements.
    lag
        Time by which measurements may come late [s]; they are applied in the order of their times.
    keep
        Number of recent updates that :attr:`recent` has.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> tracker = kv.estimation.Tracker(model, ["kitchen/fridge_door"])
    >>> pose = model.fk("kitchen/fridge_door")({"kitchen/fridge_door": 0.9})
    >>> estimate = tracker.update({"kitchen/fridge_door": pose})
    >>> round(estimate.state["kitchen/fridge_door"], 2)
    0.9
    >>> round(estimate.deviation["kitchen/fridge_door"], 3)
    0.017
    """

    def __init__(
        self,
        model: ModelView,
        observed: Iterable[ObservedLike],
        *,
        start: StateLike | None = None,
        uncertainty: StateLike | None = None,
        process: Process | None = None,
        process_noise: StateLike | None = None,
        outliers: Outliers | bool | None = None,
        locks: bool = False,
        inputs: Symbol | str | Iterable[Symbol | str] = (),
        lost_after: int = 10,
        restart: bool = True,
        lag: float = 0.0,
        keep: int = 600,
    ) -> None:
        given = locals().items()
        self._options = {name: value for name, value in given if name not in ("self", "model", "observed")}
        self._observed = list_observed(observed)
        lost_after, keep = as_count("lost_after", lost_after, 1), as_count("keep", keep, 1)
        lag = as_tolerance(lag, "lag= [s]")
        keys = (inputs,) if isinstance(inputs, str | Symbol) else inputs
        if not isinstance(keys, Iterable):
            raise InvalidValueError(f"inputs= has names of coordinates, not {inputs!r:.80}.")
        symbols = frozenset(k if isinstance(k, Symbol) else model.symbol(k) for k in keys)
        models = build_measurement_models(model, self._observed)
        of_speeds = [one for one in models if any(s.order for s in one.value.symbols)]
        of_state = tuple(one for one in models if one not in of_speeds)
        layout, limits = arrange_state(model, of_state, symbols)
        self.model, self._layout = model, layout
        outliers = as_outliers(outliers, has_gate=True)
        self._update_step = UpdateStep(layout, limits, outliers)
        stated, process_model = self._read_noise(process_noise), self._update_step.process_model
        speed_models = build_speed_models(self._update_step, of_speeds)
        measured = {one.number for one in speed_models.values()}
        processes = choose_processes(process, process_model, layout, stated, measured)
        if groups := [n for n, each in enumerate(processes) if each == "velocity"]:
            decay = SPEED_DECAY if process is None else math.inf
            residuals = self._update_step.residuals
            self._update_step.velocity = SpeedProcess(layout, process_model, groups, residuals, decay)
        values = np.array([np.nan if s.value is None else s.value for s in layout.inputs])
        known = np.nan_to_num(values)
        initial = InitialValues.read(self._update_step, start, uncertainty)
        first = make_initial_belief(model, self._update_step, initial, known)
        noise = {**default_process_noise(self._update_step, processes, first.x, known), **stated}
        variances = {v: INITIAL_SPEED_TIME * q for v, q in noise.items()}
        first = replace(first, speed_variances={**variances, **first.speed_variances})
        held = SpeedLocks(model, layout, self._update_step.process_model) if locks else None
        self._speed_update = SpeedUpdate(self._update_step, speed_models)
        self._recursion = Recursion(
            self._update_step, self._speed_update, first, noise, held, lost_after, restart
        )
        self._now = self._recursion.start(values, getattr(start, "stamp", None))
        self._buffer = FixedLag(self._recursion, lag)
        self._lock = CallLock()
        self._recent: deque[Step] = deque(maxlen=keep)

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
        lower, upper = self._update_step.limits.lower.tolist(), self._update_step.limits.upper.tolist()
        return {s: (low, high) for s, low, high in zip(self.symbols, lower, upper, strict=True)}

    @property
    def periodic(self) -> frozenset[Symbol]:
        """Coordinates whose turn no observation determines; it is the one nearest to the prediction."""
        return frozenset(self._update_step.periods)

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the constraints that limit the state."""
        return self._update_step.limits.names

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the observations, in order."""
        return (*(one.name for one in self._layout.observations), *self._speed_update.models)

    @property
    def estimate(self) -> Estimate:
        """Present estimate; innovations and outliers are those of the last update."""
        return Estimate(self._now, self._update_step)

    @property
    def log_evidence(self) -> float:
        """Log density of all measurements so far, given the model."""
        return self._now.mixture.log_evidence

    @property
    def recent(self) -> RecentPoses:
        """Recently measured poses."""
        return collect_recent_poses(self.model, self._layout, self._recent)

    @property
    def process_noise(self) -> dict[Symbol, float]:
        """Process noise by speed."""
        return dict(self._recursion.noise)

    def copy(self) -> Tracker:
        """Return an independent tracker in the same state; compiled code is shared, also between threads.

        See Also
        --------
        kineverse.estimation.Tracker
        """
        with self._lock:
            other = copy.copy(self)
            other._lock = CallLock()
            other._recent, other._buffer = self._recent.copy(), copy.copy(self._buffer)
        return other

    @one_at_a_time
    def rebuild(self, model: ModelView | None = None) -> Tracker:
        """Return a tracker of an edited model with the same observations and options.

        It starts again, and repeats the recent updates in the order of their times, without commands. Turns
        are those of this tracker.

        Parameters
        ----------
        model
            The edited model; the model of this tracker, as it is now, if None.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> tracker = kv.estimation.Tracker(model, ["kitchen/fridge_door"])
        >>> with model.edit() as edit:
        ...     edit.constrain("ajar", 0, kv.position("kitchen/fridge_door"), 0.3)
        'constraint ajar'
        >>> tracker.rebuild().limits
        {kitchen/fridge_door: (0.0, 0.3)}
        """
        other = Tracker(self.model if model is None else model, self._observed, **self._options)
        start = other._now
        other._repeat(self)
        turns = other._turns_from(self)
        if turns.any():

            def turned(belief: InformationState) -> InformationState:
                result = belief.copy()
                result.x += turns
                return result

            other._now = replace(start, mixture=start.mixture.map(turned))
            other._buffer.events = ()
            other._recent.clear()
            other._repeat(self)
        return other

    def _repeat(self, other: Tracker) -> None:
        recent = list(other._recent)
        if all(one.stamp is not None for one in recent):
            recent.sort(key=lambda one: one.stamp or 0.0)
        for one in recent:
            self._update(one)

    def _turns_from(self, other: Tracker) -> Array:
        """Return the whole turns of periodic coordinates to those of another tracker (n,) [rad]."""
        theirs, mine = other.estimate.state, self._now.mixture.best.x.copy()
        turns = np.zeros(len(mine))
        for k, x in enumerate(self.symbols):
            if x in self._update_step.periods and x in theirs:
                period = self._update_step.periods[x]
                turns[k] = period * round((theirs[x] - mine[k]) / period)
        return turns

    @one_at_a_time
    def reset(
        self, start: StateLike | None = None, *, uncertainty: StateLike | None = None, at: float | None = None
    ) -> Estimate:
        """Start again, or set the estimate of some coordinates.

        Parameters
        ----------
        start
            Values of some coordinates, and of speeds if these are estimated. Other coordinates keep their
            estimate. Without values and uncertainties, all start as the tracker did.
        uncertainty
            Standard deviations, as at construction; by default the initial ones.
        at
            Time from now on [s]; the time stays if None. If it is earlier, :attr:`recent` is emptied.

        Raises
        ------
        UnknownNameError, InvalidValueError
            For names that are not estimated, and numbers that are not finite.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> tracker = kv.estimation.Tracker(model, ["kitchen/fridge_door"])
        >>> tracker.reset({"kitchen/fridge_door": 0.4}).state["kitchen/fridge_door"]
        0.4
        """
        tangent_space, now = self._layout.tangent_space, self._now
        stamp = now.stamp if at is None else require_time(at)
        values = InitialValues.read(self._update_step, start, uncertainty)
        first, groups = self._recursion.first, list(range(len(self._layout.groups)))
        if (start is not None and len(start)) or (uncertainty is not None and len(uncertainty)):
            speeds = {v for x in values.coordinates for v in tangent_space.rate_row(x)}
            speeds &= {*tangent_space.tangent}
            set_now = [tangent_space.tangent.index(v) for v in speeds] + list(values.deviations)
            spread = np.sqrt(np.diag(self.estimate.covariance))
            spread[set_now] = first.deviations[set_now]
            kept = {v: u for v, u in self.estimate.speeds.items() if v not in speeds}
            variances = {v: self.estimate.deviation[v] ** 2 for v in kept}
            first = replace(
                first,
                x=now.mixture.best.x.copy(),
                deviations=spread,
                speeds={**first.speeds, **kept},
                speed_variances={**first.speed_variances, **variances},
            )
            first = first.with_values(self._update_step, values)
            changed = {*values.coordinates, *values.speeds, *values.speed_deviations}
            changed |= {tangent_space.tangent[k] for k in values.deviations}
            speeds_of = self._update_step.process_model.speeds_of
            moving = [{*g.coordinates, *g.tangent, *speeds_of(n)} for n, g in enumerate(self._layout.groups)]
            groups = [n for n, symbols in enumerate(moving) if changed & symbols]
        initial = first.spread(self._update_step, np.nan_to_num(now.inputs))
        mixture = now.mixture.replace_groups(initial, groups)
        chosen = np.isin(np.arange(len(self._layout.groups)), groups)
        loss = TrackLoss(
            np.where(chosen[list(self._layout.group_of)], 0, now.loss.rejected),
            np.where(chosen, 0, now.loss.refuted),
            now.loss.is_lost & ~chosen,
        )
        self._now = replace(now, mixture=mixture, loss=loss, stamp=stamp, reading=None)
        self._buffer.events = ()
        if stamp is not None and now.stamp is not None and stamp < now.stamp:
            self._recent.clear()
        return self.estimate

    @one_at_a_time
    def predict(
        self,
        dt: float,
        commands: StateLike | None = None,
        inputs: StateLike | None = None,
        process_noise: StateLike | None = None,
    ) -> Estimate:
        """Predict the state with commanded speeds and process noise.

        Parameters
        ----------
        dt
            Time step [s], not negative.
        commands
            Commanded speeds by symbol or name [m/s], [rad/s]; others are 0, or their estimates.
        inputs
            Values of the inputs; the last ones if None.
        process_noise
            Overrides the tracker's process noise for this step, by speed or coordinate, e.g. for a part at
            rest.

        Raises
        ------
        InvalidValueError
            If time goes backwards or a number is not finite.
        UnknownNameError
            For a speed with which no estimated coordinate moves.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> start = {"kitchen/fridge_door": 0.2}
        >>> tracker = kv.estimation.Tracker(model, ["kitchen/fridge_door"], start=start)
        >>> estimate = tracker.predict(1.0, commands={"kitchen/fridge_door:velocity": 0.3})
        >>> round(estimate.state["kitchen/fridge_door"], 2)
        0.5
        """
        dt = as_tolerance(dt, "The length of a step [s]")
        before, known = self._now, self._recursion.read_inputs(self._now.inputs, inputs)
        event = self._make_step(None, None, commands, inputs, process_noise)
        self._now = self._recursion.predict(replace(before, inputs=known), dt, event)
        self._buffer.append(self._now.stamp, before, replace(event, stamp=self._now.stamp))
        return self.estimate

    def _read_commands(self, commands: StateLike | None) -> dict[Symbol, float]:
        speeds = {}
        for key, value in require_mapping({} if commands is None else commands, "commands=").items():
            if (speed := finite_number(value)) is None:
                raise InvalidValueError(f"The commanded speed '{key}' is a finite number, not {value!r:.80}.")
            speeds[self._update_step.process_model.speed(key)] = speed
        return speeds

    def _read_noise(self, process_noise: StateLike | None) -> dict[Symbol, float]:
        result, noise = {}, {} if process_noise is None else process_noise
        for key, value in require_mapping(noise, "process_noise=").items():
            subject = f"The process noise of '{key}' (0 for a part that never moves)"
            result[self._update_step.process_model.speed(key)] = as_tolerance(value, subject)
        return result

    @one_at_a_time
    def update(
        self,
        measurements: Mapping[str, Any],
        *,
        at: float | None = None,
        commands: StateLike | None = None,
        inputs: StateLike | None = None,
        process_noise: StateLike | None = None,
    ) -> Estimate:
        """Update the state with measurements.

        Parameters
        ----------
        measurements
            By name of the observation: poses 4×4, vectors or numbers, or pairs of these and
            their covariance. Absent names are missing.
        at
            Time of the measurements [s]; the state is predicted to it first. Late ones are applied at their
            time, up to the lag.
        commands
            Speeds during this prediction.
        process_noise
            Process noise during this prediction, as for :meth:`predict`.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For an invalid measurement, naming it, or if time goes backwards by more than the lag. The belief
            does not change then.

        See Also
        --------
        kineverse.estimation.Tracker
        """
        require_mapping(measurements, "A set of measurements")
        of_state, of_speeds = self._speed_update.read(measurements)
        reading = self._update_step.reader.read(of_state)
        return self._update(self._make_step(at, reading, commands, inputs, process_noise, of_speeds))

    @one_at_a_time
    def update_poses(
        self,
        poses: npt.ArrayLike,
        mask: npt.ArrayLike | None = None,
        *,
        covariances: npt.ArrayLike | None = None,
        at: float | None = None,
        commands: StateLike | None = None,
        inputs: StateLike | None = None,
        process_noise: StateLike | None = None,
    ) -> Estimate:
        """Update with poses in an array (m, 4, 4), in the order of the observations; see :meth:`update`.

        Parameters
        ----------
        poses
            Poses of all frames; entries of missing ones are ignored.
        mask
            True for each measured pose (m,); all if None.
        covariances
            Covariances (m, 6, 6) of these poses; entries of missing ones are ignored. Those of the
            observations if None.
        at, commands, inputs, process_noise
            As in :meth:`update`.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> tracker = kv.estimation.Tracker(model, ["kitchen/fridge_door", "kitchen/oven_door"])
        >>> state = model.default_state() | {"kitchen/fridge_door": 0.5}
        >>> poses = [model.fk(frame)(state) for frame in tracker.observed]
        >>> estimate = tracker.update_poses(np.stack(poses), mask=[True, False])
        >>> round(estimate.state["kitchen/fridge_door"], 2)
        0.5
        """
        reading = self._update_step.reader.read_poses(poses, mask, covariances)
        return self._update(self._make_step(at, reading, commands, inputs, process_noise))

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

    def _make_step(
        self,
        at: float | None,
        reading: Measurements | None,
        commands: StateLike | None,
        inputs: StateLike | None,
        process_noise: StateLike | None,
        speeds: Mapping[str, SpeedValue] | None = None,
    ) -> Step:
        """Return an event after checks. The caller may use its arrays again."""
        if reading is not None:
            reading = reading._replace(values=reading.values.copy(), mask=reading.mask.copy())
            native = self._update_step.native
            if native is None or not native.are_rigid(reading):
                self._update_step.reader.check_poses(reading)
            if at is None and (commands or process_noise):
                subject = "Commands" if commands else "process_noise="
                raise InvalidValueError(f"{subject} need the time they lasted: give at=, or call predict.")
        noise, speeds_now = self._read_noise(process_noise), self._read_commands(commands)
        stamp = None if at is None else require_time(at)
        return Step(stamp, reading, speeds or {}, copy.copy(inputs), speeds_now, noise)

    def _update(self, event: Step) -> Estimate:
        before, stamp = self._now, event.stamp
        if stamp is not None and before.stamp is not None and stamp < before.stamp:
            if not self._buffer.lag:
                raise InvalidValueError(
                    f"Time goes backwards: an observation at {stamp:g} s after one at {before.stamp:g} s. A "
                    "tracker with lag= takes measurements that come late."
                )
            self._now = self._buffer.insert(stamp, event)
        else:
            self._now = self._recursion.apply(before, event)
            self._buffer.append(self._now.stamp, before, event)
        known = dict(zip(self._layout.inputs, self._now.inputs.tolist(), strict=True))
        inputs = State(known) if known else None
        self._recent.append(Step(stamp, event.reading, event.speeds, inputs))
        return self.estimate

    def __repr__(self) -> str:
        sizes = f"{len(self.symbols)} coordinates in {len(self.groups)} groups"
        return f"<Tracker: {sizes}, {len(self.observed)} observed>"


class HypothesisBank:
    """Bank of trackers with competing models of the same observations, weighed by evidence.

    The probability of each is its prior times the density of all its measurements, normalised. Densities
    compare only for equal measurements, so every update goes to all trackers.

    Parameters
    ----------
    trackers
        By name. Their observations have the same names and covariances.
    prior
        Prior probabilities; equal ones if None.
    forgetting
        Rate [s⁻¹] at which evidence decays. A hypothesis that was wrong can then become probable again, such
        as a lock that opens. 0 for no decay.

    Raises
    ------
    InvalidValueError
        If there is no tracker, the observations differ, or the probabilities are not positive.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> other = model.copy()
    >>> with other.edit() as edit:
    ...     edit.constrain("stuck", 0, kv.position("kitchen/fridge_door"), 0.1)
    'constraint stuck'
    >>> frames = ["kitchen/fridge_door"]
    >>> bank = kv.estimation.HypothesisBank(
    ...     {"free": kv.estimation.Tracker(model, frames), "stuck": kv.estimation.Tracker(other, frames)}
    ... )
    >>> probabilities = bank.update({frames[0]: model.fk(frames[0])({"kitchen/fridge_door": 0.9})})
    >>> bank.best
    'free'
    """

    def __init__(
        self,
        trackers: Mapping[str, Tracker],
        prior: Mapping[str, float] | None = None,
        forgetting: float = 0.0,
    ) -> None:
        if not trackers:
            raise InvalidValueError("There is no hypothesis to weigh.")
        self._trackers = dict(trackers)
        first, *others = self._trackers
        for name in others:
            if set(self._trackers[name].observed) != set(self._trackers[first].observed):
                raise InvalidValueError(
                    f"'{name}' and '{first}' observe different things, so their evidence does not compare."
                )
        weights = dict.fromkeys(trackers, 1.0) if prior is None else dict(prior)
        if weights.keys() != self._trackers.keys():
            strange = next(iter(weights.keys() ^ self._trackers.keys()))
            raise UnknownNameError(f"The prior does not fit. {suggest(strange, trackers, 'hypothesis')}")
        if not all(math.isfinite(w) and w > 0 for w in weights.values()):
            raise InvalidValueError(f"Probabilities are positive, not {weights!r}.")
        self._forgetting = as_tolerance(forgetting, "The rate of forgetting")
        self._logs = {name: math.log(w) for name, w in weights.items()}

    @property
    def trackers(self) -> Mapping[str, Tracker]:
        """Trackers by name."""
        return MappingProxyType(self._trackers)

    @property
    def estimates(self) -> Mapping[str, Estimate]:
        """Estimate of each tracker, by name."""
        return {name: tracker.estimate for name, tracker in self._trackers.items()}

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each tracker, by name."""
        logs = np.array(list(self._logs.values()))
        return dict(zip(self._logs, np.exp(logs - np.logaddexp.reduce(logs)).tolist(), strict=True))

    @property
    def best(self) -> str:
        """Name of the most probable tracker."""
        return max(self._logs, key=self._logs.__getitem__)

    def predict(self, dt: float, **options: Any) -> None:
        """Predict all trackers, see :meth:`.Tracker.predict`; commands go to those they move."""
        moved = {name: tracker.copy() for name, tracker in self._trackers.items()}
        for tracker in moved.values():
            tracker.predict(dt, **options)
        self._trackers = moved
        self._forget(dt)

    def update(self, measurements: Mapping[str, Any], **options: Any) -> dict[str, float]:
        """Update all trackers with the same measurements and return the probabilities.

        See :meth:`.Tracker.update`. If one of them refuses the measurements, none changes.
        """
        # Copies share compiled code. After an error the originals are unchanged.
        after = {name: tracker.copy() for name, tracker in self._trackers.items()}
        for tracker in after.values():
            tracker.update(measurements, **options)
        began, now = (next(iter(each.values())).estimate.stamp for each in (self._trackers, after))
        if began is not None and now is not None:
            self._forget(now - began)
        for name, tracker in after.items():
            self._logs[name] += tracker.log_evidence - self._trackers[name].log_evidence
        self._trackers = after
        return self.probabilities

    def _forget(self, dt: float) -> None:
        if self._forgetting:
            kept = math.exp(-self._forgetting * dt)
            largest = max(self._logs.values())
            self._logs = {name: kept * (log - largest) for name, log in self._logs.items()}
