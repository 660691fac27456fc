"""Convex decomposition of a mesh, through the cache."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from kineverse.errors import FormatError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.geometry.mesh_files import Floats
from kineverse.model.body import Mesh

from . import result
from .accuracy import Polytope, measure_accuracy, nearest_surface_points
from .coacd_process import DecompositionError, ResourceLimits, run_coacd
from .mesh_cleanup import CleanMesh, clean_mesh
from .result import Decomposition, DecompositionSettings

_INSIDE = 1e-9  # a hull that protrudes from another by less than this part of its size is inside of it


def clean_hulls(hulls: list[Floats], whole: Polytope) -> list[Polytope]:
    """Make hulls of sets of points, without degenerate hulls and hulls inside of another one.

    Points outside of the hull of the whole mesh are projected onto it, because CoACD's wrapping of an open
    surface is a little larger all around.
    """
    result = []
    for points in hulls:
        points = points.copy()
        beyond = whole.face_distances(points) > 0.0
        points[beyond] = nearest_surface_points(whole.engine, points[beyond])[1]
        try:
            result.append(Polytope.from_points(points))
        except InvalidValueError:  # A degenerate part: a cut has met a corner or an edge.
            continue
    result.sort(key=lambda polytope: -polytope.volume)
    kept: list[Polytope] = []
    for polytope in result:
        room = _INSIDE * np.ptp(polytope.points, axis=0).max()
        if not any((larger.face_distances(polytope.points) <= room).all() for larger in kept):
            kept.append(polytope)
    return kept


def reduce_hulls(hulls: list[Polytope], count: int) -> list[Polytope]:
    """Join hulls until ``count`` are left, each time the pair whose common hull adds least volume."""
    alive = dict(enumerate(hulls))
    pairs = combinations(alive, 2) if len(alive) > count else ()
    joined = {(i, j): _join_hulls(alive[i], alive[j]) for i, j in pairs}
    while len(alive) > count:
        (i, j), (_, one) = min(joined.items(), key=lambda item: (item[1][0], item[0]))
        new = max(alive) + 1
        del alive[i], alive[j]
        joined = {pair: value for pair, value in joined.items() if not {i, j} & set(pair)}
        joined |= {(k, new): _join_hulls(other, one) for k, other in alive.items()}
        alive[new] = one
    return list(alive.values())


def _join_hulls(one: Polytope, other: Polytope) -> tuple[float, Polytope]:
    """Return the volume that joining two hulls adds [m³], and their common hull."""
    both = Polytope.from_points(np.concatenate([one.points, other.points]))
    return both.volume - one.volume - other.volume, both


DEFAULTS, LIMITS = DecompositionSettings(), ResourceLimits()


@dataclass(frozen=True, slots=True)
class DecompositionOutcome:
    """Outcome for one mesh: a decomposition, from the cache or new, or an error."""

    mesh: Mesh
    decomposition: Decomposition | None = None
    error: KineverseError | None = None
    cached: bool = False


def find_hulls(mesh: Mesh, settings: DecompositionSettings | None = None) -> tuple[Floats, ...] | None:
    """Return the cached convex hulls of a mesh, or None.

    Parameters
    ----------
    mesh
        A mesh; its scale is applied.
    settings
        Settings of the decomposition; None selects the latest one of the mesh.

    Returns
    -------
    The corners of each hull, (n, 3) in the frame of the mesh [m], read-only, in a fixed order.

    Raises
    ------
    FormatError, InvalidValueError, MissingDependencyError
        If the mesh cannot be read or decomposed.
    """
    surface = clean_mesh(mesh)
    found = result.find_entry(surface.digest, settings.key(surface.size) if settings else None)
    return found.hulls if found else None


def decompose(
    mesh: Mesh,
    settings: DecompositionSettings = DEFAULTS,
    limits: ResourceLimits = LIMITS,
    force: bool = False,
    stop: threading.Event | None = None,
) -> DecompositionOutcome:
    """Decompose a mesh into convex hulls, or read them from the cache; it takes seconds to minutes.

    Equal meshes and settings give equal hulls.

    Parameters
    ----------
    mesh
        A mesh; its scale is applied.
    limits
        Limits on time and memory.
    force
        Whether to ignore the cache.
    stop
        Event that ends the computation with a :class:`DecompositionError`.

    Raises
    ------
    FormatError, InvalidValueError
        If the mesh cannot be read, is flat, or of an impossible size; the message names the file.
    MissingDependencyError
        If CoACD, coal or trimesh is not installed.
    DecompositionError
        If CoACD fails, or exceeds its limits.
    """
    surface = clean_mesh(mesh)
    digest, key = surface.digest, settings.key(surface.size)
    found = None if force else result.find_entry(digest, key)
    if found is not None:
        return DecompositionOutcome(mesh, found, cached=True)
    try:
        made = _decompose_surface(surface, settings, limits, stop)
    except DecompositionError as error:
        raise DecompositionError(f"{surface.name}: {error}") from error
    result.add_entry(digest, key, made)
    return DecompositionOutcome(mesh, made)


def decompose_all(
    meshes: Sequence[Mesh],
    settings: DecompositionSettings = DEFAULTS,
    limits: ResourceLimits = LIMITS,
    force: bool = False,
    jobs: int = 1,
) -> Iterator[DecompositionOutcome]:
    """Decompose meshes and yield each outcome as soon as it is known; an error does not stop the others.

    Parameters
    ----------
    meshes, settings, limits, force
        See :func:`decompose`.
    jobs
        Number of meshes that are decomposed at the same time, each on one core.

    Raises
    ------
    MissingDependencyError
        If CoACD, coal or trimesh is not installed.
    """
    stop = threading.Event()

    def one(mesh: Mesh) -> DecompositionOutcome:
        try:
            return decompose(mesh, settings, limits, force, stop)
        except MissingDependencyError:
            raise
        except KineverseError as error:
            return DecompositionOutcome(mesh, error=error)
        except OSError as error:
            return DecompositionOutcome(mesh, error=FormatError(f"{mesh.uri}: {error}"))

    with ThreadPoolExecutor(jobs, thread_name_prefix="kineverse-decompose") as pool:
        waiting = [pool.submit(one, mesh) for mesh in meshes]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            # A caller that closes the iterator, or presses Ctrl-C, does not wait for the rest.
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _decompose_surface(
    surface: CleanMesh, settings: DecompositionSettings, limits: ResourceLimits, stop: threading.Event | None
) -> Decomposition:
    start = time.perf_counter()
    error = settings.max_error(surface.size)
    whole = Polytope.from_points(surface.faces.vertices)
    hulls = clean_hulls(run_coacd(surface, error, limits, stop), whole)
    hulls = reduce_hulls(hulls, settings.max_hulls)
    if not hulls:
        raise DecompositionError("CoACD found no hull.")
    accuracy = measure_accuracy(surface.faces, hulls)
    corners = [np.ascontiguousarray(polytope.points) for polytope in hulls]
    for array in corners:
        array.flags.writeable = False
    facts = surface.name, error, settings.max_hulls, accuracy, time.perf_counter() - start, time.time()
    return Decomposition(tuple(corners), *facts, surface.remarks)
