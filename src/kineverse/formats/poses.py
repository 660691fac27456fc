"""Products and inverses of constant poses, in plain numbers."""

from __future__ import annotations

from kineverse.formats.rpy import snap
from kineverse.model.body import Pose, Vector3

IDENTITY = Pose()
_SAME = 1e-12


def product(a_T_b: Pose, b_T_c: Pose) -> Pose:
    """Return a_T_c."""
    if b_T_c is IDENTITY:
        return a_T_b
    if a_T_b is IDENTITY:
        return b_T_c
    m, n = a_T_b.rows, b_T_c.rows
    rows: list[float] = []
    for i in (0, 4, 8):
        a, b, c, p = m[i : i + 4]
        rows += [snap(a * n[j] + b * n[4 + j] + c * n[8 + j]) for j in range(3)]
        rows.append(a * n[3] + b * n[7] + c * n[11] + p)
    return Pose(tuple(rows))


def inverse(a_T_b: Pose) -> Pose:
    """Return b_T_a."""
    if a_T_b is IDENTITY:
        return a_T_b
    a, b, c, x, d, e, f, y, g, h, i, z = a_T_b.rows
    return Pose(
        (
            *(a, d, g, -(a * x + d * y + g * z)),
            *(b, e, h, -(b * x + e * y + h * z)),
            *(c, f, i, -(c * x + f * y + i * z)),
        )
    )


def rotated(a_T_b: Pose, b_v: Vector3) -> Vector3:
    """Return a_v, a direction in the axes of a."""
    a, b, c, _, d, e, f, _, g, h, i, _ = a_T_b.rows
    x, y, z = b_v
    return (snap(a * x + b * y + c * z), snap(d * x + e * y + f * z), snap(g * x + h * y + i * z))


def is_identity(pose: Pose) -> bool:
    """Return whether a pose is none, but for rounding on the way there."""
    return all(abs(a - b) <= _SAME for a, b in zip(pose.rows, IDENTITY.rows, strict=True))
