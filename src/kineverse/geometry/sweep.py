"""Which pieces may be near each other: a sweep along one axis, and bounds carried from state to state.

A point of a piece at c from its centre moves by ``|Δcentre + ΔR c| <= |Δcentre| + r ‖ΔR‖``, with r the radius
of its sphere. The sum of this over all updates is its *travel* s. Two pieces that were at a distance d when
they had travelled s_i and s_j are therefore at least ``d + s_i + s_j`` less their present travel apart. What
has gone too far for that to be exact in floating point begins again at 0.

This is the whole of it in numpy; :mod:`.sweep_native` has the same in C, several times as fast.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .mesh_files import Floats
from .table import Flags, Indices, Table

FURTHEST = 1e12
"""Nothing is put further than this from the origin, where numbers are 0.1 mm apart [m]."""

LONGEST_TRAVEL = 1e4
"""Up to this, bounds are right to some 1e-12 m [m]."""

PLACED, GONE_TOO_FAR = -1, -2


def place(table: Table, fresh: Floats) -> int:
    """Put the moving pieces at new poses (moving, 3, 4) and add to their travel.

    Returns the first piece whose pose is not finite or too far away, and then nothing has happened; otherwise
    :data:`PLACED`, or :data:`GONE_TOO_FAR` if a piece's travel is above :data:`LONGEST_TRAVEL`.
    """
    bad = ~(np.abs(fresh) <= FURTHEST).all(axis=(1, 2))
    if bad.any():
        return int(np.argmax(bad))
    moving = np.arange(table.moving)
    before, old = table.place[moving], table.poses[moving, :, :3]
    table.poses[moving] = fresh
    table.put(moving)
    # The spectral norm of the difference of two rotations is its Frobenius norm by the root of 2.
    turned = np.sqrt(((fresh[:, :, :3] - old) ** 2).sum(axis=(1, 2)) / 2)
    shifted = np.sqrt(((table.place[moving] - before) ** 2).sum(axis=1))
    table.travel[moving] += shifted + table.radius[moving] * turned
    return GONE_TOO_FAR if (table.travel[moving] > LONGEST_TRAVEL).any() else PLACED


def near(table: Table, reach: float, allowed: Flags | None = None) -> tuple[Indices, Floats]:
    """Return the pairs that may be within ``reach`` [m] of each other.

    Only active pieces of pairs of bodies that are looked at, or ``allowed``, (B, B), of which one moves; no
    pair is missing whose distance, when it was or would be measured, is at most ``reach``.

    Returns
    -------
    pairs, lows
        (K, 2) pieces, the smaller number first, in no particular order; (K,) lower bounds of distances [m].
    """
    low, high = table.low[:, table.axis], table.high[:, table.axis]
    order = np.argsort(low, kind="stable").astype(np.int32)
    order = order[table.active[order] == 1]
    ends = np.searchsorted(low[order], high[order] + reach, side="right")
    counts = np.maximum(ends - np.arange(len(order)) - 1, 0)
    first = np.repeat(np.arange(len(order)), counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    ones, others = order[first], order[first + step]
    ones, others = np.minimum(ones, others), np.maximum(ones, others)
    looked_at = table.allowed if allowed is None else allowed
    keep = (looked_at[table.body[ones], table.body[others]] == 1) & (ones < table.moving)
    ones, others = ones[keep], others[keep]
    gaps = np.maximum(table.low[ones] - table.high[others], table.low[others] - table.high[ones])
    keep = (np.maximum(gaps, 0.0) ** 2).sum(axis=1) <= reach * reach
    ones, others = ones[keep], others[keep]
    lows = table.lower_bounds(ones, others)
    keep = lows <= reach
    return np.stack([ones[keep], others[keep]], axis=1), lows[keep]


def rank(table: Table, pairs: Indices, distances: Floats, radius: float) -> npt.NDArray[np.int64]:
    """Return which pairs are the nearest ones of their bodies and within a radius [m], nearest first.

    Of equal distances that of the pieces, and then of the bodies, comes first that was there first.

    Parameters
    ----------
    pairs, distances
        (K, 2) pieces and (K,) how far apart they are [m].
    """
    owners = table.body[pairs]
    low, high = owners.min(axis=1, initial=len(table.allowed)), owners.max(axis=1, initial=0)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], high, low, distances))
    order = order[: np.searchsorted(distances[order], radius, side="right")]
    bodies = low[order].astype(np.int64) * len(table.allowed) + high[order]
    leading = np.unique(bodies, return_index=True)[1]
    return np.asarray(order[np.sort(leading)])


def gather(
    table: Table, pairs: Indices, distances: Floats, witnesses: Floats, order: npt.NDArray[np.int64]
) -> tuple[Indices, Indices, Floats, Floats]:
    """Return pieces (K, 2), their bodies (K, 2), distances and witnesses in an order.

    The first body of each pair is before the other in the model.
    """
    pairs, distances, witnesses = pairs[order], distances[order], witnesses[order]
    owners = table.body[pairs]
    turned = owners[:, 0] > owners[:, 1]
    pairs[turned], owners[turned] = pairs[turned, ::-1], owners[turned, ::-1]
    backwards = witnesses[turned]
    witnesses[turned] = np.hstack([backwards[:, 3:6], backwards[:, :3], -backwards[:, 6:]])
    return pairs, owners, distances, witnesses
