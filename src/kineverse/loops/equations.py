"""Loop-closure residual between two frames, and its numeric solution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.expressions.expression import Expression, array
from kineverse.lie import Array
from kineverse.symbols import Symbol

AXES = ("x", "y", "z", "rx", "ry", "rz")


def as_mask(value: Any, name: str) -> tuple[str, ...]:
    """Convert a mask, a sequence or text of distinct names out of :data:`AXES`, to a tuple."""
    mask = tuple(value) if isinstance(value, list | tuple | str) else ()
    if not mask or not all(axis in AXES for axis in mask) or len(set(mask)) < len(mask):
        known = ", ".join(AXES)
        raise InvalidValueError(f"The mask of loop '{name}' has names out of {known}, not {value!r}.")
    return mask


def as_ends(value: Any, name: str) -> tuple[tuple[str, str], ...]:
    """Convert further pairs of frames to tuples."""
    pairs = tuple(value) if isinstance(value, list | tuple) else (value,)
    for pair in pairs:
        if not isinstance(pair, list | tuple) or [type(end) for end in pair] != [str, str]:
            wanted = "more=((frame, to), ...), pairs of names of frames"
            raise InvalidValueError(f"Loop '{name}' takes {wanted}, not {value!r}.")
    return tuple((frame, to) for frame, to in pairs)


def residual_rows(pose: Expression, mask: Sequence[str]) -> dict[str, Expression]:
    """Return the rows of the loop-closure residual: elements of p [m] and of ½(R - Rᵀ)^∨ [rad]."""
    p, r = pose[:3, 3], pose[:3, :3]
    axis = [(r[2, 1] - r[1, 2]) / 2, (r[0, 2] - r[2, 0]) / 2, (r[1, 0] - r[0, 1]) / 2]
    rows = dict(zip(AXES, [p[0], p[1], p[2], *axis], strict=True))
    return {name: rows[name] for name in mask}


def upright_signs(pose: Expression, mask: Sequence[str]) -> list[Expression]:
    """Return expressions that are positive unless a masked angle is half a revolution.

    The sine in the residual is zero there as well.
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


CLOSURE_TOLERANCE = 1e-11  # largest residual of a closed loop during the analysis [m] or [rad]

_NEWTON = 30
_SINGULAR = 1e-9
_WELL_CONDITIONED = 1e10  # condition of JJᵀ or JᵀJ up to which no singular values are needed

MOST_EFFORT = 150_000.0  # budget for the analysis of one loop, about ten seconds; usual loops take a fifth


@dataclass
class WorkBudget:
    """Budget of work for the analysis of a loop, independent of machine and process."""

    name: str  # of the loop
    left: float = MOST_EFFORT  # remaining work; an evaluation of a few equations is 1

    def spend(self, amount: float) -> None:
        """Subtract an amount of work."""
        self.left -= amount
        if self.left < 0:
            raise NoSolutionError(
                f"Loop '{self.name}' is too much work: its branch is not known after {MOST_EFFORT:.0f} "
                "evaluations. Narrow the limits, or close it in parts."
            )


def least_squares(J: Array, r: Array) -> Array:
    """Return the least-squares solution x of Jx = r of least norm, for J (m, n) and r (m,) or (m, k)."""
    tall = J.shape[0] >= J.shape[1]
    product = J.T @ J if tall else J @ J.T
    try:
        inverse = np.linalg.inv(product)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(J, r, rcond=_SINGULAR)[0], dtype=float)
    a, b = product.ravel(), inverse.ravel()  # of their norms, whose product bounds the condition
    if not a.dot(a) * b.dot(b) < _WELL_CONDITIONED**2:
        return np.asarray(np.linalg.lstsq(J, r, rcond=_SINGULAR)[0], dtype=float)
    return np.asarray(inverse @ (J.T @ r) if tall else J.T @ (inverse @ r), dtype=float)


class Equations:
    """Numeric residual r(x, u) with its derivatives."""

    def __init__(
        self, residual: Expression, unknowns: Sequence[Symbol], inputs: Sequence[Symbol], effort: WorkBudget
    ) -> None:
        self.unknowns, self.inputs = tuple(unknowns), tuple(inputs)
        self._effort, self._size = effort, 1 + residual.size * len(self.unknowns) / 100
        by_all = residual.partial([*unknowns, *inputs])
        function = compile([residual, by_all], [*unknowns, *inputs], tier="interpreter")
        self._evaluate, self._batch = function.bind(), function.batch

    def __call__(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return r, ∂r/∂x and ∂r/∂u; r is infinite if they are undefined."""
        self._effort.spend(self._size)
        n = len(self.unknowns)
        self._evaluate.input[:n] = x
        self._evaluate.input[n:] = u
        try:
            self._evaluate()
        except NoSolutionError:
            # An earlier loop, which this one depends on, does not close there.
            m, n_all = self._evaluate.outputs[1].shape
            return np.full(m, np.inf), np.zeros((m, n)), np.zeros((m, n_all - n))
        residual, derivative = self._evaluate.outputs[0].copy(), self._evaluate.outputs[1].copy()
        return residual, derivative[:, :n], derivative[:, n:]

    def evaluate_all(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return r (N, m) and ∂r/∂x (N, m, n) at unknowns (N, n) and inputs (N, k); see :meth:`__call__`."""
        self._effort.spend(len(x) * self._size)
        try:
            residual, derivative = self._batch(np.hstack([x, u]))
        except NoSolutionError:
            m = self._evaluate.outputs[0].size
            return np.full((len(x), m), np.inf), np.zeros((len(x), m, len(self.unknowns)))
        return residual, derivative[..., : len(self.unknowns)]

    def close(self, x: Array, u: Array, steps: int = _NEWTON) -> tuple[Array, float]:
        """Return a solution near x, and the norm of its residual.

        Newton steps that reduce the residual are accepted; otherwise the step is damped (Levenberg,
        Marquardt). So the result is a local minimum of the residual if the loop does not close.
        """
        damping = 0.0
        residual, by_x, _ = self(x, u)
        gap = math.sqrt(residual.dot(residual))
        for _ in range(steps):
            if gap < 1e-15 or gap == np.inf:
                break
            if damping == 0.0:
                step = -least_squares(by_x, residual)
            else:
                matrix = by_x.T @ by_x
                scale = max(float(np.trace(matrix)) / len(x), 1e-30)
                damped = matrix + damping * scale * np.eye(len(x))
                step = -np.asarray(np.linalg.solve(damped, by_x.T @ residual), dtype=float)
            tried = x + step
            after, derivative, _ = self(tried, u)
            left = math.sqrt(after.dot(after))
            if left < gap:
                x, residual, by_x, gap = tried, after, derivative, left
                damping = damping / 10 if damping > 1e-6 else 0.0
            elif gap < CLOSURE_TOLERANCE:
                break
            else:
                damping = max(10 * damping, 1e-4)
                if damping > 1e8:
                    break
        return x, gap


def find_periodic(
    equations: Equations, x: Array, u: Array
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return flags of the unknowns and inputs that are angles, with a residual of period 2π."""
    at = equations(x, u)[0]

    def same(dx: Array, du: Array) -> bool:
        return bool(np.allclose(equations(x + dx, u + du)[0], at, rtol=0, atol=1e-9))

    turn = 2 * np.pi
    no_x, no_u = np.zeros(len(x)), np.zeros(len(u))
    unknowns = [same(turn * e, no_u) for e in np.eye(len(x))]
    inputs = [same(no_x, turn * e) for e in np.eye(len(u))]
    return np.array(unknowns, dtype=bool), np.array(inputs, dtype=bool)
