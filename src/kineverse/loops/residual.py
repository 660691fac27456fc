"""What is left between two frames that should coincide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression, array

AXES = ("x", "y", "z", "rx", "ry", "rz")


def as_mask(given: Any, name: str) -> tuple[str, ...]:
    """Return a mask, a sequence or text of different names out of :data:`AXES`, as a tuple."""
    mask = tuple(given) if isinstance(given, list | tuple | str) else ()
    if not mask or not all(axis in AXES for axis in mask) or len(set(mask)) < len(mask):
        raise ValueRejectedError(
            f"The mask of loop '{name}' has names out of {', '.join(AXES)}, not {given!r}."
        )
    return mask


def as_ends(given: Any, name: str) -> tuple[tuple[str, str], ...]:
    """Return further pairs of frames that coincide as tuples."""
    pairs = tuple(given) if isinstance(given, list | tuple) else (given,)
    for pair in pairs:
        if not isinstance(pair, list | tuple) or [type(end) for end in pair] != [str, str]:
            raise ValueRejectedError(
                f"Loop '{name}' takes more=((frame, to), ...), pairs of names of frames, not {given!r}."
            )
    return tuple((frame, to) for frame, to in pairs)


def residual_rows(pose: Expression, mask: Sequence[str]) -> dict[str, Expression]:
    """Return the elements of a residual that a mask names: of p [m], and of ½(R - Rᵀ)^∨ [rad].

    Parameters
    ----------
    pose
        to_T_frame = (R, p), 4×4, where the frame coincides with ``to`` if all of it is zero.
    mask
        Names out of :data:`AXES`.
    """
    p, r = pose[:3, 3], pose[:3, :3]
    axis = [(r[2, 1] - r[1, 2]) / 2, (r[0, 2] - r[2, 0]) / 2, (r[1, 0] - r[0, 1]) / 2]
    rows = dict(zip(AXES, [p[0], p[1], p[2], *axis], strict=True))
    return {name: rows[name] for name in mask}


def upright(pose: Expression, mask: Sequence[str]) -> list[Expression]:
    """Return what is positive where the angles that a mask makes zero are not half a turn.

    The sine of an angle is zero there, too.
    """
    turning = [axis for axis in "xyz" if f"r{axis}" in mask]
    if not turning:
        return []
    x, y, z = pose[0, 0], pose[1, 1], pose[2, 2]
    if len(turning) == 3:
        return [x + y + z]
    diagonal = dict(zip("xyz", (x, y, z), strict=True))
    if len(turning) == 2:
        return [diagonal[axis] for axis in "xyz" if axis not in turning]
    return [sum((diagonal[axis] for axis in "xyz" if axis not in turning), array(0.0))]
