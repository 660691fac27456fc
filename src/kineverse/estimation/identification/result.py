"""Fits of joint families, their projection onto further observations, and the identification result."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from kineverse._names import answer_foreign_names
from kineverse._rich_display import Html, TableDisplay, element, html_table
from kineverse._synonyms import IDENTIFICATION_SYNONYMS
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.linear_algebra import invert_matrices, singularity_named
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array
from kineverse.model.operation import Operation

from .curve import CurveMotion
from .families import GroupMotion
from .joint_operations import joint_operation
from .least_squares import Solution, levenberg_marquardt
from .marginal_likelihood import Evidence, find_revolving_joint, slide_child_origin
from .motion_functions import FamilyMember, FixedMotion, MotionModel
from .observations import Observations
from .outlier_rejection import classify_inliers

SURE = 0.95  # least probability at which the best family is reported as identified


class NoiseDeviations(NamedTuple):
    """Standard deviations of the noise."""

    position: float  # of each coordinate of a position [m]
    orientation: float  # of each component of the rotation vector of an orientation [rad]


@dataclass(frozen=True)
class Fit(TableDisplay):
    """Most likely member of one joint family.

    Attributes
    ----------
    probability
        Posterior probability of the family among those that were compared.
    log_evidence
        Natural logarithm of the evidence. Only differences between families are meaningful.
    parameters
        Parameters by name, in the parent's axes: ``axis`` (3,), a ``point`` on it (3,) [m], the ``pitch``
        [m/revolution], the ``centre`` of a sphere (3,), the ``normal`` of a plane (3,), and ``reference``,
        the child's pose at joint values 0, (4, 4).
    covariance
        Covariance of ``coordinates``, (n, n).
    coordinates
        Names of the rows of the covariance. ``axis.x`` and ``axis.y`` [rad] rotate the axis about the first
        two columns of :attr:`frame`, ``point.x`` and ``point.y`` [m] shift it along them, ``pitch`` is in
        [m/revolution]; the others, ``child.…``, move the child in the joint's frame.
    frame
        The joint's frame in the parent, (4, 4). Its z axis is the axis and its origin the point.
    joint_values
        Joint values, an array (N, k), [m] and [rad]: one row for each observation, also for k = 1. A curve's
        is the length along it [m].
    deviations
        Standard deviations of the joint values, (N, k).
    residuals
        Residuals of the relative poses in the parent's axes, (N, m) [m] and [rad].
    is_determined
        True if the data determine the parameters of the family.
    reason
        Explanation if they do not, else empty.
    rows
        6 if poses of the child were observed, 3 for positions.
    motion
        The motion model with its parameters.
    outliers
        Indices of the observations that are outliers under this family. The fit ignores them. Their joint
        values are those of the nearest poses, and their residuals are large.
    misfit
        Size of the residuals relative to the stated noise, or to the noise that was estimated: about 1 if the
        family and the noise are right. NaN for a family that leaves no residuals, such as ``free``.

    See Also
    --------
    kineverse.estimation.identify
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
    is_determined: bool
    reason: str
    rows: int
    motion: Any
    outliers: tuple[int, ...] = ()
    misfit: float = math.nan

    @property
    def inliers(self) -> npt.NDArray[np.int_]:
        """Indices of the observations that are no outliers."""
        return np.setdiff1d(np.arange(len(self.residuals)), self.outliers)

    @property
    def range(self) -> Array:
        """Least and largest value of each joint value over the inliers, an array (k, 2) [m] or [rad].

        A joint with one joint value has one row: ``(low, high), = fit.range``.
        """
        if not self.joint_values.shape[1]:
            return np.zeros((0, 2))
        values = self.joint_values[self.inliers]
        return np.column_stack([values.min(axis=0), values.max(axis=0)])

    @property
    def poses(self) -> Array:
        """Poses of the child in the parent at the joint values, (N, 4, 4)."""
        return np.asarray(self.motion.linearise(self.joint_values).pose)

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square residual of positions [m] and orientations [rad] over the inliers."""
        squares = np.mean(self.residuals[self.inliers] ** 2, axis=0)
        return math.sqrt(float(squares[:3].sum())), math.sqrt(float(squares[3:].sum()))

    def select(self, rows: npt.NDArray[np.int_]) -> Self:
        """Return the fit restricted to some of its observations."""
        return replace(
            self,
            joint_values=self.joint_values[rows],
            deviations=self.deviations[rows],
            residuals=self.residuals[rows],
            outliers=tuple(np.flatnonzero(np.isin(rows, self.outliers)).tolist()),
        )

    @property
    def largest_turn(self) -> float:
        """Largest rotation about the axis from one inlier to the next [rad].

        The count of revolutions is reliable only if this is well below π.
        """
        joint = find_revolving_joint(self.motion)
        return 0.0 if joint is None else float(np.abs(np.diff(self.joint_values[self.inliers, joint])).max())

    def deviation(self, coordinate: str) -> float:
        """Return the standard deviation of a coordinate."""
        if coordinate not in self.coordinates:
            hint = suggest(coordinate, self.coordinates, "coordinate")
            raise UnknownNameError(f"A {self.family} fit has no coordinate {coordinate!r}. {hint}")
        k = self.coordinates.index(coordinate)
        return math.sqrt(float(self.covariance[k, k]))

    def operation(
        self, name: str, parent: str, child: str | None = None, *, as_point: bool = False, limits: bool = True
    ) -> Operation:
        """Return the joint as an operation, with the observed range as its limits.

        Parameters
        ----------
        name, parent, child
            Names of the articulation and its frames. By default the child is named like the articulation.
        as_point
            True if the child is a point, so that the orientation of its frame does not matter.
        limits
            False for a joint without limits. The observed range is not the range of the joint: with limits, a
            controller pulls no further than was observed. Beyond its ends a curve continues straight.

        Raises
        ------
        InvalidValueError
            If only positions of the child were observed, so that its orientation is unknown.
        """
        if self.rows == 3 and isinstance(self.motion, (GroupMotion, CurveMotion)) and not as_point:
            raise InvalidValueError(
                f"Only positions of the child were observed, so its orientation on '{name}' is unknown. If "
                "that does not matter, say as_point=True."
            )
        ranges = [(float(low), float(high)) for low, high in self.range]
        child = name if child is None else child
        return joint_operation(self.motion, ranges, name, parent, child, limited=limits)

    def __str__(self) -> str:
        words = [f"{self.family}, {self.probability:.1%}"]
        grouped = isinstance(self.motion, (GroupMotion, CurveMotion))
        for (low, high), kind in zip(self.range, self.motion.kinds, strict=True):
            unit = ("m", "°")[kind] if grouped else ""
            size = math.degrees(high - low) if unit == "°" else high - low
            words.append(f"{size:.1f}°" if unit == "°" else f"{size:.3g} {unit}".rstrip())
        return ", ".join(words)

    def _repr_html_(self) -> str:
        rows = [(name, _format_numbers(value), self._spread(name)) for name, value in self.parameters.items()]
        caption = f"{self}{'' if self.is_determined else f'; not determined: {self.reason}'}"
        return html_table(caption, ("parameter", "value", "standard deviations"), rows)

    def _spread(self, parameter: str) -> str:
        """Return the standard deviations of the coordinates of a parameter, in their units."""
        own = [name for name in self.coordinates if name.partition(".")[0] == parameter]
        units = {"axis": "rad", "point": "m", "pitch": "m/revolution"}
        unit = units.get(parameter, "")
        return ", ".join(f"{name}: {self.deviation(name):.2g} {unit}".rstrip() for name in own)


def _format_numbers(value: Array | float) -> str:
    if np.ndim(value) < 2:
        return ", ".join(f"{number:.5g}" for number in np.ravel(value))
    return f"array of {' × '.join(map(str, np.shape(value)))}"


class LazyFit(NamedTuple):
    """Family with its probability, and the function that computes its fit on first access."""

    family: str
    probability: float
    compute: Callable[[], Fit]


@answer_foreign_names("An identification", IDENTIFICATION_SYNONYMS)
@dataclass(frozen=True, eq=False)
class IdentificationResult(TableDisplay):
    """Fits of all families, the most probable first, each computed on first access.

    Attributes
    ----------
    lazy_fits
        Families, their probabilities, and functions that compute the fits.
    noise
        Estimated standard deviations of the noise under the most probable family; None if the noise was
        stated.
    reason
        Reason why the best family is not sure although it is probable, see :mod:`.model_check`, else empty.

    See Also
    --------
    kineverse.estimation.identify
    """

    lazy_fits: tuple[LazyFit, ...]
    noise: NoiseDeviations | None = None
    reason: str = ""
    _computed: dict[int, Fit] = field(default_factory=dict, repr=False)

    @property
    def fits(self) -> tuple[Fit, ...]:
        """Fits of all families, the most probable first."""
        return tuple(self._fit(k) for k in range(len(self)))

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each family, the largest first."""
        return {lazy_fit.family: lazy_fit.probability for lazy_fit in self.lazy_fits}

    @property
    def best(self) -> Fit:
        """Fit of the most probable family."""
        return self._fit(0)

    @property
    def misfit(self) -> float:
        """Size of the residuals of the best family relative to the noise, see :attr:`Fit.misfit`."""
        return self.best.misfit

    @property
    def is_ambiguous(self) -> bool:
        """True if no family is probable enough, the data do not determine the best one, or refute it."""
        return not self.best.probability >= SURE or not self.best.is_determined or bool(self.reason)

    def __getitem__(self, family: str) -> Fit:
        tried = [lazy_fit.family for lazy_fit in self.lazy_fits]
        if family not in tried:
            raise UnknownNameError(f"The family {family!r} was not tried. {suggest(family, tried, 'family')}")
        return self._fit(tried.index(family))

    def __iter__(self) -> Iterator[Fit]:
        return iter(self.fits)

    def __len__(self) -> int:
        return len(self.lazy_fits)

    def __str__(self) -> str:
        if not self.is_ambiguous:
            return str(self.best)
        if self.best.probability >= SURE:
            return f"cannot tell: {self.best.family}, but {self.reason or self.best.reason}"
        likely = {name: p for name, p in self.probabilities.items() if p > 1.0 - SURE}
        words = "cannot tell: " + " or ".join(f"{name} ({p:.0%})" for name, p in likely.items())
        return f"{words}, but {self.reason}" if self.reason else words

    def _repr_html_(self) -> str:
        rows = [(name, f"{probability:.2%}") for name, probability in self.probabilities.items()]
        families = html_table(str(self), ("family", "probability"), rows)
        return element("div", families, Html(self.best._repr_html_()))

    @singularity_named()
    def _fit(self, k: int) -> Fit:
        if k not in self._computed:
            self._computed[k] = self.lazy_fits[k].compute()
        return self._computed[k]


