"""Planning queries: search, shortcuts and certificate, in the whole space or on a manifold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.compilation.build_queue import working_seconds
from kineverse.lie import Array

from .bindings import TIME_IS_UP, TOO_LONG
from .collision_checker import RESOLUTION, CollisionChecker
from .collision_geometry import Floats32
from .manifold import Manifold
from .sampling_planners import PATH_ROOM, Roadmap, RrtConnect, SearchResult

PATIENCE, MORE_PATIENCE = 40, 160
"""Numbers of shortcuts in a row that may bring nothing: for the first path, and where paths are optimized."""
_REPAIRS = 12
_FINER = 8.0  # factor of the resolution where an edge collides between its samples
_FINEST = 4000.0
_ATTEMPTS, _NEXT_SEED = 16, 7919
_LEAST_CHECK = 1.0  # least time for the checks of a path [s]; the limit of the search, if that is longer
_TELLING = 100  # number of samples after which a small tree says that its root cannot be left
_WIDER, _WIDE_EDGES = 1e-3, 10_000
"""Wider margin, with which edges of a search are mostly free between their samples [m]. A passage, such as a
door, may be too narrow for it: after that many edges, or half of the time, searches go on without."""


@dataclass(frozen=True, slots=True)
class Connected:
    """Outcome of a query."""

    points: Array  # (N, n) configurations of the path, or of the best partial one
    problem: str  # why it does not lead to a goal; empty if it does
    iterations: int  # number of samples


_THIN = "A path was found whose samples are free, but something thin lies between two of them"


def connect(
    checker: CollisionChecker,
    manifold: Manifold | None,
    starts: Floats32,
    goals: Floats32,
    seconds: float,
    seed: int,
    edges: int,
    roadmap: Roadmap | None,
    patience: int,
    asked: float,
) -> Connected:
    """Find a path from one of (S, n) starts to one of (G, n) goals, certified between its samples.

    In the whole space, edges that collide between samples are planned again, with more samples. The points of
    a path on a manifold are on it in double precision, and lines between them keep to it, see
    :meth:`.Manifold.refine`. If it collides between samples, another seed and more samples are tried.
    """
    begin = working_seconds()
    search, ends = RrtConnect(checker, manifold), np.vstack([starts, goals])
    iterations, resolution, problem, points = 0, RESOLUTION, "", starts
    for attempt in range(_ATTEMPTS):
        if attempt and working_seconds() - begin >= seconds:
            break
        for by in (_WIDER, 0.0):
            left = seconds - (working_seconds() - begin)
            with checker.widened(by, ends) as wider:
                share, most = (left / 2, min(edges, _WIDE_EDGES)) if wider else (left, edges)
                if roadmap is None:
                    result = search.solve(starts, goals, share, seed + _NEXT_SEED * attempt, resolution, most)
                else:
                    result = roadmap.solve(checker, starts, goals, share, seed + _NEXT_SEED * attempt)
                points = result.points
                if manifold is not None and result.found:
                    points = search.contract(points, left)
            iterations += result.iterations
            if result.found or not wider:
                break
        if not result.found:
            return Connected(points.astype(float), problem or explain_failure(result, asked), iterations)
        checked = checked_by(begin, seconds)
        if manifold is None:
            # Parts of a shortcut that just passes would not be certain by themselves.
            with checker.widened(_WIDER / 2, ends):
                points = search.shorten(points, seconds - (working_seconds() - begin), seed, patience)
            certain = _repair(search, checker, points, begin + seconds, checked, seed, edges)
            if certain is not None:
                return Connected(certain.astype(float), "", iterations)
            continue
        exact = manifold.refine(points)
        if exact is None:
            problem = "A path was found, but within limits its holds cannot be met exactly all along it."
            continue
        narrow = np.ascontiguousarray(exact, dtype=np.float32)
        if checker.find_collision(narrow, checked - working_seconds()) is None:
            return Connected(exact, "", iterations)
        problem = f"{_THIN}."
        resolution *= 2.0
    hint = ", and no detour was found in time. More seconds=, or another seed=, may find one."
    return Connected(points.astype(float), problem or _THIN + hint, iterations)


def _repair(
    search: RrtConnect,
    checker: CollisionChecker,
    points: Floats32,
    end: float,
    checked: float,
    seed: int,
    edges: int,
) -> Floats32 | None:
    """Plan edges that are not certainly free again, with more samples; None without a detour."""
    resolution = RESOLUTION
    for _ in range(_REPAIRS):
        collision = checker.find_collision(points, checked - working_seconds())
        if collision is None:
            return points
        k, _fraction = collision
        resolution = min(_FINER * resolution, _FINEST)
        left = end - working_seconds()
        detour = search.solve(points[k : k + 1], points[k + 1 : k + 2], left, seed, resolution, edges)
        if not detour.found:
            return None
        points = np.ascontiguousarray(np.vstack([points[:k], detour.points, points[k + 2 :]]))
    return None


def checked_by(begin: float, seconds: float) -> float:
    """Return the time by which the result of a search is checked."""
    return begin + seconds + max(seconds, _LEAST_CHECK)


def explain_failure(found: SearchResult, seconds: float) -> str:
    """Explain why a search has found no path, and how far it has come."""
    if found.status == TOO_LONG:
        return f"A path was found, but it has more than the allowed {PATH_ROOM} points: choose nearer goals."
    forth, back = found.nodes
    reached = f"{forth} configurations were reached from the start and {back} from the goals"
    names = ("the start", "the goal") if found.iterations >= _TELLING else ()
    enclosed = [name for name, count in zip(names, found.nodes, strict=False) if count < 8]
    hint = f" It seems that {' and '.join(enclosed)} cannot be left." if enclosed else ""
    if math.isfinite(found.gap):
        reached += f", and the nearest pair is {found.gap:.3g} apart"
    if found.status == TIME_IS_UP:
        return f"The time of {seconds:g} s is up: {reached}.{hint} Give more seconds=, or other goals."
    return f"The search ended: {reached}.{hint}"


def unique_rows(Q: Array, apart: float) -> Sequence[int]:
    """Return the indices of rows (N, n) none of which is nearer to an earlier one than a distance."""
    kept: list[int] = []
    for k, q in enumerate(Q):
        if not kept or np.linalg.norm(Q[kept] - q, axis=1).min() > apart:
            kept.append(k)
    return kept
