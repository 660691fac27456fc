"""From a mesh to the hulls that stand for it, by way of the cache."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np

from kineverse.errors import FormatError, KineverseError, MissingExtraError
from kineverse.geometry.mesh_files import Floats
from kineverse.model.body import Mesh

from . import store
from .accuracy import Polytope, measure
from .merging import at_most, polytopes
from .result import Decomposition, Settings
from .surface import Surface, surface_of
from .worker import DecompositionError, Limits, run

DEFAULTS, LIMITS = Settings(), Limits()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one mesh: a decomposition, from the cache or not, or an error."""

    mesh: Mesh
    decomposition: Decomposition | None = None
    error: KineverseError | None = None
    cached: bool = False


def pieces(mesh: Mesh, settings: Settings | None = None) -> tuple[Floats, ...] | None:
    """Return the convex pieces of a mesh if they are in the cache, else None.

    Parameters
    ----------
    mesh
        A mesh; its scale is applied.
    settings
        What it was decomposed with; if None, the latest of its decompositions is taken.

    Returns
    -------
    The corners of each hull, (n, 3) in the frame of the mesh [m], read-only. The order is always the same.

    Raises
    ------
    FormatError, ValueRejectedError, MissingExtraError
        If the mesh cannot be read, or there can be no decomposition of it.
    """
    surface = surface_of(mesh)
    found = store.find(surface.digest, settings.key(surface.size) if settings else None)
    return found.hulls if found else None


def decompose(
    mesh: Mesh,
    settings: Settings = DEFAULTS,
    limits: Limits = LIMITS,
    force: bool = False,
    stop: threading.Event | None = None,
) -> Outcome:
    """Return a mesh as a union of convex hulls, from the cache or made now, which takes seconds to minutes.

    The same mesh and settings give the same hulls.

    Parameters
    ----------
    mesh
        A mesh; its scale is applied.
    settings
        What is asked for.
    limits
        What it may cost.
    force
        Whether it is made anew though it is in the cache.
    stop
        Ends it, when set, with a :class:`DecompositionError`.

    Raises
    ------
    FormatError, ValueRejectedError
        If the mesh cannot be read, is flat, or of an impossible size; the message names the file.
    MissingExtraError
        If CoACD, coal or trimesh is not installed.
    DecompositionError
        If CoACD fails, or exceeds its limits.
    """
    surface = surface_of(mesh)
    digest, key = surface.digest, settings.key(surface.size)
    found = None if force else store.find(digest, key)
    if found is not None:
        return Outcome(mesh, found, cached=True)
    try:
        made = _made(surface, settings, limits, stop)
    except DecompositionError as error:
        raise DecompositionError(f"{surface.name}: {error}") from error
    store.keep(digest, key, made)
    return Outcome(mesh, made)


def decompose_all(
    meshes: Sequence[Mesh],
    settings: Settings = DEFAULTS,
    limits: Limits = LIMITS,
    force: bool = False,
    jobs: int = 1,
) -> Iterator[Outcome]:
    """Yield what becomes of each mesh, as soon as it is known; one that is wrong does not stop the others.

    Parameters
    ----------
    meshes, settings, limits, force
        See :func:`decompose`.
    jobs
        So many are decomposed at the same time, each on one core.

    Raises
    ------
    MissingExtraError
        If CoACD, coal or trimesh is not installed.
    """
    stop = threading.Event()

    def one(mesh: Mesh) -> Outcome:
        try:
            return decompose(mesh, settings, limits, force, stop)
        except MissingExtraError:
            raise
        except KineverseError as error:
            return Outcome(mesh, error=error)
        except OSError as error:
            return Outcome(mesh, error=FormatError(f"{mesh.uri}: {error}"))

    with ThreadPoolExecutor(jobs, thread_name_prefix="kineverse-decompose") as pool:
        waiting = [pool.submit(one, mesh) for mesh in meshes]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            # Whoever does not want the rest, or presses Ctrl-C, does not wait for it.
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _made(
    surface: Surface, settings: Settings, limits: Limits, stop: threading.Event | None
) -> Decomposition:
    start = time.perf_counter()
    error = settings.allowed(surface.size)
    found = polytopes(run(surface, error, limits, stop), Polytope.of(surface.faces.vertices))
    hulls = at_most(found, settings.max_hulls)
    if not hulls:
        raise DecompositionError("CoACD found no hull.")
    accuracy = measure(surface.faces, hulls)
    corners = [np.ascontiguousarray(polytope.points) for polytope in hulls]
    for array in corners:
        array.flags.writeable = False
    seconds = time.perf_counter() - start
    return Decomposition(
        tuple(corners),
        surface.name,
        error,
        settings.max_hulls,
        accuracy,
        seconds,
        time.time(),
        surface.remarks,
    )
