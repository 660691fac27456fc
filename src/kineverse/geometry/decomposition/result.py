"""Decomposition settings and results, and their serialisation."""

from __future__ import annotations

import hashlib
import io
import json
import math
from dataclasses import asdict, dataclass, field

import numpy as np

from kineverse.errors import FormatError, InvalidValueError
from kineverse.geometry.mesh_files import Floats

from .accuracy import Accuracy

ERROR_OF_SIZE = 0.02
"""The error that is allowed where none is given, as a part of the longest edge of the mesh's box."""

MOST_HULLS = 32
"""How many hulls are allowed where no number is given."""

# Counted up when other hulls come out for the same mesh and settings.
_VERSION = 1


@dataclass(frozen=True, slots=True)
class DecompositionSettings:
    """What a decomposition should be like.

    Attributes
    ----------
    error
        How far the hulls may stand out from the mesh [m]; 2 % of the longest edge of its box if None. It is
        what CoACD aims at by samples of its own, and no bound: with few hulls it cannot be met. What came out
        is measured, see :class:`Accuracy`.
    max_hulls
        At most so many hulls.

    Raises
    ------
    InvalidValueError
        If one of them is not positive.
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

    def allowed(self, size: float) -> float:
        """Return the error that is allowed for a mesh whose box has this longest edge, both [m]."""
        return ERROR_OF_SIZE * size if self.error is None else self.error

    def key(self, size: float) -> str:
        """Return what stands for the settings of a mesh of this size [m] in the cache."""
        told = json.dumps([_VERSION, self.allowed(size).hex(), self.max_hulls])
        return hashlib.sha256(told.encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True, eq=False)
class Decomposition:
    """Convex hulls whose union stands for a mesh.

    Attributes
    ----------
    hulls
        The corners of each hull, (n, 3) in the frame of the mesh, scaled [m]; read-only.
    name
        The file it was made from.
    error
        What was allowed [m].
    max_hulls
        How many hulls were allowed.
    accuracy
        What was measured.
    seconds
        How long it took to make [s].
    made
        When it was made, in seconds since 1970.
    remarks
        What was not as it should be about the mesh.
    """

    hulls: tuple[Floats, ...]
    name: str
    error: float
    max_hulls: int
    accuracy: Accuracy
    seconds: float
    made: float
    remarks: tuple[str, ...] = field(default=())

    def to_bytes(self) -> bytes:
        """Return it as bytes, which :meth:`from_bytes` reads to the last bit."""
        facts = {
            "name": self.name,
            "error": self.error,
            "max_hulls": self.max_hulls,
            "accuracy": asdict(self.accuracy),
            "seconds": self.seconds,
            "made": self.made,
            "remarks": self.remarks,
        }
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
        """Read what :meth:`to_bytes` wrote.

        Raises
        ------
        FormatError
            If it is anything else.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                facts = json.loads(arrays["facts"].tobytes())
                points, sizes = arrays["points"], arrays["sizes"]
            points.flags.writeable = False
            hulls = tuple(np.split(points, np.cumsum(sizes)[:-1]))
            facts["accuracy"] = Accuracy(**facts["accuracy"])
            facts["remarks"] = tuple(facts["remarks"])
            return Decomposition(hulls, **facts)
        except Exception as error:  # A broken archive raises whatever zip, numpy or json come upon.
            raise FormatError("This is no decomposition.") from error
