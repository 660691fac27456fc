"""What a question about many pairs is answered with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np

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
    pairs, distances, witnesses
        (K, 2) pieces, (K,) their distances [m], (K, 9) the nearest points of both and the normals.

    Attributes
    ----------
    distances
        (K,) [m].
    points_a, points_b, normals
        (K, 3) each, as in :class:`Closest`.
    """

    def __init__(self, mirror: Mirror, pairs: Indices, distances: Floats, witnesses: Floats) -> None:
        self._bodies, self._pieces = mirror.bodies, mirror.pieces
        owners = mirror.table.body[pairs]
        turned = owners[:, 0] > owners[:, 1]
        if turned.any():
            pairs, owners, witnesses = pairs.copy(), owners.copy(), witnesses.copy()
            pairs[turned], owners[turned] = pairs[turned, ::-1], owners[turned, ::-1]
            backwards = witnesses[turned]
            witnesses[turned] = np.hstack([backwards[:, 3:6], backwards[:, :3], -backwards[:, 6:]])
        self._numbers, self._owners = pairs, owners
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
