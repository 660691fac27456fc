"""Everything that is drawn, in one heap of triangles in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.view.parts import Part
from kineverse.view.triangles import Floats, Integers


@dataclass(frozen=True, slots=True)
class Surfaces:
    """All triangles of a scene in the world, each with its colour and where it comes from.

    ``corners`` (T, 3, 3) [m], ``normals`` (T, 3, 3), ``colors`` (T, 4), ``source`` (T,) the number of the
    part, ``group`` (T,) of the frame and colour it belongs to, ``closed`` (T,) whether the inside is never
    seen.
    """

    corners: Floats
    normals: Floats
    colors: Floats
    source: Integers
    group: Integers
    closed: npt.NDArray[np.bool_]

    @staticmethod
    def of(items: Sequence[Part], poses: Mapping[str, Floats]) -> Surfaces:
        """Place parts by the poses of their frames."""
        empty = np.zeros((0, 3, 3))
        corners, normals, colors, source, group, closed = [empty], [empty], [np.zeros((0, 4))], [], [], []
        groups: dict[object, int] = {}
        for number, part in enumerate(items):
            surface = part.surface.moved(poses[part.frame])
            count = len(surface.faces)
            corners.append(surface.vertices[surface.faces])
            normals.append(surface.normals[surface.faces])
            own = surface.colors
            colors.append(np.tile(part.color, (count, 1)) if own is None else own)
            source.append(np.full(count, number))
            group.append(np.full(count, groups.setdefault((part.frame, part.color), len(groups))))
            closed.append(np.full(count, surface.closed))
        return Surfaces(
            np.concatenate(corners),
            np.concatenate(normals),
            np.concatenate(colors),
            np.concatenate([np.zeros(0, dtype=np.int64), *source]),
            np.concatenate([np.zeros(0, dtype=np.int64), *group]),
            np.concatenate([np.zeros(0, dtype=np.bool_), *closed]),
        )