_WELL_KNOWN = math.radians(20.0)  # largest standard deviation of a direction that counts as determined [rad]


def build_fit(solution: Solution[FamilyMember], known: Evidence, log: float, probability: float) -> Fit:
    """Return the fit of a family from its solution and evidence."""
    motion, covariance, values, covariances = slide_child_origin(
        solution.motion, known.covariance.copy(), known.joint_values, _joint_covariances(solution, known)
    )
    names = motion.coordinates()
    if "pitch" in names and isinstance(motion, GroupMotion):
        covariance[-1] *= math.tau  # [m/rad] to [m/revolution]
        covariance[:, -1] *= math.tau
    reason = _undetermined_reason(solution, names, covariance)
    return Fit(
        family=motion.name,
        probability=probability,
        log_evidence=log,
        parameters=motion.named_parameters(),
        covariance=covariance,
        coordinates=names,
        frame=motion.left if isinstance(motion, GroupMotion) else np.eye(4),
        joint_values=values,
        deviations=np.sqrt(np.einsum("nii->ni", covariances)),
        residuals=solution.residuals,
        is_determined=not reason,
        reason=reason,
        rows=solution.residuals.shape[1],
        motion=motion,
    )


def _joint_covariances(solution: Solution[FamilyMember], known: Evidence) -> Array:
    """Return the covariances of the joint values (N, k, k), those of the parameters included.

    The zero of a joint along a fixed axis is the mean of its values, so a common change of all is none.
    """
    linear = solution.linear
    weighted = np.swapaxes(linear.by_joints, 1, 2) @ invert_matrices(solution.covariance)
    by_parameters = known.joint_covariances @ weighted @ linear.by_parameters
    if isinstance(solution.motion, GroupMotion) and solution.motion.name not in ("spherical", "free"):
        by_parameters = by_parameters - by_parameters.mean(axis=0)
    return known.joint_covariances + by_parameters @ known.covariance @ np.swapaxes(by_parameters, 1, 2)


