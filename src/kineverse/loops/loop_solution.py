"""Implicit function of one solution branch of a loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.expressions.expression import Expression
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .branch_guess import BranchGuess, BranchSamples, InputDomain, format_point, list_products, regularity
from .branches import continue_solution, find_branches, find_nearest_closed
from .equations import CLOSURE_TOLERANCE, Equations, WorkBudget, find_periodic

RANK = 1e-7  # singular value relative to the largest one, below which a direction counts as free
_SMALL = 1e-3  # smallest length of bars [m] with derivatives above rounding errors

_DEGREES = (2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 32)
_MORE_STEPS = 4
_STEPS = (1, 2, 3, 4, 5, 6, 8, 10)
_FEW = 16  # number of samples that a guess is tried at first
_PARTS = (1.0, 0.6, 0.3, 0.1, 0.03)  # fractions of the margin to try, largest first

_BEFORE_MEETING, _BEFORE_ENDING = 0.9, 1 - 1e-4
"""Usable fraction of the path through the margin, up to a singularity or the end of an earlier loop."""


@dataclass(frozen=True)
class SolvedLoop:
    """Solved loop.

    Attributes
    ----------
    function
        Dependent coordinates as a function of the inputs.
    mobility
        Number of free coordinates in generic configurations.
    branches, branch
        Number of solutions at home, and number of the chosen one, 0 for the nearest to ``home``.
    condition
        Minimum over the samples of the smallest singular value of ∂r/∂x over the largest one; 0 is singular.
    worst
        Free coordinates at that minimum.

    See Also
    --------
    kineverse.loops.solve_loop
    """

    function: ImplicitFunction
    free: tuple[Symbol, ...]
    dependent: tuple[Symbol, ...]
    mobility: int
    branches: int
    branch: int
    condition: float
    worst: tuple[float, ...]


def solve_loop(
    name: str,
    residual: Expression,
    coordinates: Sequence[Symbol],
    home: Mapping[Symbol, float],
    limits: Mapping[Symbol, tuple[float, float]],
    *,
    dependent: Sequence[Symbol] | None = None,
    branch: int = 0,
    upright: Expression | None = None,
) -> SolvedLoop:
    """Solve a loop for its dependent coordinates.

    Parameters
    ----------
    residual
        Residual, shape (m,), zero if the loop is closed [m], [rad].
    coordinates
        Coordinates of the residual; earlier ones are preferred as free coordinates.
    home
        Configuration near a closed one, and values of the parameters.
    limits
        Limits by coordinate. Free coordinates without limits must be angles.
    dependent
        Dependent coordinates; None to choose them.
    branch
        Number of the solution at home, 0 for the nearest to ``home``.
    upright
        Expressions that are positive in a valid solution, because the sine of an angle is zero at half a
        revolution as well.

    Raises
    ------
    NoSolutionError
        If the loop does not close at home or everywhere within the limits, the branch does not exist, or the
        analysis takes too much work.
    InvalidValueError
        If the choice of coordinates does not fit the mobility, or limits are missing.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> loop = kv.loops.solve_loop(
    ...     "rod",
    ...     residual=kv.array([x**2 + y**2 - 1]),
    ...     coordinates=[x, y],
    ...     home={x: 0.0, y: 1.0},
    ...     limits={x: (-0.5, 0.5), y: (0.0, 1.0)},
    ... )
    >>> loop.free, loop.dependent, loop.mobility
    ((x,), (y,), 1)
    """
    parameters = tuple(s for s in residual.symbols if not s.has_derivative)
    values = np.array([home[s] for s in coordinates])
    given = np.array([home[s] for s in parameters])
    effort = WorkBudget(name)
    unknown = Equations(residual, coordinates, parameters, effort)
    if not np.isfinite(unknown(values, given)[0]).all():
        at = format_point(coordinates, values)
        raise NoSolutionError(f"Loop '{name}' is not defined at {at}. Begin elsewhere, with home={{...}}.")
    start, gap = find_nearest_closed(unknown, values, given)
    if gap > CLOSURE_TOLERANCE:
        raise NoSolutionError(f"Loop '{name}' does not close: at best {gap:.6g} is left between its ends.")
    rank = _rank(unknown, start, given)
    if not rank:
        raise InvalidValueError(f"Loop '{name}' is closed whatever its coordinates are.")
    followers = _choose_dependent(name, unknown, start, given, rank, dependent)
    free = tuple(s for s in coordinates if s not in followers)
    inputs = (*free, *parameters)
    equations = Equations(residual, followers, inputs, effort)

    u = np.array([home[s] for s in inputs])
    x = np.array([home[s] for s in followers])
    angles, goes_round = find_periodic(equations, x, u)
    spans = np.array([max(map(abs, limits.get(s, (np.pi,)))) for s in followers])
    reach = np.where(angles, np.pi, np.where(np.isfinite(spans), spans, np.pi) + 1.0)
    stands = None if upright is None else compile(upright, [*followers, *inputs], tier="interpreter")
    result, gap = find_branches(equations, x, u, angles, reach, stands)
    where = format_point(free, u[: len(free)]) or "all configurations"
    if not result:
        raise NoSolutionError(
            f"Loop '{name}' does not close at {where}: {gap:.6g} is left between its ends. "
            "Begin where it does, with home={...}."
        )
    if not 0 <= branch < len(result):
        told = f"{len(result)} branches at {where}, numbered from 0, and none is {branch}"
        raise NoSolutionError(f"Loop '{name}' has {told}.")
    pairs = zip(free, goes_round, strict=False)
    intervals = [_interval(name, s, limits.get(s), bool(turns)) for s, turns in pairs]
    sampled, seed, steps, rows = _fit_guess(name, equations, intervals, result[branch], u, angles)
    if parameters:
        # The guess is fitted for one value of the parameters only, so others need more steps.
        steps += _MORE_STEPS
    domain = (*map(_domain, seed.intervals), *((-np.inf, np.inf) for _ in parameters))
    function = ImplicitFunction(name, followers, inputs, residual, rows, seed.expression(free), steps, domain)
    return SolvedLoop(
        function, free, followers, len(coordinates) - rank, len(result), branch,
        sampled.condition, tuple(sampled.worst.tolist()),
    )  # fmt: skip


def _rank(equations: Equations, x: Array, inputs: Array) -> int:
    """Return the generic rank of ∂r/∂q: the largest near a closed configuration, which may be singular."""
    generator = np.random.default_rng(0)
    most = 0
    for scale in (0.0, 0.0, 1e-3, 1e-2, 0.05, 0.1, 0.2):
        near, gap = equations.close(x + scale * generator.uniform(-1, 1, len(x)), inputs, 60)
        if gap < CLOSURE_TOLERANCE:
            values = np.linalg.svd(equations(near, inputs)[1], compute_uv=False)
            most = max(most, int((values > RANK * max(values.max(initial=0.0), _SMALL)).sum()))
    return most


def _choose_dependent(
    name: str, equations: Equations, x: Array, inputs: Array, rank: int, dependent: Sequence[Symbol] | None
) -> tuple[Symbol, ...]:
    """Choose the dependent coordinates: the wanted ones, or the last possible ones."""
    by_q = equations(x, inputs)[1]
    coordinates = equations.unknowns
    if dependent is not None:
        strange = [str(s) for s in dependent if s not in coordinates]
        if strange:
            known = ", ".join(map(str, coordinates))
            raise InvalidValueError(f"Loop '{name}' is about {known}, not about {', '.join(strange)}.")
        if len(set(dependent)) != rank:
            raise InvalidValueError(
                f"Loop '{name}' makes {rank} of {len(coordinates)} coordinates follow the others "
                f"(its mobility is {len(coordinates) - rank}), and {len(set(dependent))} are given."
            )
        return tuple(s for s in coordinates if s in set(dependent))
    chosen: list[int] = []
    largest = float(np.linalg.norm(by_q, 2))
    # First with a well-conditioned ∂r/∂x, then, if there is none, any that is not singular.
    for enough in (0.02, RANK):
        for i in reversed(range(len(coordinates))):
            if i in chosen or len(chosen) == rank:
                continue
            values = np.linalg.svd(by_q[:, [*chosen, i]], compute_uv=False)
            if values[-1] > enough * largest:
                chosen.append(i)
    if len(chosen) < rank:
        raise InvalidValueError(
            f"Loop '{name}' is singular where it begins. Begin elsewhere, with home={{...}}, or say which "
            "coordinates are dependent."
        )
    return tuple(coordinates[i] for i in sorted(chosen))


def _interval(name: str, symbol: Symbol, limits: tuple[float, float] | None, angle: bool) -> InputDomain:
    lower, upper = limits if limits is not None else (-np.inf, np.inf)
    if angle and not upper - lower < 2 * np.pi:
        return InputDomain(-np.pi, np.pi, whole=True)
    if not (np.isfinite(lower) and np.isfinite(upper)):
        hint = "give the joint limits, or the loop within={...}"
        raise InvalidValueError(f"Loop '{name}' needs limits of '{symbol}': {hint}.")
    return InputDomain(float(lower), float(upper))


def _domain(interval: InputDomain) -> tuple[float, float]:
    if interval.whole:
        return -np.inf, np.inf
    slack = 1e-9 * max(1.0, interval.upper - interval.lower)
    return interval.lower - slack, interval.upper + slack


def _fit_guess(
    name: str,
    equations: Equations,
    limits: Sequence[InputDomain],
    x: Array,
    u: Array,
    angles: npt.NDArray[np.bool_],
) -> tuple[BranchSamples, BranchGuess, int, tuple[int, ...]]:
    """Return the samples of the branch, and the guess with its number of steps and its rows.

    The domain is the limits and as much of the margin as the branch extends to.
    """

    def fitted(intervals: Sequence[InputDomain]) -> tuple[BranchSamples, BranchGuess, int, tuple[int, ...]]:
        samples = BranchSamples(name, equations, limits, intervals, x, u, angles)
        return samples, *_choose_guess(name, samples)

    if all(i.whole for i in limits):
        return fitted(limits)
    reaches = _margin_fractions(equations, limits, x, u)
    alone: tuple[BranchSamples, BranchGuess, int, tuple[int, ...]] | None = None
    for part in _PARTS:
        wider = [i.widen(part * r[0], part * r[1]) for i, r in zip(limits, reaches, strict=True)]
        try:
            return fitted(wider)
        except NoSolutionError:
            # If the loop does not close within the limits, smaller margins do not help.
            alone = alone or fitted(limits)
    assert alone is not None
    return alone


def _margin_fractions(
    equations: Equations, limits: Sequence[InputDomain], x: Array, u: Array
) -> list[tuple[float, float]]:
    """Return the fractions of the margin below and above each limit that the branch extends to.

    The other inputs are at home.
    """
    home = u.copy()
    home[: len(limits)] = [min(max(v, i.lower), i.upper) for v, i in zip(u, limits, strict=False)]
    x = continue_solution(equations, x, u, home).solution
    reaches = []
    for k, (limit, wide) in enumerate(zip(limits, [i.widen() for i in limits], strict=True)):
        parts = []
        for edge, end in ((limit.lower, wide.lower), (limit.upper, wide.upper)):
            there, beyond = home.copy(), home.copy()
            there[k], beyond[k] = edge, end
            at_edge = continue_solution(equations, x, home, there).solution
            reached = continue_solution(equations, at_edge, there, beyond)
            part = reached.part
            if part < 1.0:
                # Branches meet at a dead centre; an earlier loop may end without one.
                stop = there + part * (beyond - there)
                left, before = (
                    regularity(equations, *p) for p in ((reached.solution, stop), (at_edge, there))
                )
                part *= _BEFORE_MEETING if left < 0.5 * before else _BEFORE_ENDING
            parts.append(part)
        reaches.append((parts[0], parts[1]))
    return reaches


def _choose_guess(name: str, samples: BranchSamples) -> tuple[BranchGuess, int, tuple[int, ...]]:
    """Return the cheapest guess and number of steps that converge at all samples, and the rows used."""
    rows = _rows(samples)
    n = len(samples.equations.unknowns)
    if samples.changes_sign(rows):
        raise _too_close(name, samples)
    best: tuple[float, BranchGuess, int] | None = None
    count = len(samples.inputs)
    for degree in _DEGREES:
        if len(list_products(samples.intervals, degree)) > count:
            break
        seed = BranchGuess.fit(samples.intervals, degree, samples.inputs, samples.solutions, samples.winding)
        step_cost = 20 * n + n**3
        # More steps than these cost more than the best guess so far.
        most = _STEPS[-1] if best is None else (best[0] - seed.terms) / step_cost
        steps = _steps(samples, seed, rows, most)
        if steps is None:
            continue
        cost = seed.terms + steps * step_cost
        if best is None or cost < best[0]:
            best = cost, seed, steps
    if best is None:
        raise _too_close(name, samples)
    return best[1], best[2], rows


def _too_close(name: str, samples: BranchSamples) -> NoSolutionError:
    at = format_point(samples.equations.inputs, samples.worst)
    return NoSolutionError(
        f"Loop '{name}' is singular, or too close to it, near {at} (condition {samples.condition:.2g}) for "
        "Newton's method to be sure of its branch. Narrow the limits, or the loop's within={...}."
    )


def _rows(samples: BranchSamples) -> tuple[int, ...]:
    """Return as many rows as unknowns, the best-conditioned ones at the worst sample."""
    equations = samples.equations
    n = len(equations.unknowns)
    every = max(1, len(samples.inputs) // 40)
    points = zip(samples.inputs[::every], samples.solutions[::every], strict=True)
    matrices = [equations(x, samples.all_inputs(q))[1] for q, x in points]
    m = matrices[0].shape[0]
    if m == n:
        return tuple(range(n))
    best, chosen = -1.0, tuple(range(n))
    for rows in itertools.islice(itertools.combinations(range(m), n), 5000):
        worst = min(np.linalg.svd(matrix[list(rows)], compute_uv=False)[-1] for matrix in matrices)
        if worst > best * 1.01:
            best, chosen = worst, rows
    return chosen


def _steps(samples: BranchSamples, seed: BranchGuess, rows: tuple[int, ...], most: float) -> int | None:
    """Return the number of Newton steps that suffices at all samples; None if it is larger than ``most``."""
    needed = 0
    # The corners come first: most guesses that fail do so there.
    for part in (slice(_FEW), slice(_FEW, None)):
        steps = _steps_of(samples, seed, rows, most, part)
        if steps is None:
            return None
        needed = max(needed, steps)
    return next(s for s in _STEPS if s >= needed)


def _steps_of(
    samples: BranchSamples, seed: BranchGuess, rows: tuple[int, ...], most: float, part: slice
) -> int | None:
    tried, wanted, chosen = samples.tried[part], samples.wanted[part], list(rows)
    x, u = seed.evaluate(tried), samples.all_inputs(tried)
    for step in range(math.floor(most) + 1):
        residual, by_x = samples.equations.evaluate_all(x, u)
        near = np.abs(x - wanted).max(axis=1, initial=0.0) < 1e-5
        left = ~(near & (np.linalg.norm(residual, axis=1) < 1e-12))
        if not left.any():
            return step
        x, u, wanted = x[left], u[left], wanted[left]
        try:
            x -= np.linalg.solve(by_x[left][:, chosen], residual[left][:, chosen, None])[..., 0]
        except np.linalg.LinAlgError:
            return None
    return None
