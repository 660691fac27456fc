"""Joint families defined by a user's expression."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple, Self

import numpy as np

from kineverse.compile import CompiledFunction
from kineverse.compile import compile as compiled
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.lie import Array, log_so3
from kineverse.symbols import Symbol

from .families import REACH
from .motion_model import LinearisedPoses, ParameterPrior
from .observations import Observations

# Candidate values of a single joint for each observation, and number of random initial members.
_TRIED = 41
_MEMBERS = 8
# Prior standard deviation of the mean of a joint value [m] or [rad].
_MEAN_SPREAD = 3.0


class FamilyParameter(NamedTuple):
    """Prior and bounds of an unknown parameter of a family.

    Attributes
    ----------
    start
        Mean of the prior.
    deviation
        Standard deviation of the prior.
    lower, upper
        Bounds.
    """

    start: float
    deviation: float
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True, eq=False)
class Family:
    """Joint family defined by an expression.

    Attributes
    ----------
    name
        Name of the family, as in ``result["garage"]``.
    transform
        Pose of the child in the parent, (4, 4), as an expression of joints and parameters.
    joints
        Symbols with a value for each observation, and the search range of each.
    parameters
        Symbols with one unknown value, and its prior: a :class:`FamilyParameter` or its first two numbers.
    weight
        Prior weight of the family. That of a revolute joint is 1.

    Raises
    ------
    ShapeError, UnknownNameError, InvalidValueError
        If the transform is not (4, 4), has symbols that are neither joints nor parameters, a deviation is not
        positive, or a range is empty.
    """

    name: str
    transform: Expression
    joints: Mapping[Symbol, tuple[float, float]]
    parameters: Mapping[Symbol, FamilyParameter | tuple[float, float]] = field(default_factory=dict)
    weight: float = 1.0

    def __post_init__(self) -> None:
        if np.shape(self.transform) != (4, 4):
            raise ShapeError(f"The transform of the family '{self.name}' is a 4×4 expression.")
        known = {*self.joints, *self.parameters}
        others = sorted(str(s) for s in self.transform.symbols if s not in known)
        if others:
            raise UnknownNameError(
                f"The transform of the family '{self.name}' depends on {', '.join(others)}, and that is "
                "neither a joint nor a parameter of it."
            )
        object.__setattr__(self, "parameters", {s: FamilyParameter(*u) for s, u in self.parameters.items()})
        for symbol, (low, high) in self.joints.items():
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InvalidValueError(f"The range of the joint '{symbol}' is empty: {low} to {high}.")
        for symbol, unknown in self.unknowns.items():
            if not (unknown.deviation > 0.0 and unknown.lower <= unknown.start <= unknown.upper):
                raise InvalidValueError(
                    f"The parameter '{symbol}' has a positive deviation, and a start within its bounds; not "
                    f"{unknown}."
                )

    @property
    def unknowns(self) -> Mapping[Symbol, FamilyParameter]:
        """Priors of the parameters."""
        return self.parameters  # type: ignore[return-value]

    @cached_property
    def function(self) -> CompiledFunction:
        """Compiled function of joints and parameters: the transform and its derivatives by both."""
        joints, parameters = list(self.joints), list(self.parameters)
        outputs = [self.transform]
        outputs += [self.transform.partial(symbols) for symbols in (parameters, joints) if symbols]
        return compiled(outputs, [*joints, *parameters])


@dataclass(frozen=True, eq=False)
class FamilyMotion:
    """Member of a custom family. Lengths of its poses are in a unit [m], see :mod:`.scale`."""

    family: Family
    rows: int
    parameters: Array
    unit: float = 1.0

    @property
    def name(self) -> str:
        """Name of the family."""
        return self.family.name

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return len(self.family.joints)

    @property
    def kinds(self) -> tuple[int, ...]:
        """Kind of each joint value: each has a range of its own."""
        return tuple(range(self.joints))

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k) and their derivatives."""
        count, rows = len(values), self.rows
        inputs = np.concatenate([values, np.tile(self.parameters, (count, 1))], axis=1)
        poses, *derivatives = (np.array(a) for a in self.family.function.batch(inputs))
        for lengths in (poses, *derivatives):
            lengths[:, :3, 3] /= self.unit
        blocks = iter(derivatives)
        by_parameters = _twists(poses, next(blocks))[:, :rows] if self.size else np.zeros((count, rows, 0))
        by_joints = _twists(poses, next(blocks))[:, :rows] if self.joints else np.zeros((count, rows, 0))
        return LinearisedPoses(poses, by_parameters, by_joints)

    def retract(self, step: Array) -> Self:
        """Return the member after a step, clipped to the bounds of the parameters."""
        bounds = np.array([(u.lower, u.upper) for u in self.family.unknowns.values()]).reshape(-1, 2)
        return replace(self, parameters=np.clip(self.parameters + step, bounds[:, 0], bounds[:, 1]))

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values after a step of at most a quarter of the search range, clipped to the range."""
        ranges = np.array([*self.family.joints.values()]).reshape(-1, 2)
        most = 0.25 * (ranges[:, 1] - ranges[:, 0])
        return np.asarray(np.clip(values + np.clip(step, -most, most), ranges[:, 0], ranges[:, 1]))

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of the parameters."""
        start, deviation = self._prior_moments()
        return ParameterPrior((self.parameters - start) / deviation, np.diag(1.0 / deviation))

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the parameters and of the mean joint values, and its precision.

        The joints of :mod:`.families` also have a mean pose with the density 1. Here the parameters determine
        the mean pose, so the density of a pose within reach is divided out.
        """
        _, deviation = self._prior_moments()
        off = self.prior().residuals
        log = -0.5 * float(off @ off) - float(np.sum(np.log(math.sqrt(math.tau) * deviation)))
        log += 1.5 * math.log(math.tau * REACH**2) + (math.log(8.0 * math.pi**2) if self.rows == 6 else 0.0)
        log -= self.joints * math.log(math.sqrt(math.tau) * _MEAN_SPREAD)
        return log, np.concatenate([np.zeros(self.size), np.full(self.joints, _MEAN_SPREAD**-2)])

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name."""
        return dict(zip(self.coordinates(), self.parameters.tolist(), strict=True))

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(str(s) for s in self.family.parameters)

    def expression(self, joints: Sequence[Expression]) -> Expression:
        """Return the pose of the child in the parent as an expression of other joint symbols."""
        values = dict(zip(self.family.parameters, self.parameters.tolist(), strict=True))
        return self.family.transform.substitute(
            {**dict(zip(self.family.joints, joints, strict=True)), **values}
        )

    def _prior_moments(self) -> tuple[Array, Array]:
        unknowns = self.family.unknowns.values()
        return np.array([u.start for u in unknowns]), np.array([u.deviation for u in unknowns])