def _undetermined_reason(solution: Solution[FamilyMember], names: tuple[str, ...], covariance: Array) -> str:
    """Return the reason why the parameters are not tested or not determined, or an empty string."""
    motion, measured = solution.motion, solution.residuals.size
    unknown = motion.size + solution.values.size
    if isinstance(motion, GroupMotion) and motion.size and motion.joints and unknown >= measured:
        return f"it has {unknown} unknowns for {measured} measured numbers, so it always fits"
    turns = [i for i, name in enumerate(names) if name.startswith("axis.")]
    if turns:
        worst = math.sqrt(float(np.linalg.eigvalsh(covariance[np.ix_(turns, turns)])[-1]))
        if worst > _WELL_KNOWN:
            return f"its axis is known to {math.degrees(worst):.0f}° only"
    return ""


def project_observations(
    motion: MotionModel, values: Array, observations: Observations, expected: Array | None = None
) -> Solution[FixedMotion]:
    """Return the most likely joint values of a fixed motion at observations."""
    poses = motion.linearise(values).pose
    distances = np.sum((observations.relative[:, None] - poses[None])[:, :, :3] ** 2, axis=(2, 3))
    starts = values[np.argmin(distances, axis=1)]
    joint = find_revolving_joint(motion)
    if expected is not None and joint is not None:
        starts[:, joint] += math.tau * np.round((expected - starts[:, joint]) / math.tau)
    return levenberg_marquardt(observations, FixedMotion(motion), starts)


