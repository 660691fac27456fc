"""Convex decomposition of a mesh: cleaned, cut by CoACD in a separate process with limits, and cached."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from kineverse._extras import install_command
from kineverse.compilation.cache import UNFINISHED
from kineverse.errors import FormatError, InvalidValueError, KineverseError, MissingDependencyError
from kineverse.geometry.mesh_files import Faces, Floats, Integers, find_mesh_file, read_faces
from kineverse.geometry.shapes import check_extent, enclosed_volume
from kineverse.model.body import Mesh

from . import result
from .accuracy import Polytope, is_closed, measure_accuracy, nearest_surface_points
from .result import DECOMPOSITIONS, Decomposition, DecompositionSettings

MOST_FACES = 300_000  # largest number of triangles that is decomposed; more take CoACD hours and all memory
_MOST_PARTS = 64  # connected parts of a mesh are decomposed one by one, up to this number
_FLAT = 1e-6  # a mesh thinner than this part of its size has no volume
PROGRAM = Path(__file__).with_name("_coacd_main.py")
_POLL = 0.05
_MAX_MESSAGE = 300
# Messages of Python, C++ and the dynamic loader about a lack of memory.
_MEMORY_ERRORS = (
    b"MemoryError",
    b"bad_alloc",
    b"annot allocate memory",
    b"failed to map segment",
    b"Resource temporarily unavailable",
)


class DecompositionError(KineverseError, RuntimeError):
    """Failed decomposition: CoACD crashed, ran out of time or memory, or returned impossible hulls.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """


@dataclass(frozen=True, slots=True)
class ResourceLimits:
    """Limits on the resources for one mesh.

    Attributes
    ----------
    seconds
        Time [s].
    memory
        Address space [bytes]; not bounded on Windows, and not reliably on macOS.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """

    seconds: float = 600.0
    memory: int = 4 * 2**30


def run_coacd(
    surface: CleanMesh, error: float, limits: ResourceLimits, stop: threading.Event | None = None
) -> list[Floats]:
    """Run CoACD in a separate process, and return the corners of its convex hulls, (n, 3) each [m]."""
    if importlib.util.find_spec("coacd") is None:
        raise MissingDependencyError(f"decomposing meshes needs CoACD: {install_command('decomposition')}")
    # In the cache, which removes what killed processes have left.
    place = DECOMPOSITIONS.folder.path
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=place, ignore_cleanup_errors=True) as folder:
        source, target, said = (Path(folder) / name for name in ("in.npz", "out.npz", "said.txt"))
        np.savez(source, vertices=surface.faces.vertices, faces=surface.faces.faces, parts=surface.parts)
        # -P keeps the program from importing its neighbours by accident.
        command = [sys.executable, "-P", str(PROGRAM), str(source), str(target), repr(error)]
        with said.open("wb") as errors:
            status = _run_process([*command, str(limits.memory)], errors.fileno(), limits, stop)
        if status == 0:
            return _read_hulls(target, surface)
        raise DecompositionError(_explain_failure(status, said.read_bytes()[-20_000:]))


def _run_process(
    command: list[str], errors: int, limits: ResourceLimits, stop: threading.Event | None
) -> int:
    # Threads hardly speed CoACD up, and several meshes are decomposed in parallel.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    end = time.monotonic() + limits.seconds
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, env=environment
    ) as process:
        try:
            while process.poll() is None:
                if stop is not None and stop.wait(_POLL):
                    raise DecompositionError("It was stopped.")
                if time.monotonic() > end:
                    raise DecompositionError(
                        f"CoACD did not end within {limits.seconds:g} s. Simplify the mesh, allow a larger "
                        "error, or more time."
                    )
                if stop is None:
                    time.sleep(_POLL)
        finally:
            process.kill()
        return process.wait()


def _read_hulls(target: Path, surface: CleanMesh) -> list[Floats]:
    try:
        with np.load(target, allow_pickle=False) as arrays:
            points, sizes = np.asarray(arrays["points"], dtype=float), np.asarray(arrays["sizes"])
        hulls = np.split(points, np.cumsum(sizes)[:-1])
    except Exception as error:
        raise DecompositionError("CoACD's answer cannot be read.") from error
    low, high = surface.faces.vertices.min(axis=0), surface.faces.vertices.max(axis=0)
    room = 0.1 * surface.size
    if not (np.isfinite(points).all() and (points > low - room).all() and (points < high + room).all()):
        raise DecompositionError("The hulls of CoACD are not where the mesh is.")
    return hulls


def _explain_failure(status: int, said: bytes) -> str:
    lines = said.decode(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")[:_MAX_MESSAGE]
    if status < 0:
        try:
            how = f"was ended by {signal.Signals(-status).name}"
        except ValueError:
            how = f"was ended by signal {-status}"
    else:
        how = f"ended with status {status}"
    if any(sign in said for sign in _MEMORY_ERRORS):
        advice = (
            "It needs more memory than it may have: allow more, simplify the mesh, or allow a larger error."
        )
    elif "SIGKILL" in how:
        advice = "Systems without free memory do that: decompose fewer at a time, or simplify the mesh."
    else:
        advice = "Simplify or repair the mesh, or allow more memory."
    return f"CoACD {how}{': ' if last else ''}{last.rstrip('.')}. {advice}"


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
    """Outcome for one mesh: a decomposition, from the cache or new, or an error.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """

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

    See Also
    --------
    kineverse.geometry.decomposition.decompose
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

    Examples
    --------
    >>> import trimesh
    >>> bracket = trimesh.util.concatenate(
    ...     [trimesh.creation.box((0.3, 0.1, 0.02)), trimesh.creation.box((0.02, 0.1, 0.3))]
    ... )
    >>> data = bracket.export("bracket.stl")
    >>> outcome = kv.geometry.decomposition.decompose(kv.model.Mesh("bracket.stl"))
    >>> len(outcome.decomposition.hulls) > 1
    True
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

    See Also
    --------
    kineverse.geometry.decomposition.decompose
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


@dataclass(frozen=True, slots=True, eq=False)
class CleanMesh:
    """Cleaned mesh, ready for decomposition."""

    faces: Faces  # vertices and triangles [m]
    parts: Integers  # connected part of each triangle, (F,); parts are decomposed one by one
    name: str  # path of the mesh file
    remarks: tuple[str, ...]  # defects of the mesh

    @property
    def size(self) -> float:
        """Longest edge of the bounding box [m]."""
        return float(np.ptp(self.faces.vertices, axis=0).max())

    @property
    def digest(self) -> str:
        """SHA-256 of the vertices and triangles."""
        arrays = self.faces.vertices.astype("<f8"), self.faces.faces.astype("<i8")
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def clean_mesh(mesh: Mesh) -> CleanMesh:
    """Read, scale and clean a mesh; a scale with an odd number of negative factors mirrors it."""
    scale = np.array(mesh.scale, dtype=float)
    if not all(math.isfinite(factor) and factor for factor in mesh.scale):
        raise InvalidValueError(f"{mesh.uri}: its scale is {mesh.scale}: factors are finite and not 0.")
    try:
        file = find_mesh_file(mesh)
        read = read_faces(file)
    except OSError as error:
        raise FormatError(f"{mesh.uri}: {error}") from error
    try:
        return _prepare(read, scale, str(file.path))
    except InvalidValueError as error:
        raise InvalidValueError(f"{file.path}: {error}") from error


def _prepare(read: Faces, scale: Floats, name: str) -> CleanMesh:
    if len(read.faces) > MOST_FACES:
        raise InvalidValueError(
            f"it has {len(read.faces)} triangles, and {MOST_FACES} are taken at most. Simplify it first."
        )
    used, faces = np.unique(read.faces, return_inverse=True)
    # Adding 0 turns -0 into 0, which is the same coordinate.
    vertices, same = np.unique(read.vertices[used] * scale + 0.0, axis=0, return_inverse=True)
    faces = same.reshape(-1)[faces.reshape(-1, 3)]
    check_extent(vertices)
    if _thickness(vertices) < _FLAT:
        raise InvalidValueError(
            "it is flat and encloses nothing, so there is nothing to decompose. Its hull will do."
        )
    faces = _drop_degenerate(vertices, faces)
    if np.prod(scale) < 0:
        faces = faces[:, ::-1]
    faces = np.ascontiguousarray(faces)
    if not is_closed(faces):
        remark = "its surface is not closed, or several of its triangles share an edge: it is wrapped first"
        return CleanMesh(Faces(vertices, faces), np.zeros(len(faces), dtype=np.int64), name, (remark,))
    parts = _connected_parts(faces, len(vertices))
    volumes = (
        [enclosed_volume(vertices, faces[parts == k]) for k in range(parts.max() + 1)]
        if parts.max() < _MOST_PARTS
        else []
    )
    if volumes and max(volumes) < 0.0:
        faces, volumes = np.ascontiguousarray(faces[:, ::-1]), [-v for v in volumes]
    if not volumes or min(volumes) <= 0.0:
        # A part that faces inwards is a hole in another part.
        parts = np.zeros(len(faces), dtype=np.int64)
    return CleanMesh(Faces(vertices, faces), parts, name, ())


def _thickness(vertices: Floats) -> float:
    """Return the ratio of the smallest to the largest extent along the principal axes."""
    centred = vertices - vertices.mean(axis=0)
    extents = np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1], axis=0)
    return float(extents.min() / extents.max())


def _drop_degenerate(vertices: Floats, faces: Integers) -> Integers:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return np.asarray(faces[distinct & (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0)])


def _connected_parts(faces: Integers, count: int) -> Integers:
    label = np.arange(count)
    while True:
        least = label[faces].min(axis=1)
        before = label.copy()
        for k in range(3):
            np.minimum.at(label, faces[:, k], least)
            np.minimum.at(label, before[faces[:, k]], least)
        label = label[label]
        if np.array_equal(label, before):
            return np.asarray(np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1))