def family_starts(
    family: Family, observations: Observations, unit: float
) -> Iterator[tuple[FamilyMotion, Array]]:
    """Yield initial members of a family, at its start and around it, with the nearest joint values."""
    motion = FamilyMotion(
        family, observations.rows, np.array([u.start for u in family.unknowns.values()]), unit
    )
    # A fixed seed makes the result reproducible.
    random = np.random.default_rng(0)
    _, deviation = motion._prior_moments()
    for k in range(_MEMBERS if motion.size else 1):
        member = motion.retract(random.normal(0.0, deviation)) if k else motion
        yield member, _nearest(member, observations)


def _nearest(motion: FamilyMotion, observations: Observations) -> Array:
    each = max(3, round(_TRIED ** (1.0 / max(1, motion.joints)) * (1 if motion.joints < 2 else 3)))
    ranges = motion.family.joints.values()
    candidates = np.array([*product(*(np.linspace(low, high, each) for low, high in ranges))])
    poses = motion.linearise(candidates.reshape(-1, motion.joints)).pose
    distances = np.sum((observations.relative[:, None, :3, 3] - poses[None, :, :3, 3]) ** 2, axis=-1)
    if observations.rows == 6:
        turns = np.swapaxes(observations.relative[:, None, :3, :3], -1, -2) @ poses[None, :, :3, :3]
        lever = float(np.mean(np.einsum("nii->ni", observations.child_covariance)[:, :3]))
        angle = float(np.mean(np.einsum("nii->ni", observations.child_covariance)[:, 3:]))
        distances = distances + lever / angle * np.sum(log_so3(turns) ** 2, axis=-1)
    return np.asarray(candidates.reshape(-1, motion.joints)[np.argmin(distances, axis=1)])


def _twists(poses: Array, derivatives: Array) -> Array:
    """Return twists of the child in the parent's axes, (N, 6, n), from derivatives (N, 4, 4, n)."""
    turning = np.einsum("nijk,nlj->nilk", derivatives[:, :3, :3], poses[:, :3, :3])
    omega = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    return np.concatenate([derivatives[:, :3, 3], omega], axis=1)
