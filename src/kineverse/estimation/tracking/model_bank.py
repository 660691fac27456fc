"""Bank of trackers over competing models, weighed by evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .estimate import Estimate
from .tracker import Tracker


class HypothesisBank:
    """Trackers of the same observations that assume different things, weighed by evidence.

    The probability of each is that before times the density of all it has seen. Densities compare only if all
    have seen the same, so every update goes to all of them.

    Parameters
    ----------
    trackers
        By name. What they observe has the same names and covariances.
    prior
        The probabilities before; equal ones if None.
    forgetting
        [s⁻¹] How fast what was seen loses its weight, which lets a hypothesis come back that was wrong once,
        such as a lock that opens. 0 for never.

    Raises
    ------
    InvalidValueError
        If there is none, they observe different things, or the probabilities are none.
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
        if not (math.isfinite(forgetting) and forgetting >= 0):
            raise InvalidValueError(f"Forgetting is a rate that is not negative, not {forgetting!r}.")
        self._forgetting = forgetting
        self._logs = {name: math.log(w) for name, w in weights.items()}
        self._estimates = {name: tracker.estimate for name, tracker in self._trackers.items()}

    @property
    def trackers(self) -> Mapping[str, Tracker]:
        """The trackers by name."""
        return MappingProxyType(self._trackers)

    @property
    def estimates(self) -> Mapping[str, Estimate]:
        """What each of them says."""
        return MappingProxyType(self._estimates)

    @property
    def probabilities(self) -> dict[str, float]:
        """How probable each is."""
        logs = np.array(list(self._logs.values()))
        weights = np.exp(logs - np.logaddexp.reduce(logs))
        return dict(zip(self._logs, weights.tolist(), strict=True))

    @property
    def best(self) -> str:
        """The most probable one."""
        return max(self._logs, key=self._logs.__getitem__)

    def predict(self, dt: float, **options: Any) -> None:
        """Move all of them on in time, see :meth:`.Tracker.predict`; commands go to those they move."""
        moved = {name: tracker.copy() for name, tracker in self._trackers.items()}
        estimates = {name: tracker.predict(dt, **options) for name, tracker in moved.items()}
        self._trackers, self._estimates = moved, estimates
        self._forget(dt)

    def update(self, seen: Mapping[str, Any], **options: Any) -> dict[str, float]:
        """Let all of them see the same, see :meth:`.Tracker.update`; return the probabilities.

        If one of them refuses what was seen, all stay as they were.
        """
        # Copies share all that is compiled; whoever fails has spoilt nothing.
        after = {name: tracker.copy() for name, tracker in self._trackers.items()}
        stamps = {name: tracker.estimate.stamp for name, tracker in after.items()}
        estimates = {name: tracker.update(seen, **options) for name, tracker in after.items()}
        first = next(iter(after))
        began, now = stamps[first], estimates[first].stamp
        if began is not None and now is not None:
            self._forget(now - began)
        for name, estimate in estimates.items():
            self._logs[name] += estimate.log_evidence - self._trackers[name].log_evidence
        self._trackers, self._estimates = after, estimates
        return self.probabilities

    def _forget(self, dt: float) -> None:
        if self._forgetting:
            kept = math.exp(-self._forgetting * dt)
            most = max(self._logs.values())
            self._logs = {name: kept * (log - most) for name, log in self._logs.items()}
