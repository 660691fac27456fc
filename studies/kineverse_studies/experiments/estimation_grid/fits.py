"""Fits of the estimation grid, sequential or on all cores."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import Future
from itertools import product

import numpy as np

from kineverse.errors import KineverseError
from kineverse.estimation import identify, pose_covariance
from kineverse.estimation.identification.result import Fit
from kineverse.lie import Array
from kineverse_studies.experiments.estimation_grid.cramer_rao import (
    Bound,
    compute_attainable_bound,
    compute_bound,
)
from kineverse_studies.experiments.estimation_grid.results import CellResult
from kineverse_studies.experiments.estimation_grid.samples import Cell, Joint, JointSamples, draw_samples
from kineverse_studies.experiments.registry import Progress
from kineverse_studies.experiments.worker_pool import worker_pool

SEED = 2011
SAMPLES = 50

POSITIONS = (0.001, 0.03, 0.1)
ORIENTATIONS = tuple(math.radians(degrees) for degrees in (1.0, 3.0, 10.0))
COUNTS = (5, 10, 20, 40, 80, 160, 320)
RANGES: dict[Joint, tuple[float, ...]] = {
    "prismatic": (0.05, 0.2, 0.4),
    "revolute": tuple(math.radians(degrees) for degrees in (15.0, 45.0, 90.0)),
}


def make_grid() -> list[Cell]:
    """Return all cells of the grid."""
    return [
        Cell(joint, position, orientation, count, reach)
        for joint, ranges in RANGES.items()
        for position, orientation, count, reach in product(POSITIONS, ORIENTATIONS, COUNTS, ranges)
    ]


def make_quick_grid() -> list[Cell]:
    """Return a few cells spread over the grid."""
    return [
        Cell(joint, position, orientation, count, reach)
        for joint, ranges in RANGES.items()
        for position, orientation in zip(POSITIONS, ORIENTATIONS, strict=True)
        for count, reach in product((10, 40), ranges[1:])
    ]


def fit_all(
    cells: Sequence[Cell], samples: int, progress: Progress, workers: int | None = None
) -> list[CellResult]:
    """Fit samples of each cell and return the results in the same order."""
    workers = workers or os.cpu_count() or 1
    if workers == 1:
        return [fit_cell(cell, samples) for cell in progress(cells, "estimation-grid", "cell")]
    # Spawned processes, because a fork during a background compilation may hang. Long cells first, so that
    # all processes end at about the same time.
    order = sorted(range(len(cells)), key=lambda k: -cells[k].count)
    with worker_pool(workers) as pool:
        jobs: list[tuple[int, Future[CellResult]]] = [
            (k, pool.submit(fit_cell, cells[k], samples)) for k in order
        ]
        done = {k: job.result() for k, job in progress(jobs, "estimation-grid", "cell")}
    return [done[k] for k in range(len(cells))]


def fit_cell(cell: Cell, count: int) -> CellResult:
    """Fit samples of a cell, drawn with a fixed seed."""
    samples = draw_samples(cell, count, np.random.default_rng(_seed(cell)))
    limit, reach = compute_bound(samples), compute_attainable_bound(samples)
    fits = [_fit(samples, k) for k in range(count)]
    return CellResult(
        cell=cell,
        degrees=np.array([_degrees(fit, samples.axis[k]) for k, (fit, _, _) in enumerate(fits)]),
        metres=np.array([_metres(fit, samples, k) for k, (fit, _, _) in enumerate(fits)]),
        bound_degrees=limit.degrees,
        bound_metres=limit.metres,
        attainable_degrees=reach.degrees,
        attainable_metres=reach.metres,
        spread=_spread(reach),
        right=np.array([called == cell.joint for _, called, _ in fits]),
        told=np.array([told for _, _, told in fits]),
        called=tuple(called for _, called, _ in fits),
    )


def _fit(samples: JointSamples, k: int) -> tuple[Fit | None, str, bool]:
    """Return the fit of the true family or None, the most probable family, and True if it is unambiguous."""
    cell = samples.cell
    covariance = pose_covariance(cell.position, cell.orientation)
    try:
        found = identify(
            samples.seen_parents[k],
            samples.seen_children[k],
            parent_covariance=covariance,
            child_covariance=covariance,
        )
        return found[cell.joint], found.best.family, not found.is_ambiguous
    except KineverseError as error:
        return None, f"refused: {error}", False


def _degrees(fit: Fit | None, axis: Array) -> float:
    """Return the angle between the true and the estimated axis [deg], regardless of sign."""
    if fit is None:
        return math.nan
    found = np.asarray(fit.parameters["axis"])
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(axis, found))), abs(float(axis @ found))))


def _metres(fit: Fit | None, samples: JointSamples, k: int) -> float:
    """Return the distance of the estimated axis from the true one, in the plane across it at mid-path [m]."""
    if fit is None or samples.cell.joint == "prismatic":
        return math.nan
    axis, point = samples.axis[k], samples.point[k]
    found, through = np.asarray(fit.parameters["axis"]), np.asarray(fit.parameters["point"])
    slope = float(axis @ found)
    if abs(slope) < 1e-9:
        return math.inf
    crossing = through + (float(axis @ (point - through)) / slope) * found
    return float(np.linalg.norm(crossing - point))


def _spread(limit: Bound) -> float:
    """Return the relative variance of the sum of squared angles under the bound."""
    squares = np.trace(limit.direction @ limit.direction, axis1=1, axis2=2).sum()
    return float(2.0 * squares / np.trace(limit.direction, axis1=1, axis2=2).sum() ** 2)


def _seed(cell: Cell) -> list[int]:
    """Return the seed of a cell, independent of the other cells."""
    micro = (round(1e6 * value) for value in (cell.position, cell.orientation, cell.range))
    return [SEED, cell.joint == "revolute", cell.count, *micro]
