"""Unknown sizes of the noise: standard deviations of positions and orientations, integrated out.

Errors are isotropic, and alike for both parts and all observations. Their two standard deviations are
independent and log-normal around :data:`UNKNOWN_NOISE`. Each family has its own most probable ones, at which
its motion is solved. Around them the evidence is integrated over both by Laplace's method, with the motion
kept. So all families have the same prior of the noise, and no family is judged by a noise that suits another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kineverse.estimation.noise import NOISE_SPREAD, UNKNOWN_NOISE
from kineverse.lie import Array, skew

from .least_squares import InitialGuess, Solution
from .marginal_likelihood import Scored
from .motion_functions import FamilyMember
from .observations import Observations
from .result import NoiseDeviations
from .solver import solver

# Median of the size of position noise, in length scales of the data (see .normalisation), where that is more
# than in metres: of cranes, and in millimetres.
_SHARE = 1e-3

# Factors on the medians for further first solutions: ratios of position to orientation noise of 16 and 1/16.
_STARTS = ((4.0, 0.25), (0.25, 4.0))
# Least factor, 5 µm and 0.001°. Without it the likelihood of identical poses has no maximum.
_ROUNDING = 1e-3
_COARSE = NOISE_SPREAD * np.array(
    [-2.0, -1.0, 0.0, 1.0, 2.0]
)  # logarithms of the factors of the first search
_FAR = 0.05  # factor on a median below which a motion is solved again
_BETTER = 0.5  # log density by which another start has to be better
# Largest number of Newton steps, their largest length, and the step of finite differences, in deviations.
_STEPS, _LONGEST, _DIFFERENCE = 12, 1.5, 0.5
# Largest number of solutions at an improved noise, and the improvement at convergence, in deviations.
_SOLUTIONS, _SETTLED = 3, 0.3
# Least and largest curvature over the stencil, relative to that of a Gaussian, at which the step is right.
_FLAT, _SHARP = 0.3, 3.0


def median_factor(unit: float) -> float:
    """Return the factor on the median of position noise for a length scale [m]."""
    return max(1.0, _SHARE * unit / UNKNOWN_NOISE[0])


class NoisePosterior(NamedTuple):
    """Posterior of the sizes of the noise under one family."""

    logs: Array  # logarithms of the most probable factors on the medians, (d,)
    root: Array  # square root R of their covariance R Rᵀ, (d, d)
    log_weight: float  # log ratio of the evidence with the noise integrated out to that at these factors

    @property
    def factors(self) -> Array:
        """Most probable factors on the standard deviations of positions and orientations, (2,)."""
        return np.asarray(_factors(self.logs[None])[0])

    def deviations(self, unit: float) -> NoiseDeviations | None:
        """Return the most probable standard deviations [m], [rad]; None if the noise is stated."""
        if not len(self.logs):
            return None
        medians = np.array([UNKNOWN_NOISE[0] * median_factor(unit), UNKNOWN_NOISE[1]])
        position, orientation = (self.factors * medians).tolist()
        return NoiseDeviations(position, orientation if len(self.logs) == 2 else math.nan)


STATED_NOISE = NoisePosterior(np.zeros(0), np.zeros((0, 0)), 0.0)  # posterior of a noise that is stated


class NoiseSolution(NamedTuple):
    """Solution of a family at the noise that suits it best."""

    scored: Scored  # at this noise
    noise: NoisePosterior

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence with the noise integrated out."""
        return self.scored.log_evidence + self.noise.log_weight


def scale_noise(observations: Observations, factors: Array) -> Observations:
    """Return observations with standard deviations of positions and orientations larger by a factor each."""
    if (np.asarray(factors) == 1.0).all():
        return observations
    each = np.repeat(factors, 3)
    return observations.scaled(np.outer(each, each))


class _NoiseMode(NamedTuple):
    """Maximum of the density of the sizes of the noise: logarithms of the factors, root, log density."""

    logs: Array
    root: Array
    log_density: float


