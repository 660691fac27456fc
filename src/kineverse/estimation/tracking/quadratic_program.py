"""Goldfarb-Idnani dual method for small bounded QPs.

It starts at the unconstrained minimum and adds violated bounds one by one, so most calls end at once
(Goldfarb and Idnani, A numerically stable dual method for solving strictly convex quadratic programs, 1983).
"""

from __future__ import annotations

import numpy as np

from kineverse.lie import Array

_LEAST = 1e-12


def solve_bounded_qp(
    inverse: Array, gradient: Array, rows: Array, lower: Array, upper: Array
) -> Array | None:
    """Minimise ½xᵀAx + gᵀx subject to lower <= rows x <= upper; return None if it is infeasible."""
    x = -inverse @ gradient
    normals = np.concatenate([rows, -rows])
    bounds = np.concatenate([lower, -upper])
    scale = _LEAST * (1.0 + np.where(np.isfinite(bounds), np.abs(bounds), 0.0))
    active: list[int] = []
    multipliers = np.empty(0)
    for _ in range(100 * len(bounds) + 100):
        slack = normals @ x - bounds
        slack[active] = 0.0
        worst = int(np.argmin(slack + scale)) if len(slack) else -1
        if worst < 0 or slack[worst] >= -scale[worst]:
            return x
        normal, added = normals[worst], 0.0
        while True:
            held = normals[active]
            direction = inverse @ normal
            if active:
                relation = np.linalg.lstsq(held @ inverse @ held.T, held @ direction, rcond=None)[0]
                direction = direction - inverse @ held.T @ relation
            else:
                relation = np.empty(0)
            along = float(direction @ normal)
            blocking = [
                (m / r, k) for k, (m, r) in enumerate(zip(multipliers, relation, strict=True)) if r > _LEAST
            ]
            partial, leaving = min(blocking, default=(np.inf, -1))
            is_free = along > _LEAST * float(normal @ inverse @ normal)
            full = -(float(normal @ x) - bounds[worst]) / along if is_free else np.inf
            step = min(partial, full)
            if not np.isfinite(step):
                return None
            if is_free:
                x = x + step * direction
            multipliers = multipliers - step * relation
            added += step
            if full <= partial:
                active.append(worst)
                multipliers = np.append(multipliers, added)
                break
            del active[leaving]
            multipliers = np.delete(multipliers, leaving)
    return None
