"""Robust least squares of all residual blocks: Gauss-Newton steps, outliers, and sizes of the noise.

The first steps weigh observations by a Cauchy density whose scale is the median of the residuals, from which
a start far away and a share of gross errors below one half converge. Then the mixture of :class:`.Outliers`
weighs them, and the sizes of the noise are those at which the weighted residuals of each group have the
variance expected with its share of the degrees of freedom (restricted maximum likelihood), with the prior of
unknown noise that identification has. With a majority of gross errors, noise as wide as they are may seem to
fit; its residuals are not normal. Then the scale of the lower quartile is tried too, and the likelier wins.

Parameters are scaled by their prior sizes. In a direction that the data tell less well than its prior size,
steps are zero: so it stays where it was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.estimation.noise import NOISE_SPREAD, Outliers
from kineverse.estimation.tracking.residuals import whitening
from kineverse.lie import Array

from .observations import ResidualBlock

FINEST = 1e-7  # smallest standard deviation of an estimated noise [m], [rad]; below it rounding is larger
_ROUNDING = 1e-14  # relative size of an eigenvalue of JᵀJ that is rounding
_ROUGH, _STEPS, _HALVINGS = 40, 60, 8  # largest numbers of steps before and with the mixture, of halvings
_SETTLED = 1e-8  # squared length of a step at convergence, in standard deviations
_NEAR = 1e-2  # the same of the last step before the mixture
_EVEN = 1e-3  # relative change of the sizes of noise at convergence


class Quantile(NamedTuple):
    """Share of the residuals that sets the scale of a robust step, with its normal deviate."""

    share: float
    deviate: float


_MEDIAN, _QUARTILE = Quantile(0.5, 0.0), Quantile(0.25, -0.67449)
_PEAKED = 3.0  # standard deviations of a kurtosis above which another solution is looked for


class Linearised(NamedTuple):
    """Residuals (N, m) and Jacobians (N, m, p) of a block, in scaled parameters."""

    residual: Array
    jacobian: Array


@dataclass
class Weighted:
    """Normal equations H x = g of weighted residuals, with the parts that each group contributes to H."""

    hessian: Array
    gradient: Array
    parts: dict[str, Array]


@dataclass
class CalibrationFit:
    """Fitted parameters, in units of their prior sizes."""

    values: Array  # (p,)
    noise: dict[str, float]  # standard deviation of each group; 1 for a stated one
    weights: list[Array]  # inlier probability of each observation, by block
    linear: list[Linearised]  # at the values
    hessian: Array
    rank: int


class CalibrationProblem:
    """Blocks of residuals as a function of all scaled parameters."""

    def __init__(
        self,
        blocks: Sequence[ResidualBlock],
        columns: Sequence[Sequence[int]],  # of each block's parameters
        scales: Array,  # prior sizes, (p,)
        stated: Mapping[str, float],  # sizes of the noise that are known, by group
        outliers: Outliers | None,
    ) -> None:
        self.blocks, self.scales, self.outliers = list(blocks), scales, outliers
        self.columns = [np.asarray(c, dtype=int) for c in columns]
        self.whiten = [None if b.covariance is None else whitening(b.covariance) for b in blocks]
        self.log_volumes = [
            0.0 if w is None else -np.linalg.slogdet(w)[1] for w in self.whiten
        ]  # ½ log |S| of stated covariances
        self.log_outlier = [0.0 if outliers is None else b.log_outlier_density(outliers) for b in blocks]
        sized = [block for block, w in zip(blocks, self.whiten, strict=True) if w is None]
        groups = [group for block in sized for group in block.groups]
        self.known = {group.name: stated[group.name] for group in groups if group.name in stated}
        self.unknown = sorted({group.name for group in groups} - self.known.keys())
        self.medians = {group.name: group.median for group in groups if group.median is not None}

    def linearise(self, values: Array) -> list[Linearised]:
        """Return residuals and Jacobians of all blocks at scaled values."""
        full = values * self.scales
        result = []
        for block, columns, whiten in zip(self.blocks, self.columns, self.whiten, strict=True):
            residual, jacobian = block.evaluate(full[columns])
            if whiten is not None:
                residual = (whiten @ residual[..., None])[..., 0]
                jacobian = whiten @ jacobian
            result.append(Linearised(residual, jacobian * self.scales[columns]))
        return result

    def deviations(self, index: int, noise: Mapping[str, float]) -> Array:
        """Return the standard deviation of each row of a block's residuals, (m,)."""
        block = self.blocks[index]
        if self.whiten[index] is not None:
            return np.ones(1)
        return np.concatenate([np.full(g.rows.stop - g.rows.start, noise[g.name]) for g in block.groups])

    def squares(self, linear: Sequence[Linearised], noise: Mapping[str, float]) -> list[Array]:
        """Return the squared norms of the whitened residuals, (N,) by block."""
        return [
            np.square(one.residual / self.deviations(i, noise)).sum(axis=1) for i, one in enumerate(linear)
        ]

    def normal_equations(
        self, linear: Sequence[Linearised], weights: Sequence[Array], noise: Mapping[str, float]
    ) -> Weighted:
        """Return the normal equations of a step."""
        count = len(self.scales)
        hessian, gradient = np.zeros((count, count)), np.zeros(count)
        parts: dict[str, Array] = {}
        for i, one in enumerate(linear):
            roots = np.sqrt(weights[i])[:, None] / self.deviations(i, noise)
            residual, jacobian = one.residual * roots, one.jacobian * roots[..., None]
            place = np.ix_(self.columns[i], self.columns[i])
            for group in self.blocks[i].groups:
                rows = jacobian[:, group.rows].reshape(-1, jacobian.shape[2])
                part = rows.T @ rows
                hessian[place] += part
                whole = parts.setdefault(group.name, np.zeros((count, count)))
                whole[place] += part
                gradient[self.columns[i]] -= rows.T @ residual[:, group.rows].ravel()
        return Weighted(hessian, gradient, parts)

    # -- weights and sizes of the noise ------------------------------------------------------------------

    def mixture(self, linear: Sequence[Linearised], noise: Mapping[str, float]) -> tuple[list[Array], float]:
        """Return the inlier probabilities of all observations, and the cost: the negative log likelihood."""
        weights, cost = [], 0.0
        for i, square in enumerate(self.squares(linear, noise)):
            size = linear[i].residual.shape[1]
            log_scale = size / 2 * math.log(math.tau) + self.log_volumes[i]
            if self.whiten[i] is None:
                log_scale = log_scale + float(np.log(self.deviations(i, noise)).sum())
            if self.outliers is None:
                weights.append(np.ones(len(square)))
                cost += float((square / 2 + log_scale).sum())
                continue
            inlier = math.log1p(-self.outliers.fraction) - square / 2
            total = np.logaddexp(inlier, math.log(self.outliers.fraction) + self.log_outlier[i] + log_scale)
            weights.append(np.exp(inlier - total))
            cost += float((log_scale - total).sum())
        return weights, cost

    def robust_noise(self, linear: Sequence[Linearised], quantile: Quantile) -> dict[str, float]:
        """Return sizes of the noise by a quantile of the residuals of each group; at least the known ones."""
        norms: dict[str, list[Array]] = {}
        for i, one in enumerate(linear):
            if self.whiten[i] is None:
                for group in self.blocks[i].groups:
                    part = one.residual[:, group.rows]
                    squares = np.square(part).sum(axis=1) / _chi_square(part.shape[1], quantile.deviate)
                    norms.setdefault(group.name, []).append(squares)
        result = {}
        for name, parts in norms.items():
            size = math.sqrt(float(np.quantile(np.concatenate(parts), quantile.share)))
            result[name] = max(size, self.known.get(name, FINEST))
        return result

    def estimate_noise(
        self,
        linear: Sequence[Linearised],
        weights: Sequence[Array],
        noise: Mapping[str, float],
        freedom: dict[str, float],
    ) -> dict[str, float]:
        """Return the sizes of the noise at which weighted residuals have the expected squares.

        ``freedom`` are the degrees of freedom that the parameters take from each group.
        """
        result, freedom = {**noise}, {name: -freedom[name] for name in self.unknown}
        squares = dict.fromkeys(self.unknown, 0.0)
        for i, one in enumerate(linear):
            if self.whiten[i] is None:
                for group in self.blocks[i].groups:
                    if group.name in squares:
                        part = one.residual[:, group.rows]
                        squares[group.name] += float(weights[i] @ np.square(part).sum(axis=1))
                        freedom[group.name] += part.shape[1] * float(weights[i].sum())
        for name in squares:
            size = _likely_size(squares[name], max(freedom[name], 0.0), self.medians.get(name))
            result[name] = max(size, FINEST)
        return result

    # -- solutions ---------------------------------------------------------------------------------------

    def solve(self, starts: Sequence[Array], present: Array) -> CalibrationFit:
        """Return the most likely parameters from starts; those that nothing tells are the present ones."""
        fit = self._solve(self._nearest_start(starts), present, _MEDIAN)
        if self.outliers and self._is_peaked(fit):
            # Noise as wide as a majority of gross errors would pass for what fits.
            with suppress(NoSolutionError):
                other = self._solve(fit.values, present, _QUARTILE)
                fit = min(fit, other, key=lambda one: self.mixture(one.linear, one.noise)[1])
        return fit

    def _is_peaked(self, fit: CalibrationFit) -> bool:
        """Return True for inliers that are not normal: more are near and far (Mardia's kurtosis, 1970)."""
        excess = variance = 0.0
        for square, weights, one in zip(
            self.squares(fit.linear, fit.noise), fit.weights, fit.linear, strict=True
        ):
            rows = one.residual.shape[1]
            excess += float(weights @ (square**2 - rows * (rows + 2)))
            variance += 8 * rows * (rows + 2) * float(weights.sum())
        return excess > _PEAKED * math.sqrt(variance)

    def _solve(self, start: Array, present: Array, quantile: Quantile) -> CalibrationFit:
        """Return the most likely parameters near a start, first at the scale of a quantile of residuals."""
        values, linear = self._approach(start, quantile)
        # From above, so that no observation of few is lost at once.
        sizes = self.robust_noise(linear, quantile)
        noise = {name: max(size, self.medians.get(name, 0.0)) for name, size in sizes.items()} | self.known
        weights, cost = self.mixture(linear, noise)
        for _ in range(_STEPS):
            equations = self.normal_equations(linear, weights, noise)
            covariance, _ = pseudo_inverse(equations.hessian)
            step = covariance @ equations.gradient
            values, linear, _ = self._descend(values, linear, step, noise, cost)
            freedom = {name: float(np.sum(covariance * part)) for name, part in equations.parts.items()}
            before, noise = noise, self.estimate_noise(linear, weights, noise, freedom)
            weights, cost = self.mixture(linear, noise)
            change = max((abs(noise[n] / before[n] - 1.0) for n in self.unknown), default=0.0)
            if float(step @ equations.hessian @ step) < _SETTLED and change < _EVEN:
                break
        else:
            raise NoSolutionError(
                f"The calibration has not converged after {_STEPS} steps: the looks contradict each other. "
                "Check the names of joints and frames, the units, and that states and observations belong "
                "together."
            )
        values, linear = self._hold_untold(values, linear, weights, noise, present)
        hessian = self.normal_equations(linear, weights, noise).hessian
        return CalibrationFit(values, noise, weights, linear, hessian, pseudo_inverse(hessian)[1])

    def _nearest_start(self, starts: Sequence[Array]) -> Array:
        """Return the best start, with the values that blocks propose where these fit better."""
        best = min(starts, key=self._misfit)
        for block, columns in zip(self.blocks, self.columns, strict=True):
            if block.start is not None:
                proposed = best.copy()
                proposed[columns] = block.start / self.scales[columns]
                best = min(best, proposed, key=self._misfit)
        return best

    def _misfit(self, values: Array) -> float:
        """Return a measure of the median residuals, free of units up to a constant."""
        linear = self.linearise(values)
        noise = self.robust_noise(linear, _MEDIAN)
        total = sum(map(math.log, noise.values()))
        for whiten, square in zip(self.whiten, self.squares(linear, noise), strict=True):
            if whiten is not None:
                total += 0.5 * math.log(max(float(np.median(square)), FINEST**2))
        return total

    def refit(self, fit: CalibrationFit, keep: Sequence[Array]) -> Array:
        """Return the parameters from some of the observations, at the weights and the noise of a fit."""
        weights = [w * k for w, k in zip(fit.weights, keep, strict=True)]
        values, linear = fit.values, fit.linear
        for _ in range(_HALVINGS):
            equations = self.normal_equations(linear, weights, fit.noise)
            step, _ = gauss_newton_step(equations)
            values = values + step
            linear = self.linearise(values)
            if float(step @ equations.hessian @ step) < _NEAR:
                break
        return values

    def _hold_untold(
        self,
        values: Array,
        linear: list[Linearised],
        weights: Sequence[Array],
        noise: Mapping[str, float],
        present: Array,
    ) -> tuple[Array, list[Linearised]]:
        """Return values that explain the data alike, without correction in untold directions."""
        for _ in range(_HALVINGS):
            equations = self.normal_equations(linear, weights, noise)
            step, told = gauss_newton_step(equations)
            untold = values - present - told @ (told.T @ (values - present))
            # Where a direction is curved, a step of the others follows.
            if told.shape[1] == len(values) or np.abs([untold, step]).max() < FINEST:
                break
            values = values + step - untold
            linear = self.linearise(values)
        return values, linear

    def _approach(self, values: Array, quantile: Quantile) -> tuple[Array, list[Linearised]]:
        """Go near the solution by Cauchy weights at the scale of a quantile."""
        linear = self.linearise(values)
        for _ in range(_ROUGH):
            noise = self.robust_noise(linear, quantile)
            weights = []
            for i, square in enumerate(self.squares(linear, noise)):
                size = linear[i].residual.shape[1]
                if self.whiten[i] is not None:
                    scale = float(np.quantile(square, quantile.share)) / _chi_square(size, quantile.deviate)
                    square = square / max(scale, 1.0)
                weights.append((1 + size) / (1 + square) if self.outliers else np.ones(len(square)))
            equations = self.normal_equations(linear, weights, noise)
            step, _ = gauss_newton_step(equations)
            cost = self._rough_cost(linear, noise)
            values, linear, length = self._descend(values, linear, step, noise, cost, rough=True)
            if float(step @ equations.hessian @ step) * length**2 < _NEAR:
                break
        return values, linear

    def _rough_cost(self, linear: Sequence[Linearised], noise: Mapping[str, float]) -> float:
        total = 0.0
        for i, square in enumerate(self.squares(linear, noise)):
            size = linear[i].residual.shape[1]
            total += float((np.log1p(square) * (1 + size) if self.outliers else square).sum()) / 2
        return total

    def _descend(
        self,
        values: Array,
        linear: list[Linearised],
        step: Array,
        noise: Mapping[str, float],
        cost: float,
        rough: bool = False,
    ) -> tuple[Array, list[Linearised], float]:
        """Take a step, at most of the prior size, and halve it until the cost is lower."""
        length = min(1.0, 1.0 / max(float(np.abs(step).max(initial=0.0)), 1e-300))
        for _ in range(_HALVINGS):
            there = self.linearise(values + length * step)
            finite = all(np.isfinite(one.residual).all() for one in there)
            reached = self._rough_cost(there, noise) if rough else self.mixture(there, noise)[1]
            if finite and reached <= cost + 1e-9 * abs(cost) + 1e-9:
                return values + length * step, there, length
            length /= 2
        return values, linear, 0.0


