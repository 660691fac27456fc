"""Fits of joint families and the identification result."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import Stack
from kineverse.model.operation import Operation

from .ambiguities import slide_child_origin
from .evidence import Evidence
from .families import GroupMotion
from .found_operations import joint_operation
from .motion_model import FamilyMember
from .optimise import Solution
from .unwrapping import find_revolving_joint

SURE = 0.95
"""From this probability on, a family is called the right one."""


@dataclass(frozen=True)
class Fit:
    """The most likely member of one family.

    Attributes
    ----------
    family
        Its name.
    probability
        Of the family, among those that were tried.
    log_evidence
        Natural logarithm; differences between families count.
    parameters
        By name, in the parent's axes: ``axis`` (3,), a ``point`` on it (3,) [m], the ``pitch``
        [m/revolution], the ``centre`` of a sphere (3,), the ``normal`` of a plane (3,), and ``reference``,
        the child's pose at joint values 0, (4, 4).
    covariance
        Of ``coordinates``, (n, n).
    coordinates
        What the rows of the covariance are: ``axis.x`` and ``axis.y`` [rad] are turns of the axis about the
        first two columns of :attr:`frame`, ``point.x`` and ``point.y`` [m] shift it along them, ``pitch``
        [m/revolution]; the rest, ``child.…``, moves the child in the joint's frame.
    frame
        The joint's frame in the parent, (4, 4): its z axis is the axis, its origin the point.
    joint_values
        (N, k), [m] and [rad].
    deviations
        Their standard deviations, (N, k).
    residuals
        What is left of the relative poses, in the parent's axes, (N, m) [m] and [rad].
    told
        Whether the data carry what the family has beyond a pose.
    reason
        If not, why.
    rows
        6 if poses of the child were seen, 3 if positions.
    motion
        The member of the family, as the solver has it.
    outlying
        The numbers of the observations that are wrong altogether if the family is right, from 0. The fit does
        without them; their joint values are the nearest, and what is left of them is large.
    """

    family: str
    probability: float
    log_evidence: float
    parameters: Mapping[str, Stack | float]
    covariance: Stack
    coordinates: tuple[str, ...]
    frame: Stack
    joint_values: Stack
    deviations: Stack
    residuals: Stack
    told: bool
    reason: str
    rows: int
    motion: Any
    outliers: tuple[int, ...] = ()

    @property
    def right(self) -> npt.NDArray[np.int_]:
        """The numbers of the observations that the fit is made of."""
        return np.setdiff1d(np.arange(len(self.residuals)), self.outliers)

    @property
    def range(self) -> Stack:
        """The least and the largest of each joint value that was seen, (k, 2)."""
        if not self.joint_values.shape[1]:
            return np.zeros((0, 2))
        values = self.joint_values[self.right]
        return np.column_stack([values.min(axis=0), values.max(axis=0)])

    @property
    def poses(self) -> Stack:
        """The poses of the child in the parent at the joint values, (N, 4, 4)."""
        poses: Stack = self.motion.at(self.joint_values).pose
        return poses

    @property
    def rms(self) -> tuple[float, float]:
        """What is left of positions [m] and orientations [rad], root mean square over what is right."""
        squares = np.mean(self.residuals[self.right] ** 2, axis=0)
        return math.sqrt(float(squares[:3].sum())), math.sqrt(float(squares[3:].sum()))

    def at(self, rows: npt.NDArray[np.int_]) -> Self:
        """Return the fit with some of its observations."""
        return replace(
            self,
            joint_values=self.joint_values[rows],
            deviations=self.deviations[rows],
            residuals=self.residuals[rows],
            outliers=tuple(np.flatnonzero(np.isin(rows, self.outliers)).tolist()),
        )

    @property
    def turned(self) -> float:
        """The most that it turned about its axis from one observation to the next [rad].

        Where turns were counted and this is not well below half a turn, they may be more, or fewer.
        """
        joint = find_revolving_joint(self.motion)
        return 0.0 if joint is None else float(np.abs(np.diff(self.joint_values[self.right, joint])).max())

    def deviation(self, coordinate: str) -> float:
        """Return the standard deviation of a coordinate.

        Raises
        ------
        UnknownNameError
            If there is no such coordinate.
        """
        if coordinate not in self.coordinates:
            raise UnknownNameError(
                f"A {self.family} fit has no coordinate {coordinate!r}. "
                f"{suggest(coordinate, self.coordinates, 'coordinate')}"
            )
        k = self.coordinates.index(coordinate)
        return math.sqrt(float(self.covariance[k, k]))

    def operation(
        self, name: str, parent: str, child: str | None = None, *, as_point: bool = False
    ) -> Operation:
        """Return the joint as an operation, with the range that was seen as its limits.

        Parameters
        ----------
        name, parent, child
            Of the articulation and its frames; the child is called like the articulation if None.
        as_point
            Whether the child is a point, and it does not matter how its frame is turned.

        Raises
        ------
        InvalidValueError
            If only positions of the child were seen, so that its orientation is not known.
        """
        if self.rows == 3 and isinstance(self.motion, GroupMotion) and not as_point:
            raise InvalidValueError(
                f"Only positions of the child were seen, so how it is turned on '{name}' is not known. If "
                "that does not matter, say as_point=True."
            )
        limits = [(float(low), float(high)) for low, high in self.range]
        return joint_operation(self.motion, limits, name, parent, name if child is None else child)

    def __str__(self) -> str:
        words = [f"{self.family}, {self.probability:.1%}"]
        grouped = isinstance(self.motion, GroupMotion)
        for (low, high), kind in zip(self.range, self.motion.kinds, strict=True):
            unit = ("m", "°")[kind] if grouped else ""
            size = math.degrees(high - low) if unit == "°" else high - low
            words.append(f"{size:.1f}°" if unit == "°" else f"{size:.3g} {unit}".rstrip())
        return ", ".join(words)


class LazyFit(NamedTuple):
    """A family with its probability, and what makes its fit once somebody looks at it."""

    family: str
    probability: float
    make: Callable[[], Fit]


@dataclass(frozen=True, eq=False)
class IdentificationResult:
    """Every family that was tried, the most probable first. Fits are made when they are looked at.

    Attributes
    ----------
    offers
        One for each family.
    noise_scale
        By how much the standard deviations of the noise were scaled; 1 where it was given.
    """

    offers: tuple[LazyFit, ...]
    noise_scale: float = 1.0
    _made: dict[int, Fit] = field(default_factory=dict, repr=False)

    @property
    def fits(self) -> tuple[Fit, ...]:
        """One for each family."""
        return tuple(self._fit(k) for k in range(len(self)))

    @property
    def probabilities(self) -> dict[str, float]:
        """By family, the largest first."""
        return {offer.family: offer.probability for offer in self.offers}

    @property
    def best(self) -> Fit:
        """The most probable one."""
        return self._fit(0)

    @property
    def is_ambiguous(self) -> bool:
        """Whether no family stands out, or what the best one is about is not known."""
        return self.best.probability < SURE or not self.best.told

    def __getitem__(self, family: str) -> Fit:
        tried = [offer.family for offer in self.offers]
        if family not in tried:
            raise UnknownNameError(f"The family {family!r} was not tried. {suggest(family, tried, 'family')}")
        return self._fit(tried.index(family))

    def __iter__(self) -> Iterator[Fit]:
        return iter(self.fits)

    def __len__(self) -> int:
        return len(self.offers)

    def __str__(self) -> str:
        if not self.is_ambiguous:
            return str(self.best)
        if self.best.probability >= SURE:
            return f"cannot tell: {self.best.family}, but {self.best.reason}"
        likely = {name: p for name, p in self.probabilities.items() if p > 1.0 - SURE}
        return "cannot tell: " + " or ".join(f"{name} ({p:.0%})" for name, p in likely.items())

    def _fit(self, k: int) -> Fit:
        if k not in self._made:
            self._made[k] = self.offers[k].make()
        return self._made[k]


# A direction that is known no better than this is not known [rad].
_KNOWN = math.radians(20.0)


def build_fit(solution: Solution[FamilyMember], known: Evidence, log: float, probability: float) -> Fit:
    """Return the fit of a family."""
    motion, covariance, values, covariances = slide_child_origin(
        solution.motion, known.covariance.copy(), known.joint_values, known.joint_covariances
    )
    names = motion.coordinates()
    if "pitch" in names and isinstance(motion, GroupMotion):
        covariance[-1] *= math.tau  # [m/rad] to [m/revolution]
        covariance[:, -1] *= math.tau
    reason = _untested_reason(solution) or _undetermined_reason(names, covariance)
    return Fit(
        family=motion.name,
        probability=probability,
        log_evidence=log,
        parameters=motion.named(),
        covariance=covariance,
        coordinates=names,
        frame=motion.left if isinstance(motion, GroupMotion) else np.eye(4),
        joint_values=values,
        deviations=np.sqrt(np.einsum("nii->ni", covariances)),
        residuals=solution.residuals,
        told=not reason,
        reason=reason,
        rows=solution.residuals.shape[1],
        motion=motion,
    )


def _untested_reason(solution: Solution[FamilyMember]) -> str:
    """Return that a family of joints could not but fit, as two positions always lie on a line."""
    motion, seen = solution.motion, solution.residuals.size
    if not isinstance(motion, GroupMotion) or not motion.size or not motion.joints:
        return ""
    unknown = motion.size + solution.values.size
    return (
        "" if unknown < seen else f"{seen} numbers were seen and it has {unknown} unknowns, so it always fits"
    )


def _undetermined_reason(names: tuple[str, ...], covariance: Stack) -> str:
    """Return what the data do not tell."""
    turns = [i for i, name in enumerate(names) if name.startswith("axis.")]
    if not turns:
        return ""
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[np.ix_(turns, turns)])[-1]))
    return "" if worst <= _KNOWN else f"its axis is known to {math.degrees(worst):.0f}° only"
