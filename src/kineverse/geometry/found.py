"""What a question about many pairs is answered with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from .mesh_files import Floats
from .mirror import Mirror
from .results import Closest
from .table import Indices


class Found(Sequence[Closest]):
    """Pairs of bodies, nearest first, each of which is made when it is looked at.

    Parameters
    ----------
    mirror
        Where the pieces are from.
    pieces, bodies, distances, witnesses
        (K, 2) pieces, (K, 2) their bodies, that first which is before the other in the model, (K,) their
        distances [m], (K, 9) the nearest points of both and the normals.

    Attributes
    ----------
    distances
        (K,) [m].
    points_a, points_b, normals
        (K, 3) each, as in :class:`Closest`.
    """

    def __init__(
        self, mirror: Mirror, pieces: Indices, bodies: Indices, distances: Floats, witnesses: Floats
    ) -> None:
        self._bodies, self._pieces = mirror.bodies, mirror.pieces
        self._numbers, self._owners = pieces, bodies
        self.distances = distances
        self.points_a, self.points_b, self.normals = witnesses[:, :3], witnesses[:, 3:6], witnesses[:, 6:]

    def __len__(self) -> int:
        return len(self.distances)

    @overload
    def __getitem__(self, index: int) -> Closest: ...
    @overload
    def __getitem__(self, index: slice) -> list[Closest]: ...
    def __getitem__(self, index: int | slice) -> Closest | list[Closest]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        (a, b), (i, j) = self._owners[index].tolist(), self._numbers[index].tolist()
        return Closest(
            self._bodies[a],
            self._bodies[b],
            float(self.distances[index]),
            self.points_a[index],
            self.points_b[index],
            self.normals[index],
            self._pieces[i].number,
            self._pieces[j].number,
        )

    def __repr__(self) -> str:
        listed = "".join(f"\n  {pair}" for pair in self[:12])
        more = f"\n  and {len(self) - 12} more" if len(self) > 12 else ""
        return f"<{len(self)} pairs{listed}{more}>"