def gauss_newton_step(equations: Weighted) -> tuple[Array, Array]:
    """Return the step in the directions that the data tell, and these directions (p, r)."""
    values, axes = told_directions(equations.hessian)
    return axes @ (axes.T @ equations.gradient / values), axes


def pseudo_inverse(hessian: Array) -> tuple[Array, int]:
    """Return the inverse of H in the directions that the data tell, and their number."""
    values, axes = told_directions(hessian)
    return (axes / values) @ axes.T, len(values)


def told_directions(hessian: Array) -> tuple[Array, Array]:
    """Return eigenvalues (r,) and eigenvectors (p, r) of H in directions told better than the prior size."""
    values, axes = np.linalg.eigh(hessian)
    told = values > max(1.0, _ROUNDING * len(values) * float(values[-1]))
    return values[told], axes[:, told]


def _likely_size(square: float, freedom: float, median: float | None) -> float:
    """Return the most likely size of noise for a sum of squares with some degrees of freedom.

    Its prior is log-normal around the median. Without it, the size of a group that the parameters can fit
    exactly, as with few looks, would be zero.
    """
    if median is None:
        return math.sqrt(square / max(freedom, 1.0))
    variance, log = NOISE_SPREAD**2, math.log(median)
    for _ in range(_STEPS):
        # Maximum of -ν log σ - S/(2σ²) - (log σ - log median)²/(2 s²) over log σ, which is concave.
        pull = square * math.exp(-2.0 * log)
        step = (pull - freedom - (log - math.log(median)) / variance) / (2.0 * pull + 1.0 / variance)
        log += max(-1.0, min(step, 1.0))
        if abs(step) < _EVEN:
            break
    return math.exp(log)