def complete_fit(
    fit: Fit,
    observations: Observations,
    used: npt.NDArray[np.int_],
    outliers: Outliers | None = None,
    stated: bool = True,
    sequential: bool = False,
) -> Fit:
    """Return a fit of some observations, extended to all; outliers among the others are classified."""
    others: npt.NDArray[np.int_] = np.setdiff1d(np.arange(len(observations)), used)
    if not len(others):
        return fit
    expected, joint = None, find_revolving_joint(fit.motion)
    if sequential and joint is not None:
        expected = np.interp(others, used[fit.inliers], fit.joint_values[fit.inliers, joint])
    solution = project_observations(fit.motion, fit.joint_values, observations.select(others), expected)
    by_joints = solution.linear.by_joints
    information = np.swapaxes(by_joints, 1, 2) @ invert_matrices(solution.covariance) @ by_joints
    # An angle without effect on the pose has a standard deviation of half a revolution at most.
    information += math.pi**-2 * np.eye(fit.motion.joints)
    deviations = np.sqrt(np.einsum("nii->ni", invert_matrices(information)))
    rejected = others
    if outliers is not None:
        rejected = others[~classify_inliers(solution.residuals, solution.covariance, outliers, stated)]

    def merge(of_used: Array, of_others: Array) -> Array:
        result = np.empty((len(observations), of_used.shape[1]))
        result[used], result[others] = of_used, of_others
        return result

    return replace(
        fit,
        joint_values=merge(fit.joint_values, solution.values),
        deviations=merge(fit.deviations, deviations),
        residuals=merge(fit.residuals, solution.residuals),
        outliers=tuple(np.union1d(used[list(fit.outliers)], rejected).tolist()),
    )
