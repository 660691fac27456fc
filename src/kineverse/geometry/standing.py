"""A tree of boxes around what stands, so that a search costs by what is near and not by what is there."""

from __future__ import annotations

import numpy as np

from .mesh_files import Floats
from .table import Indices

LEAF = 4
"""So many pieces are in a leaf."""


def tree_of(low: Floats, high: Floats, pieces: Indices) -> tuple[Floats, Indices]:
    """Return a full binary tree over pieces, halved along the longest edge again and again.

    Parameters
    ----------
    low, high
        (M, 3) the corners of the boxes around all pieces [m].
    pieces
        (K,) which of them are in the tree.

    Returns
    -------
    boxes, leaves
        (2 L - 1, 6) the corners of the box around all below a node k, whose children are 2 k + 1 and 2 k + 2;
        and (L, 4) the pieces of the leaves, which are the last L nodes; -1 for none.
    """
    count = 1
    while LEAF * count < len(pieces):
        count *= 2
    leaves = np.full((count, LEAF), -1, dtype=np.int32)
    parts = [(pieces, 0, count)]
    while parts:
        some, first, width = parts.pop()
        if width == 1:
            leaves[first, : len(some)] = some
            continue
        middle = (low[some] + high[some]) / 2
        axis = int(np.argmax(np.ptp(middle, axis=0))) if len(some) else 0
        order = some[np.argsort(middle[:, axis], kind="stable")]
        half = (len(some) + 1) // 2
        parts += [(order[:half], first, width // 2), (order[half:], first + width // 2, width // 2)]
    boxes = np.empty((2 * count - 1, 6))
    # A row more, which -1 finds: the box around nothing. There may be no piece at all.
    nothing = np.full((1, 3), np.inf)
    boxes[count - 1 :, :3] = np.concatenate([low, nothing])[leaves].min(axis=1)
    boxes[count - 1 :, 3:] = np.concatenate([high, -nothing])[leaves].max(axis=1)
    for k in range(count - 2, -1, -1):
        one, other = boxes[2 * k + 1], boxes[2 * k + 2]
        boxes[k, :3], boxes[k, 3:] = np.minimum(one[:3], other[:3]), np.maximum(one[3:], other[3:])
    return boxes, leaves
