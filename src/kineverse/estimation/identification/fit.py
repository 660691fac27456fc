"""What was found: every family with its probability, and the best of them as an operation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, ValueRejectedError, suggest
from kineverse.model.operation import Operation

from .groups import GroupMotion
from .operations import joint_operation
from .rigid import Array
from .turning import turning_joint

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
    parameters: Mapping[str, Array | float]
    covariance: Array
    coordinates: tuple[str, ...]
    frame: Array
    joint_values: Array
    deviations: Array
    residuals: Array
    told: bool
    reason: str
    rows: int
    motion: Any
    outlying: tuple[int, ...] = ()

    @property
    def right(self) -> npt.NDArray[np.int_]:
        """The numbers of the observations that the fit is made of."""
        return np.setdiff1d(np.arange(len(self.residuals)), self.outlying)

    @property
    def range(self) -> Array:
        """The least and the largest of each joint value that was seen, (k, 2)."""
        if not self.joint_values.shape[1]:
            return np.zeros((0, 2))
        values = self.joint_values[self.right]
        return np.column_stack([values.min(axis=0), values.max(axis=0)])

    @property
    def poses(self) -> Array:
        """The poses of the child in the parent at the joint values, (N, 4, 4)."""
        poses: Array = self.motion.at(self.joint_values).pose
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
            outlying=tuple(np.flatnonzero(np.isin(rows, self.outlying)).tolist()),
        )

    @property
    def turned(self) -> float:
        """The most that it turned about its axis from one observation to the next [rad].

        Where turns were counted and this is not well below half a turn, they may be more, or fewer.
        """
        joint = turning_joint(self.motion)
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
        ValueRejectedError
            If only positions of the child were seen, so that its orientation is not known.
        """
        if self.rows == 3 and isinstance(self.motion, GroupMotion) and not as_point:
            raise ValueRejectedError(
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


class Offer(NamedTuple):
    """A family with its probability, and what makes its fit once somebody looks at it."""

    family: str
    probability: float
    make: Callable[[], Fit]


@dataclass(frozen=True, eq=False)
class Found:
    """Every family that was tried, the most probable first. Fits are made when they are looked at.

    Attributes
    ----------
    offers
        One for each family.
    noise_scale
        By how much the standard deviations of the noise were scaled; 1 where it was given.
    """

    offers: tuple[Offer, ...]
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
    def cannot_tell(self) -> bool:
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
        if not self.cannot_tell:
            return str(self.best)
        if self.best.probability >= SURE:
            return f"cannot tell: {self.best.family}, but {self.best.reason}"
        likely = {name: p for name, p in self.probabilities.items() if p > 1.0 - SURE}
        return "cannot tell: " + " or ".join(f"{name} ({p:.0%})" for name, p in likely.items())

    def _fit(self, k: int) -> Fit:
        if k not in self._made:
            self._made[k] = self.offers[k].make()
        return self._made[k]
