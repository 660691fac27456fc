"""Bank of trackers over competing models, weighed by evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from kineverse._checks import as_tolerance
from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .estimate import Estimate
from .tracker import Tracker


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