class _NoiseSearch:
    """Posterior density of the sizes of the noise, for a motion that is kept."""

    def __init__(
        self, observations: Observations, solution: Solution[FamilyMember], weight: float = 1.0
    ) -> None:
        self.solution, self.weight = solution, weight
        self.parts = _covariance_parts(observations, solution)
        # Without any orientation there is one size only.
        self.dimensions = 2 if self.parts[1].any() else 1

    def log_evidences(self, logs: Array) -> Array:
        """Return the log evidence at logarithms of the factors, (M, d)."""
        return solver.log_evidences(self.solution, _factors(logs), self.parts, self.weight)

    def log_density(self, logs: Array) -> Array:
        """Return the log evidence and prior at logarithms of the factors, (M, d)."""
        prior = -0.5 * np.sum((logs / NOISE_SPREAD) ** 2, axis=1)
        prior -= self.dimensions * math.log(NOISE_SPREAD * math.sqrt(math.tau))
        return np.asarray(prior + self.log_evidences(logs))

    def maximise_anywhere(self) -> _NoiseMode:
        """Return the maximum, from the best of widely spaced sizes."""
        grid = np.array(list(itertools.product(_COARSE, repeat=self.dimensions)))
        return self.maximise(grid[int(np.argmax(self.log_density(grid)))], np.eye(self.dimensions))

    def maximise(self, logs: Array, root: Array) -> _NoiseMode:
        """Return the maximum near some sizes, by Newton steps with a stencil of the width of the density."""
        stencil = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=self.dimensions)))
        # Terms of a quadratic: 1, x, then x_i x_j for i <= j.
        pairs = list(itertools.combinations_with_replacement(range(self.dimensions), 2))
        products = [stencil[:, i] * stencil[:, j] for i, j in pairs]
        inverse = np.linalg.pinv(np.column_stack([np.ones(len(stencil)), stencil, *products]))
        for _ in range(_STEPS):
            width = _DIFFERENCE * root
            density = self.log_density(logs + stencil @ width.T)
            _, *coefficients = inverse @ density
            slope, curvature = coefficients[: self.dimensions], np.zeros((self.dimensions,) * 2)
            for (i, j), value in zip(pairs, coefficients[self.dimensions :], strict=True):
                curvature[i, j] += value
                curvature[j, i] += value
            bends, axes = np.linalg.eigh(-curvature / _DIFFERENCE**2)
            # The stencil grows by a factor of 2.5 at most along a direction in which the density is convex.
            bends = np.maximum(bends, 0.16)
            step = axes.T @ slope / _DIFFERENCE / bends
            distance = math.sqrt(float(bends @ step**2))
            shift = root @ axes @ step
            shift *= min(1.0, _LONGEST / max(float(np.linalg.norm(shift)), 1e-12))
            best, here = int(np.argmax(density)), float(density[len(density) // 2])
            if distance > 1.0 and self.log_density((logs + shift)[None])[0] < here:
                shift = stencil[best] @ width.T  # the quadratic does not hold so far from here
            # The root is at most twice as wide as the prior in any direction.
            left, widths, right = np.linalg.svd(root @ axes / np.sqrt(bends))
            logs, root = logs + shift, left * np.minimum(widths, 2.0 * NOISE_SPREAD) @ right
            if distance < _SETTLED and bends[0] > _FLAT and bends[-1] < _SHARP:
                break
        return _NoiseMode(logs, root, float(self.log_density(logs[None])[0]))

    def log_weight(self, mode: _NoiseMode) -> float:
        """Return the log ratio of the evidence with the sizes integrated out to that at the maximum."""
        log = float(self.log_evidences(mode.logs[None])[0])
        _, volume = np.linalg.slogdet(mode.root)
        return mode.log_density - log + 0.5 * len(mode.logs) * math.log(math.tau) + float(volume)


def estimate_noise(
    observations: Observations, solution: Solution[FamilyMember], near: NoisePosterior | None = None
) -> NoiseSolution:
    """Return a solution whose motion is kept at the most probable noise."""
    search = _NoiseSearch(observations, solution)
    if near is None:
        return _at_mode(search, search.maximise_anywhere())
    return _at_mode(search, search.maximise(near.logs, near.root))


def solve_unknown_noise(observations: Observations, solve: Callable[[Observations], Scored]) -> NoiseSolution:
    """Return the most likely member of a family, at the noise that suits it best."""
    search = _NoiseSearch(observations, solve(observations).solution)
    mode = search.maximise_anywhere()
    for factors in _STARTS if search.dimensions > 1 else ():
        solution = solve(scale_noise(observations, np.array(factors))).solution
        other = _NoiseSearch(observations, solution)
        if other.log_density(mode.logs[None])[0] > mode.log_density + _BETTER:
            search, mode = other, other.maximise(mode.logs, mode.root)
    factors = _factors(mode.logs[None])[0]
    if factors.min() < _FAR:
        # At so much larger a noise, the priors of levers have moved the motion.
        search = _NoiseSearch(observations, solve(scale_noise(observations, factors)).solution)
        mode = search.maximise(mode.logs, mode.root)
    return _at_mode(search, mode)


def _at_mode(search: _NoiseSearch, mode: _NoiseMode) -> NoiseSolution:
    """Return the solution of a search at its maximum, and Laplace's approximation around it."""
    covariance = np.tensordot(_factors(mode.logs[None])[0] ** 2, search.parts, axes=1)
    log = float(search.log_evidences(mode.logs[None])[0])
    scored = Scored(replace(search.solution, covariance=covariance), log)
    return NoiseSolution(scored, NoisePosterior(mode.logs, mode.root, search.log_weight(mode)))


def adapt_noise(
    observations: Observations,
    near: NoiseSolution,
    proceed: Callable[[Observations, Solution[FamilyMember]], Scored] | None = None,
) -> NoiseSolution:
    """Return the solution at the noise that suits it best, with the joint values integrated out."""
    (solution, _), noise = near
    logs, root, motion = noise.logs, noise.root, solution.motion
    rough = bool(motion.joints and motion.size) and not solution.joint_prior.marginal
    for _ in range(_SOLUTIONS):
        scaled = scale_noise(observations, _factors(logs[None])[0])
        if proceed is not None:
            scored = proceed(scaled, solution)
        elif rough:
            scored, rough = solver.maximise_marginal_likelihood(scaled, solution), False
        else:
            start = InitialGuess(solution.motion, solution.values), solution.parent, solution.joint_prior
            scored = solver.continue_from(scaled, *start)
        solution, used = scored.solution, logs
        search = _NoiseSearch(observations, solution)
        mode = search.maximise(logs, root)
        logs, root = mode.logs, mode.root
        if float(np.linalg.norm(np.linalg.solve(root, logs - used))) < _SETTLED:
            break
    # The solution is that at the sizes used, and the evidence that at the maximum.
    off = float(search.log_evidences(mode.logs[None])[0]) - float(search.log_evidences(used[None])[0])
    return NoiseSolution(scored, NoisePosterior(used, root, search.log_weight(mode) + off))


def weigh_observations(observations: Observations, one: NoiseSolution, weight: float) -> NoiseSolution:
    """Return a solution with the evidence and the noise for a weight of each observation's log likelihood."""
    (solution, reached), noise = one
    if not len(noise.logs):
        predicted, weighted = (solver.evidence(solution, w).log_evidence for w in (1.0, weight))
        return NoiseSolution(Scored(solution, weighted + weight * (reached - predicted)), noise)
    search = _NoiseSearch(observations, solution, weight)
    # Steps that did not converge reach less than the quadratic approximation predicts.
    missing = reached - float(_NoiseSearch(observations, solution).log_evidences(noise.logs[None])[0])
    mode = search.maximise(noise.logs, noise.root / math.sqrt(weight))
    (solution, predicted), noise = _at_mode(search, mode)
    return NoiseSolution(Scored(solution, predicted + weight * missing), noise)


def _factors(logs: Array) -> Array:
    """Return factors on both standard deviations, (M, 2), from logarithms of one or both, (M, d)."""
    factors = np.ones((len(logs), 2))
    factors[:, : logs.shape[1]] = np.hypot(np.exp(logs), _ROUNDING)
    return factors


def _covariance_parts(observations: Observations, solution: Solution[FamilyMember]) -> Array:
    """Return the covariances of the residuals by errors of positions, and of orientations, (2, N, m, m)."""
    rows, count = observations.rows, len(solution.residuals)
    parts = np.zeros((2, count, rows, rows))
    parents = observations.parent_covariance
    both = 1.0 if parents is None else 2.0
    parts[0, :, range(3), range(3)] = both * observations.child_covariance[0, 0, 0]
    turned = observations.child_covariance[0, 3, 3] if rows == 6 else 0.0
    if parents is not None:
        turned = parents[0, 3, 3]
        lever = skew(solution.linear.pose[:, :3, 3])
        parts[1, :, :3, :3] = turned * lever @ np.swapaxes(lever, 1, 2)
        if rows == 6:
            parts[1, :, :3, 3:] = -turned * lever
            parts[1, :, 3:, :3] = turned * lever
    if rows == 6:
        parts[1, :, range(3, 6), range(3, 6)] = both * turned
    return parts
