"""Protocols of a parametrised relative motion and its derivatives."""

from __future__ import annotations

from typing import NamedTuple, Protocol, Self

from kineverse.lie import Stack


class LinearisedPoses(NamedTuple):
    """Relative poses and what changes them.

    Attributes
    ----------
    pose
        parent_T_child, (N, 4, 4).
    by_parameters
        Twists of the child in the parent's axes, about the child's origin, per unit of each parameter: (N, 6,
        n), linear rows first.
    by_joints
        The same per unit of each joint value, (N, 6, k).
    """

    pose: Stack
    by_parameters: Stack
    by_joints: Stack


class ParameterPrior(NamedTuple):
    """What is believed of parameters beforehand, as whitened residuals (m,) and their derivatives (m, n)."""

    residuals: Stack
    by_parameters: Stack


class MotionModel(Protocol):
    """A member of a family: its n parameters have values, its k joint values are still free."""

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    @property
    def joints(self) -> int:
        """Number of joint values."""
        ...

    def at(self, values: Stack) -> LinearisedPoses:
        """Return the poses at joint values (N, k)."""
        ...

    def moved(self, step: Stack) -> Self:
        """Return the member that a step (n,) in the parameters leads to."""
        ...

    def bounded(self, values: Stack, step: Stack) -> Stack:
        """Return joint values (N, k) after a step, kept where they mean something."""
        ...

    def prior(self) -> ParameterPrior:
        """Return what is believed of the parameters."""
        ...


class FamilyMember(MotionModel, Protocol):
    """A member of a family that is weighed against others."""

    @property
    def name(self) -> str:
        """That of the family."""
        ...

    @property
    def rows(self) -> int:
        """6, or 3 for positions only."""
        ...

    @property
    def kinds(self) -> tuple[int, ...]:
        """What kind of joint value each is: those of one kind share a width."""
        ...

    def beforehand(self, mean: Stack) -> tuple[float, Stack]:
        """Return what is believed of parameters and of the mean of the joint values, for the evidence.

        That is the logarithm of its density here, and the precision (n + k,) beside that of :meth:`prior`
        that keeps directions finite which nothing tells; also (n + k + c,) where a point of the child slides.
        """
        ...

    def named(self) -> dict[str, Stack | float]:
        """Return the parameters by name, for people."""
        ...

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the n parameters."""
        ...