def _chi_square(size: int, deviate: float) -> float:
    """Return a quantile of χ² with some degrees of freedom, by that of a normal (Wilson and Hilferty)."""
    return size * (1 - 2 / (9 * size) + deviate * math.sqrt(2 / (9 * size))) ** 3


def check_residuals(linear: Sequence[Linearised], blocks: Sequence[ResidualBlock]) -> None:
    """Refuse residuals that are not finite at the present model."""
    for one, block in zip(linear, blocks, strict=True):
        wrong = np.flatnonzero(~np.isfinite(one.residual).all(axis=1))
        if len(wrong):
            raise InvalidValueError(
                f"'{block.label}' has no finite prediction in look {block.looks[wrong[0]]} by the present "
                "model. A point on the image plane of a camera has no pixel."
            )


_CONFUSED = (
    "Check the names of joints and frames, that lengths are in metres and angles in radians, and that states "
    "and observations belong together."
)
_CERTAIN = math.log(20.0)  # log odds against a wrong refusal
_LOG_ANY_ORIENTATION = -Outliers(reach=1.0).log_uniform_density  # log volume of all orientations [rad³]


def check_explained(problem: CalibrationProblem, fit: CalibrationFit, sizes: str) -> None:
    """Refuse recordings that the model does not explain, even with its best parameters.

    Three other explanations compete: that all observations are gross errors, that all orientations are, and
    that the observations of each kind are a constant and noise. The criterion is the Bayesian one, with the
    correction for few data where the size of the noise is estimated (McQuarrie, 1999). ``sizes`` are those
    of the noise, in words.
    """
    count, inliers = sum(map(len, fit.weights)), sum(float(w.sum()) for w in fit.weights)
    if inliers < count / 2:
        raise InvalidValueError(
            f"The recordings do not fit the model: only {inliers:.0f} of {count} observations agree with it"
            f"{f' to {sizes}' if sizes else ''}, and more than half have to. {_CONFUSED}"
        )
    outliers = problem.outliers or Outliers()
    over_errors, over_constant = -problem.mixture(fit.linear, fit.noise)[1], 0.0
    numbers, constants = 0.0, 0
    turns, over_turns = 0.0, 0.0  # orientations, and their log likelihood ratio to any orientation
    for i, (block, weights) in enumerate(zip(problem.blocks, fit.weights, strict=True)):
        residual, constant = fit.linear[i].residual, block.scatter()
        rows = residual.shape[1]
        numbers += rows * float(weights.sum())
        over_errors -= len(weights) * block.log_outlier_density(outliers)
        deviations = problem.deviations(i, fit.noise) * np.ones(rows)
        for group in block.groups:
            part, used = group.rows, float(weights.sum())
            if group.name == "orientation" and problem.whiten[i] is None:
                square = float(weights @ np.square(residual[:, part] / deviations[part]).sum(axis=1))
                log_scale = 1.5 * math.log(math.tau) + float(np.log(deviations[part]).sum())
                turns += 3 * used
                over_turns += used * (_LOG_ANY_ORIENTATION - log_scale) - square / 2
        if constant is None or problem.whiten[i] is not None:
            over_constant = math.inf
            continue
        constants += rows
        for group in block.groups:
            mine, other = (
                float(weights @ np.square(one[:, group.rows]).sum(axis=1)) for one in (residual, constant)
            )
            width = residual[:, group.rows].shape[1] * float(weights.sum())
            least = width * FINEST**2
            over_constant += width / 2 * math.log(max(other, least) / max(mine, least))

    def penalty(parameters: int) -> float:
        few = numbers / max(numbers - parameters - 2.0, 1.0) if problem.unknown else 1.0
        return parameters / 2 * math.log(max(numbers, 2.0)) * few

    share = turns / max(numbers, 1.0)
    if over_errors < penalty(fit.rank) or (turns and over_turns < share * penalty(fit.rank)):
        raise InvalidValueError(
            "The recordings do not fit the model: the best parameters explain them no better than gross "
            f"errors do{f', with noise of {sizes}' if sizes else ''}. {_CONFUSED} With few looks, noise= or "
            "more of them help."
        )
    if over_constant + _CERTAIN < penalty(fit.rank) - penalty(constants):
        raise InvalidValueError(
            f"The recordings do not fit the model: with its best parameters it is off by {sizes}, and a "
            f"constant for each observed frame explains them as well. Or the joints hardly move. {_CONFUSED}"
        )
