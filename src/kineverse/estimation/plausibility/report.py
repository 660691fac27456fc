"""Verdicts on joints, and the plausibility report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from kineverse.errors import ModelError, UnknownNameError, suggest
from kineverse.estimation.identification.result import SURE, IdentificationResult
from kineverse.model.operation import Operation

from .testability import TestableJoint


class ImplausibleError(ModelError):
    """Articulations of a model do not explain what is seen."""


@dataclass(frozen=True)
class JointVerdict:
    """One articulation.

    Attributes
    ----------
    link
        The operation that was judged, and between which frames.
    probabilities
        Of the articulation as ``served``, of the same ``elsewhere``, of a ``rigid`` connection, of the child
        being ``free``, and of other families: on the observations from ``stopped`` on, or on all.
    rms
        What is left of positions [m] and orientations [rad] with the best joint values, root mean square over
        the same observations.
    count
        In how many observations both frames were seen.
    stopped
        The observation from which on it does not explain what is seen; None if it does.
    found
        What was identified instead; None where that was not possible.
    proposal
        The operation to replace the served one by, if it stopped explaining and something else does.
    reason
        Why nothing can be told, or proposed; empty if it can.
    outliers
        The observations that are taken for wrong altogether, and left out of all of this.
    """

    link: TestableJoint
    probabilities: Mapping[str, float]
    rms: tuple[float, float]
    count: int
    stopped: int | None = None
    found: IdentificationResult | None = None
    proposal: Operation | None = None
    reason: str = ""
    outliers: tuple[int, ...] = ()

    @property
    def tag(self) -> str:
        """Of the operation."""
        return self.link.tag

    @property
    def verdict(self) -> str:
        """``explains``, ``stopped explaining at observation k``, or ``cannot tell``."""
        if self.stopped is not None:
            return f"stopped explaining at observation {self.stopped}"
        return "explains" if self.probabilities.get("served", 0.0) >= SURE else "cannot tell"

    @property
    def explains(self) -> bool:
        """Whether it is sure that it explains what was seen."""
        return self.verdict == "explains"

    def __str__(self) -> str:
        likely = sorted(self.probabilities.items(), key=lambda pair: -pair[1])
        shown = ", ".join(f"{name} {p:.1%}" for name, p in likely if p >= 0.001)
        words = f"'{self.tag}' {self.verdict}"
        if self.reason:
            words += f": {self.reason}"
        if shown:
            place, turn = self.rms
            words += f" ({shown}; off by {place * 1e3:.3g} mm, {math.degrees(turn):.2g}°)"
        if self.outliers:
            words += f"; {len(self.outliers)} of {self.count} observations left out as outliers"
        return words


@dataclass(frozen=True)
class Plausibility:
    """All articulations that could be judged.

    Attributes
    ----------
    ratings
        One for each pair of frames; a second frame on the same part is a pair of its own.
    left_out
        Frames that were seen but tell nothing about a single operation, with the reason in words.
    false_alarms
        The probability with which an articulation that is as served is called implausible all the same.
    """

    ratings: tuple[JointVerdict, ...]
    left_out: Mapping[str, str]
    false_alarms: float

    @property
    def implausible(self) -> tuple[JointVerdict, ...]:
        """Those that stopped explaining what is seen."""
        return tuple(r for r in self.ratings if r.stopped is not None)

    @property
    def replacements(self) -> dict[str, Operation]:
        """What to replace, by tag: ``edit.replace(tag, operation)`` for each."""
        return {r.tag: r.proposal for r in reversed(self.ratings) if r.proposal is not None}

    def raise_if_implausible(self) -> None:
        """Raise if an articulation stopped explaining what is seen.

        Raises
        ------
        ImplausibleError
            Naming all of them, and what is there instead.
        """
        if not self.implausible:
            return
        lines = []
        for rating in self.implausible:
            instead = rating.reason or "nothing else is proposed"
            if rating.proposal is not None and rating.found is not None:
                instead = f"what is seen is {rating.found}"
            lines.append(f"\n  '{rating.tag}' {rating.verdict}: {instead}")
        raise ImplausibleError(
            "The model does not explain what is seen. Replace these operations by their proposals, or look "
            "whether the noise is as stated:" + "".join(lines)
        )

    def __getitem__(self, tag: str) -> JointVerdict:
        """Return the rating of an operation; of several, the worst one."""
        found = [r for r in self.ratings if r.tag == tag]
        if not found:
            tags = [r.tag for r in self.ratings]
            raise UnknownNameError(f"The operation {tag!r} was not judged. {suggest(tag, tags, 'tag')}")
        return min(found, key=lambda r: (r.stopped is None, r.probabilities.get("served", 1.0)))

    def __iter__(self) -> Iterator[JointVerdict]:
        return iter(self.ratings)

    def __len__(self) -> int:
        return len(self.ratings)

    def __str__(self) -> str:
        lines = [str(rating) for rating in self.ratings]
        lines += [f"'{frame}' tells nothing: {reason}" for frame, reason in self.left_out.items()]
        return "\n".join(lines) or "nothing was seen"
