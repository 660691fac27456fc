"""Decomposition settings and results, and their serialisation."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from kineverse.compilation.cache_kinds import KINDS
from kineverse.errors import FormatError, InvalidValueError
from kineverse.geometry.mesh_files import Floats

from .accuracy import Accuracy

ERROR_OF_SIZE = 0.02  # default error, as a part of the longest edge of the mesh's bounding box
MOST_HULLS = 32  # default of the largest number of hulls
_VERSION = 1  # increased when the hulls of equal meshes and settings change


@dataclass(frozen=True, slots=True)
class DecompositionSettings:
    """Settings of a decomposition.

    Attributes
    ----------
    error
        Largest protrusion of the hulls from the mesh [m] that CoACD aims at; 2 % of the longest edge of the
        bounding box if None. It is no bound: CoACD estimates it from samples, and few hulls cannot meet it.
        :class:`Accuracy` has the measured values.
    max_hulls
        Largest number of hulls.

    Raises
    ------
    InvalidValueError
        If one of them is not positive.

    Examples
    --------
    >>> settings = kv.geometry.decomposition.DecompositionSettings(max_hulls=8)
    >>> settings.max_error(0.5)  # of a mesh 0.5 m long: 2 %
    0.01
    """

    error: float | None = None
    max_hulls: int = MOST_HULLS

    def __post_init__(self) -> None:
        if self.error is not None and not (math.isfinite(self.error) and self.error > 0.0):
            raise InvalidValueError(
                f"The error of a decomposition is a positive length [m], not {self.error}."
            )
        if self.max_hulls < 1:
            raise InvalidValueError(f"A decomposition has at least one hull, not {self.max_hulls}.")

    def max_error(self, size: float) -> float:
        """Return the error for a mesh whose bounding box has this longest edge, both [m]."""
        return ERROR_OF_SIZE * size if self.error is None else self.error

    def key(self, size: float) -> str:
        """Return the cache key of the settings for a mesh of this size [m]."""
        content = json.dumps([_VERSION, self.max_error(size).hex(), self.max_hulls])
        return hashlib.sha256(content.encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True, eq=False)
class Decomposition:
    """Convex hulls whose union approximates a mesh.

    Attributes
    ----------
    hulls
        Corners of each hull, (n, 3) in the frame of the mesh, scaled [m]; read-only.
    name
        Path of the mesh file.
    error, max_hulls
        Settings of the decomposition: error [m] and largest number of hulls.
    accuracy
        Measured volumes and deviations.
    seconds
        Computation time [s].
    made
        Time of creation, in seconds since 1970.
    remarks
        Defects of the mesh.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """

    hulls: tuple[Floats, ...]
    name: str
    error: float
    max_hulls: int
    accuracy: Accuracy
    seconds: float
    made: float
    remarks: tuple[str, ...] = ()

    def to_bytes(self) -> bytes:
        """Serialise the decomposition exactly; :meth:`from_bytes` reads it back."""
        facts = asdict(replace(self, hulls=()))
        del facts["hulls"]
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            facts=np.frombuffer(json.dumps(facts).encode(), dtype=np.uint8),
            points=np.concatenate(self.hulls),
            sizes=np.array([len(hull) for hull in self.hulls]),
        )
        return buffer.getvalue()

    @staticmethod
    def from_bytes(content: bytes) -> Decomposition:
        """Read a decomposition that :meth:`to_bytes` wrote.

        Raises
        ------
        FormatError
            If the content is anything else.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                facts = json.loads(arrays["facts"].tobytes())
                points, sizes = arrays["points"], arrays["sizes"]
            points.flags.writeable = False
            facts["accuracy"] = Accuracy(**facts["accuracy"])
            facts["remarks"] = tuple(facts["remarks"])
            return Decomposition(tuple(np.split(points, np.cumsum(sizes)[:-1])), **facts)
        except Exception as error:  # zip, numpy and json raise all kinds of errors for a damaged archive.
            raise FormatError("This is not a decomposition.") from error


DECOMPOSITIONS = KINDS["decompositions"].make_cache(
    logging.getLogger("kineverse.geometry"), "The decomposition %s %s and counts as absent."
)
"""The cache."""


@dataclass(frozen=True, slots=True)
class CacheEntry:
    """Cached decomposition, and the size of its file [bytes].

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """

    decomposition: Decomposition
    bytes: int


def find_entry(mesh: str, settings: str | None = None) -> Decomposition | None:
    """Return the cached decomposition of a mesh, for a key of settings or the latest one, or None."""
    if settings is not None:
        return DECOMPOSITIONS.read(_key(mesh, settings), Decomposition.from_bytes)
    keys = [key for key in DECOMPOSITIONS.list_keys() if key.startswith(_key(mesh, ""))]
    result = [DECOMPOSITIONS.read(key, Decomposition.from_bytes) for key in keys]
    return max((some for some in result if some), key=lambda some: some.made, default=None)


def add_entry(mesh: str, settings: str, decomposition: Decomposition) -> None:
    """Write a decomposition atomically, see :func:`find_entry`."""
    DECOMPOSITIONS.write(_key(mesh, settings), decomposition.to_bytes())


def list_entries() -> list[CacheEntry]:
    """Return all entries of the cache, sorted by the name of the mesh file.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """
    kept = [CacheEntry(*entry) for entry in DECOMPOSITIONS.read_all(Decomposition.from_bytes)]
    return sorted(kept, key=lambda one: (one.decomposition.name, one.decomposition.made))


def clear() -> int:
    """Remove all entries, and return their number.

    See Also
    --------
    kineverse.geometry.decomposition.decompose
    """
    return DECOMPOSITIONS.clear()


def folder() -> Path:
    """Return the path of the cache folder.

    Examples
    --------
    >>> kv.geometry.decomposition.folder().name
    'decompositions'
    """
    return DECOMPOSITIONS.folder.path


def _key(mesh: str, settings: str) -> str:
    return f"{mesh[:40]}-{settings}"
