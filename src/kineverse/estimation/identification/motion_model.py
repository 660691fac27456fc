"""Protocols of a parametrised relative motion and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, Self

import numpy as np

from kineverse.lie import Array

if TYPE_CHECKING:
    pass


class LinearisedPoses(NamedTuple):
    """Relative poses and their derivatives."""

    pose: Array  # parent_T_child, (N, 4, 4)
    by_parameters: Array  # twists of the child in the parent's axes, (N, m, n)
    by_joints: Array  # the same per unit of each joint value, (N, m, k)


class ParameterPrior(NamedTuple):
    """Gaussian prior of the parameters: whitened residuals (m,) and their derivatives (m, n)."""

    residuals: Array
    by_parameters: Array


class MotionModel(Protocol):
    """Motion with values for its n parameters and k free joint values."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    @property
    def joints(self) -> int:
        """Number of joint values."""

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""

    def retract(self, step: Array) -> Self:
        """Return the motion after a step (n,) in the parameters."""

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step (N, k), limited in size and to their domain."""

    def prior(self) -> ParameterPrior:
        """Return the prior of the parameters."""


class FamilyMember(MotionModel, Protocol):
    """Member of a joint family that is compared with other families."""

    @property
    def name(self) -> str:
        """Name of the family."""

    @property
    def rows(self) -> int:
        """6 for poses, 3 for positions."""

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value. Joint values of one kind share the width of their range."""

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters and of the mean joint values, for the evidence.

        The second result is a precision (n + k,) that is added to the one of :meth:`prior`. It keeps
        directions finite on which there are no data.
        """

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name, for display."""

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the n parameters."""


@dataclass(frozen=True)
class FixedMotion:
    """Motion with fixed parameters. Only its joint values are unknown."""

    motion: MotionModel

    size = 0

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return self.motion.joints

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""
        linear = self.motion.linearise(values)
        return linear._replace(by_parameters=linear.by_parameters[:, :, :0])

    def retract(self, step: Array) -> Self:
        """Return the motion itself: it has no parameters."""
        return self

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step."""
        return self.motion.retract_joints(values, step)

    def prior(self) -> ParameterPrior:
        """Return the empty prior."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))
