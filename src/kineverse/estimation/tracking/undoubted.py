"""What C finds where observations may be wrong, but there is only one way to explain a group.

A group is left to others if something in it is neither right nor wrong beyond doubt. What is taken to be
wrong might be right, and others wrong instead: the evidence of that is bounded from above by what it says
alone, and by the largest density that each of the others can have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse.estimation.noise import Array

from .layout import Layout
from .modes import UNLIKELY, Candidate, Modes
from .native import NativeSolver
from .outliers import Outliers
from .reading import Reading
from .solving import Found

# Who is right with this probability is not doubted: what is left changes nothing that counts.
_SURE = 1 - 1e-6


class Undoubted:
    """Explains groups in C.

    Parameters
    ----------
    layout, native, outliers
        The parts of a tracker.
    """

    def __init__(self, layout: Layout, native: NativeSolver, outliers: Outliers) -> None:
        self._layout, self._native, self._outliers = layout, native, outliers
        self._wrong = np.array([outliers.log_density(one) for one in layout.observations])
        self._fair = math.log(1 - outliers.fraction)

    def explained(
        self, modes: Modes, reading: Reading, known: Array, groups: Sequence[int]
    ) -> tuple[list[Candidate], int]:
        """Return explanations of those groups of which there is no other, and the number of evaluations."""
        single = [number for number in groups if modes.alive[:, number].sum() == 1]
        found = self._native.update(modes.best, reading, known)
        if found is None:
            return [], 0
        right = self._believed(found, reading) > 0.5
        all_right = [n for n in single if right[self._seen(n, reading)].all()]
        candidates = [self._candidate(modes, found, reading, right, all_right)]
        split = [n for n in single if n not in all_right]
        if not split:
            return candidates, found.rounds
        again = self._native.update(modes.best, reading._replace(seen=reading.seen & right), known)
        if again is None:
            return candidates, found.rounds
        rivals = self._rivals(modes, reading, known, right, split)
        candidates.append(self._candidate(modes, again, reading, right, split, rivals))
        return candidates, max(found.rounds, again.rounds)

    def _seen(self, number: int, reading: Reading) -> list[int]:
        return [i for i in self._layout.groups[number].seen if reading.seen[i]]

    def _believed(self, found: Found, reading: Reading) -> Array:
        """Return how probable it is that each observation is right."""
        weights = np.zeros(len(reading.seen))
        assert found.squares is not None
        for i in np.flatnonzero(reading.seen).tolist():
            square, scale = float(found.squares[i]), float(reading.log_scale[i])
            weights[i], _ = self._outliers.judge(square, scale, float(self._wrong[i]))
        return weights

    def _rivals(
        self,
        modes: Modes,
        reading: Reading,
        known: Array,
        right: npt.NDArray[np.bool_],
        groups: Sequence[int],
    ) -> dict[int, float]:
        """Return how much evidence there is at most for each group if a doubted one is right after all."""
        best = dict.fromkeys(groups, -np.inf)
        doubted = {n: [i for i in self._seen(n, reading) if not right[i]] for n in groups}
        peaks = np.maximum(self._fair - reading.log_scale, self._wrong)
        for turn in range(max(map(len, doubted.values()))):
            alone = {n: those[turn] for n, those in doubted.items() if turn < len(those)}
            mask = np.zeros_like(reading.seen)
            mask[list(alone.values())] = True
            found = self._native.update(modes.best, reading._replace(seen=mask), known)
            for n, i in alone.items():
                others = sum(float(peaks[k]) for k in self._seen(n, reading) if k != i)
                gained = np.inf if found is None else _gained(found, modes, n)
                best[n] = max(best[n], gained + self._fair + others)
        return best

    def _candidate(
        self,
        modes: Modes,
        found: Found,
        reading: Reading,
        right: npt.NDArray[np.bool_],
        groups: Sequence[int],
        rivals: dict[int, float] | None = None,
    ) -> Candidate:
        """Return what was found as an explanation of those groups of which it is the only one."""
        believed = self._believed(found, reading)
        sure = []
        for number in groups:
            seen = self._seen(number, reading)
            kept = [i for i in seen if right[i]]
            nothing = float(self._wrong[seen].sum())
            by_outliers = len(kept) * self._fair + nothing - float(self._wrong[kept].sum())
            gained = _gained(found, modes, number) + by_outliers
            found.belief.evidence[number] += by_outliers
            others = [rivals[number]] if rivals else []
            rival = max([nothing, *others] if kept else others)
            if gained - rival > UNLIKELY and all(believed[i] > _SURE for i in kept):
                sure.append(number)
        return Candidate(found.belief, np.empty(0), right.astype(float), found.nis, found.dof, sure)


def _gained(found: Found, modes: Modes, number: int) -> float:
    return float(found.belief.evidence[number] - modes.best.evidence[number])
