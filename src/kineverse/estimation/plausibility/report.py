"""Testable joints, verdicts on them, and the plausibility report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from kineverse._names import match_names
from kineverse.errors import ModelError, UnknownNameError, suggest
from kineverse.estimation.identification.result import SURE, IdentificationResult
from kineverse.expressions.expression import Expression
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import ancestors
from kineverse.model.model import Model
from kineverse.model.operation import Operation


@dataclass(frozen=True)
class TestableJoint:
    """Pair of observed frames with one operation between them."""

    tag: str  # of the tested operation
    parent: str  # observed frames
    child: str
    base: str  # frame to which the operation attaches
    frame: str  # the frame that it places there; between them are only frames of the same operation
    moves: bool  # True if the child moves relative to the parent


@dataclass(frozen=True)
class TestableJoints:
    """Testable joints of a model, with the reasons for other frames."""

    joints: tuple[TestableJoint, ...]  # parents first
    untested: Mapping[str, str]  # observed frames that test no single operation, with the reason in words


def find_testable_joints(model: Model, observed: Iterable[str], relative_to: str | None) -> TestableJoints:
    """Find the joints that observed frames can test."""
    known = [*model.frames, WORLD]
    names = list(match_names(observed, known, "frame"))
    if relative_to is not None:
        match_names(relative_to, known, "frame", "relative_to=")

    def chain(name: str) -> list[str]:
        return [*ancestors(name, model.frames.__getitem__), WORLD]

    def moves(name: str) -> bool:
        expressions = [f for f in model.frames[name].factors if isinstance(f, Expression)]
        return any(symbol.has_derivative for factor in expressions for symbol in factor.symbols)

    def root(name: str) -> str:
        return next(f for f in chain(name) if f == WORLD or moves(f))

    def writer(frame: str) -> str:
        return model.history.writers(f"frames/{frame}")[-1]

    names = sorted((f for f in names if f != relative_to), key=lambda f: len(chain(f)))
    # Observed frames of each part. The observer's frame comes last, because others are preferred.
    parts: dict[str, list[str]] = {}
    for name in (*names, *(() if relative_to is None else (relative_to,))):
        parts.setdefault(root(name), []).append(name)
    joints: list[TestableJoint] = []
    untested: dict[str, str] = {}
    for name in names:
        frame = top = root(name)
        part = parts[top]
        first = relative_to if relative_to in part else part[0]
        if first is not None and first != name and name != WORLD:
            # It is fixed to the nearest observed frame of its part.
            nearest = next((f for f in chain(name)[1:] if f in part), first)
            joints.append(TestableJoint(writer(name), nearest, name, model.frames[name].parent, name, False))
            continue
        tags: list[str] = []
        base = top
        while top != WORLD and (not tags or top not in parts):
            if (tag := writer(top)) not in tags:
                tags.append(tag)
            base = model.frames[top].parent
            top = root(base)
        if not tags or top not in parts:
            untested[name] = "no frame with which it could be compared is observed"
            continue
        parent = next((f for f in chain(base) if f in parts[top]), parts[top][0])
        if len(tags) > 1:
            between = ", ".join(f"'{tag}'" for tag in tags)
            untested[name] = (
                f"several operations are between it and '{parent}': {between}; observe a frame in between"
            )
        else:
            joints.append(TestableJoint(tags[0], parent, name, base, frame, True))
    return TestableJoints(tuple(joints), untested)


class ImplausibleError(ModelError):
    """Joints of a model do not explain the observations.

    See Also
    --------
    kineverse.estimation.check_plausibility
    """


@dataclass(frozen=True)
class JointVerdict:
    """Verdict on one joint.

    See Also
    --------
    kineverse.estimation.check_plausibility
    """

    joint: TestableJoint
    # Of the joint as "served", the same displaced ("elsewhere"), a "rigid" connection, a "free" child, and
    # other families, by the observations from implausible_since on, or all.
    probabilities: Mapping[str, float]
    rms: tuple[float, float]  # residuals of positions [m] and orientations [rad] over the same observations
    count: int  # number of observations of both frames
    implausible_since: int | None = None  # first observation that the joint does not explain
    result: IdentificationResult | None = None  # of the alternatives; None if there are too few observations
    replacement: Operation | None = None  # if the joint is rejected and an alternative fits
    reason: str = ""  # for a missing verdict or replacement
    outliers: tuple[int, ...] = ()  # numbers of the observations left out of all of this

    @property
    def tag(self) -> str:
        """Tag of the operation."""
        return self.joint.tag

    @property
    def verdict(self) -> str:
        """Result in words: ``explains``, ``stopped explaining at observation k``, or ``cannot tell``."""
        if self.implausible_since is not None:
            return f"stopped explaining at observation {self.implausible_since}"
        certain = self.probabilities.get("served", 0.0) >= SURE and not self.reason
        return "explains" if certain else "cannot tell"

    @property
    def explains(self) -> bool:
        """True if the joint as served is certain."""
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
    """Verdicts on all testable joints.

    See Also
    --------
    kineverse.estimation.check_plausibility
    """

    verdicts: tuple[JointVerdict, ...]  # for each pair of frames; a second frame of a part is another pair
    untested: Mapping[str, str]  # observed frames that test no single operation, with the reason in words
    false_alarms: float  # probability of rejecting a joint that is as served

    @property
    def implausible(self) -> tuple[JointVerdict, ...]:
        """Verdicts of rejected joints."""
        return tuple(r for r in self.verdicts if r.implausible_since is not None)

    @property
    def replacements(self) -> dict[str, Operation]:
        """Operations for ``edit.replace(tag, operation)``, by tag."""
        return {r.tag: r.replacement for r in reversed(self.verdicts) if r.replacement is not None}

    def repair(self, model: Model) -> tuple[str, ...]:
        """Replace the rejected joints of a model by their replacements, in one edit.

        Returns the tags of the replaced operations; none if no joint was rejected. A rejected joint without a
        replacement stays as it is, while others are replaced.

        Raises
        ------
        ImplausibleError
            If joints were rejected and none of them has a replacement. The message has the reasons.
        """
        replacements = self.replacements
        if not replacements:
            self.raise_if_implausible()
            return ()
        with model.edit() as edit:
            for tag, operation in replacements.items():
                edit.replace(tag, operation)
        return tuple(replacements)

    def raise_if_implausible(self) -> None:
        """Raise if a joint was rejected.

        Raises
        ------
        ImplausibleError
            Naming all rejected joints, and their alternatives.
        """
        if not self.implausible:
            return
        lines = []
        for verdict in self.implausible:
            alternative = verdict.reason or "nothing else is proposed"
            if verdict.replacement is not None and verdict.result is not None:
                alternative = f"the observations show {verdict.result}"
            lines.append(f"\n  '{verdict.tag}' {verdict.verdict}: {alternative}")
        proposed = "Replace these operations by their proposals"
        advice = proposed if self.replacements else "Observe more of the motion"
        summary = f"The model does not explain the observations. {advice}, or check the stated noise:"
        raise ImplausibleError(summary + "".join(lines))

    def __getitem__(self, tag: str) -> JointVerdict:
        # Of several verdicts on an operation, the worst one.
        result = [r for r in self.verdicts if r.tag == tag]
        if not result:
            tags = [r.tag for r in self.verdicts]
            raise UnknownNameError(f"The operation {tag!r} was not judged. {suggest(tag, tags, 'tag')}")
        return min(result, key=lambda r: (r.implausible_since is None, r.probabilities.get("served", 1.0)))

    def __iter__(self) -> Iterator[JointVerdict]:
        return iter(self.verdicts)

    def __len__(self) -> int:
        return len(self.verdicts)

    def __str__(self) -> str:
        lines = [str(verdict) for verdict in self.verdicts]
        lines += [f"'{frame}' is untested: {reason}" for frame, reason in self.untested.items()]
        return "\n".join(lines) or "nothing was observed"
