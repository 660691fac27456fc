"""Which explanations are the same: those that say the same of what can be seen, from about the same state.

Mirror images say the same from different states. Places on a ridge do so as well, but what they cover is one.
"""

from __future__ import annotations

import math

import numpy as np

from kineverse.estimation.noise import Array
from kineverse.symbols import Symbol

from .belief import Belief, inverse
from .charted import Charted
from .layout import Group, Layout
from .modes import Candidate
from .reading import Reader
from .residuals import Residuals
from .ridge import Ridge

# Explanations are one if predictions are fewer deviations of the noise apart, and each coordinate
# of the state fewer of its own.
_SAME, _NEAR = 0.3, 3.0


class Likeness:
    """Compares explanations.

    Parameters
    ----------
    layout, residuals, reader, charted, ridge
        The parts of a tracker.
    """

    def __init__(
        self, layout: Layout, residuals: Residuals, reader: Reader, charted: Charted, ridge: Ridge
    ) -> None:
        self._layout, self._residuals, self._reader = layout, residuals, reader
        self._charted, self._ridge = charted, ridge

    def is_same(
        self, known: Array, turns: frozenset[Symbol], group: Group, one: Candidate, other: Candidate
    ) -> bool:
        """Whether two explanations predict the same of a group, and are near each other.

        Parameters
        ----------
        known
            Values of what is known.
        turns
            The coordinates that come back after a turn.
        group
            What they explain.
        one, other
            The explanations.
        """
        values = self._reader.values_of(other.said)
        nothing = self._reader.nothing()
        as_seen = nothing._replace(values=values, seen=~nothing.seen)
        errors = self._residuals.errors(one.said, as_seen, group.seen)
        if any(float(e @ e) >= _SAME**2 for e, _ in errors.values()):
            return False
        number = self._layout.groups.index(group)
        apart = self._apart(group, other.belief, one.belief, known, turns)
        most = _NEAR**2 * len(apart)
        if float(apart @ other.belief.information[np.ix_(group.t, group.t)] @ apart) < most:
            return True
        mine, theirs = one.belief.standing[number], other.belief.standing[number]
        if (
            mine is None
            or theirs is None
            or (min(mine.looks, theirs.looks) > 1 and mine.branch is not theirs.branch)
        ):
            return False  # they were told apart before
        if number not in other.covariances:
            other.covariances[number] = self._ridge.covariance(number, other.belief)
        return float(apart @ inverse(other.covariances[number]) @ apart) < most

    def _apart(
        self, group: Group, here: Belief, there: Belief, known: Array, turns: frozenset[Symbol]
    ) -> Array:
        """Return about which step in the tangent leads from one place of a group to another."""
        change = there.x[group.x] - here.x[group.x]
        for k, x in enumerate(group.coordinates):
            if x in turns:
                change[k] = math.remainder(change[k], 2 * math.pi)
        basis = self._charted.basis(self._layout.groups.index(group), here.x[group.x], known)
        return np.linalg.pinv(basis) @ change
