"""Manifold of configurations: holds and closures as equations, with Newton's step onto it."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compilation.vector_program import VectorProgram
from kineverse.control.tasks import Hold, look_at
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression
from kineverse.expressions.functions import maximum, sqrt
from kineverse.expressions.gradient import stack_columns
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.spatial import as_transform, inverse, log_so3
from kineverse.state import State
from kineverse.symbols import Symbol, parameter

from .bindings import ProjectionStruct, planning_functions
from .collision_checker import CollisionChecker
from .collision_geometry import Floats32

TOLERANCE = 1e-4  # largest residual of a projection in float [m], [rad]
EXACT = 1e-9  # largest residual of a polished configuration [m], [rad]
DEVIATION = 8e-6  # largest residual half way between two points of a polished path [m], [rad]
_MOST_POINTS = 50_000  # number of points that polishing may add to a path
_STEPS, _POLISHING = 8, 12
_DAMPING = 1e-5  # damping of Newton's step where rows depend on each other [m²], [rad²]
_ROWS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False, repr=False)
class FrameHold(Hold):
    """Hold of two frames of a model by each other, see :meth:`.Planner.hold`.

    Attributes
    ----------
    frames
        Names of both frames; what carries them may touch while the hold lasts.

    See Also
    --------
    kineverse.planning.Planner.hold
    """

    frames: tuple[str, str] = field(default=("", ""), kw_only=True)


def hold_frames(
    model: ModelView, a: str, b: str, mask: str = "xyz rx ry rz", offset: ExpressionLike | None = None
) -> FrameHold:
    """Make the hold of a frame by another one in some directions."""
    rows = mask.replace(",", " ").split()
    names = [r for part in rows for r in ([part] if part in _ROWS else part)]
    if not names or len(set(names)) < len(names) or not set(names) <= set(_ROWS):
        raise InvalidValueError(f"mask= lists some of {', '.join(_ROWS)}, as 'xyz rx ry', not {mask!r}.")
    world_T_b = model.fk(b)
    world_T_held = world_T_b if offset is None else world_T_b @ as_transform(offset)
    held_T_a = inverse(world_T_held) @ model.fk(a)
    parts = [held_T_a[i, 3] for i, name in enumerate("xyz") if name in names]
    turns = [i for i, name in enumerate(_ROWS[3:]) if name in names]
    if len(turns) == 2:
        # The free axis of a points where that of b does: no singularity at half a turn about it.
        (axis,) = {0, 1, 2}.difference(turns)
        turn = look_at(np.eye(4), held_T_a[:3, axis], np.eye(3)[axis])
        parts += [turn[i] for i in turns]
    elif turns:
        vector = log_so3(held_T_a[:3, :3])
        parts += [vector[i] for i in turns]
    return FrameHold(array(parts), 0.0, name=f"{a} on {b}", frames=(a, b))


class Manifold:
    """Configurations at which some expressions are zero."""

    def __init__(
        self,
        checker: CollisionChecker,
        model: ModelView,
        holds: Sequence[Hold],
        equalities: Sequence[Expression] = (),
    ) -> None:
        self._checker, self._code = checker, planning_functions()
        symbols = checker.coordinates
        # Targets that are numbers are parameters, so that another target is the same program.
        self._targets: list[Symbol] = []
        errors = [e for hold in holds for e in self._rows_of(model, hold)]
        self.rows = as_expression(array([*errors, *equalities]))
        gradient = self.rows.gradient(heuristic=False)
        jacobian = stack_columns([gradient.get(s.derivative()) for s in symbols], self.rows.shape)
        for hold in holds:
            moved = {s.position for s in model.rates.resolve(hold.error).gradient(heuristic=False)}
            if moved.isdisjoint(symbols):
                raise InvalidValueError(f"{hold!r} depends on nothing that the planner moves.")
        # A coordinate that stands still, or stays at its limit, has no column.
        free = [parameter(f"planning/free/{i}", 1.0) for i in range(len(symbols))]
        outputs = [newton_step(self.rows, jacobian * array(free)), largest(self.rows)]
        result = {s for e in outputs for s in e.symbols} - {*symbols, *free, *self._targets}
        self._others = tuple(sorted(result, key=lambda s: s.sort_key))
        self.parameters = (*self._others, *self._targets)
        self._program = VectorProgram(outputs, (*symbols, *free), self.parameters, scalar="float")
        self._exact = VectorProgram(outputs, (*symbols, *free), self.parameters, scalar="double")
        # Both are compiled at the same time.
        self._exact.request()
        nothing = np.zeros(len(self.parameters))
        self._kept, self._exact_kept = self._program.prepare(nothing), self._exact.prepare(nothing)
        self.targets = hold_targets(holds)
        self._state: State | None = None
        self.struct = ProjectionStruct(
            self._program.compute_address, self._kept.ctypes.data, self._program.stored, TOLERANCE, _STEPS,
            self._exact.compute_address, self._exact_kept.ctypes.data, self._exact.stored, EXACT,
        )  # fmt: skip

    def _rows_of(self, model: ModelView, hold: Hold) -> list[Expression]:
        if not _is_number(hold):
            return [model.rates.resolve(e) for e in hold.error.ravel()]
        targets = [
            parameter(f"planning/target/{len(self._targets) + k}", 0.0) for k in range(hold.expression.size)
        ]
        self._targets += targets
        entries = hold.expression.ravel()
        return [model.rates.resolve(e) - t for e, t in zip(entries, targets, strict=True)]

    @property
    def address(self) -> int:
        """Address of :attr:`struct`, valid as long as this object."""
        return ctypes.addressof(self.struct)

    def place(self, state: State, targets: Array) -> None:
        """Set the values of everything else that the holds depend on."""
        if state is self._state and np.array_equal(targets, self.targets):
            return
        self._state, self.targets = state, targets
        values = np.concatenate([state.vector(self._others), targets])
        self._program.prepare(values, self._kept)
        self._exact.prepare(values, self._exact_kept)

    def project(self, Q: Floats32) -> npt.NDArray[np.bool_]:
        """Project configurations (N, n) in place; return flags (N,) of those that converge within limits."""
        arrived = np.zeros(len(Q), dtype=np.uint8)
        self._code.kineverse_project(
            self._checker.address, self.address, Q.ctypes.data, len(Q), arrived.ctypes.data
        )
        return arrived.astype(bool)

    def polish(self, Q: Array) -> tuple[Array, Array]:
        """Return configurations (N, n) projected in double precision, within limits, and residuals (N,)."""
        return self._polish(Q, _POLISHING)

    def residuals(self, Q: Array) -> Array:
        """Return the largest residual (N,) of configurations (N, n) [m], [rad]."""
        return self._polish(Q, 0)[1]

    def _polish(self, Q: Array, steps: int) -> tuple[Array, Array]:
        x = np.array(Q, dtype=float, order="C")
        residuals = np.zeros(len(x))
        self._code.kineverse_polish(
            self._checker.address, self.address, x.ctypes.data, len(x), steps, residuals.ctypes.data
        )
        return x, residuals

    def refine(self, points: npt.NDArray[np.floating[Any]]) -> Array | None:
        """Return a polyline (N, n) in double on the manifold, so dense that lines between points keep to it.

        Half way between two points the residual is at most :data:`DEVIATION`. None if a point does not
        converge within limits.
        """
        work = np.empty((len(points) + _MOST_POINTS, points.shape[1]))
        work[: len(points)] = points
        buffer = work.ctypes.data, len(points), len(work)
        count = self._code.kineverse_refine(
            self._checker.address, self.address, *buffer, _POLISHING, DEVIATION
        )
        return None if count < 0 else work[:count].copy()


def hold_targets(holds: Sequence[Hold]) -> Array:
    """Return the numeric targets of holds, one after the other."""
    result = [np.zeros(0)]
    for hold in holds:
        if _is_number(hold):
            value = hold.target if isinstance(hold.target, int | float) else as_expression(hold.target)({})
            result.append(np.full(hold.expression.shape, value, dtype=float).ravel())
    return np.concatenate(result)


def _is_number(hold: Hold) -> bool:
    return isinstance(hold.target, int | float) or not as_expression(hold.target).symbols


def manifold_key(holds: Sequence[Hold]) -> tuple[object, ...]:
    """Return the key of a manifold's program, which holds with other numeric targets share."""
    return tuple((hold.expression, None if _is_number(hold) else hold.target) for hold in holds)


def newton_step(rows: Expression, jacobian: Expression) -> Expression:
    """Return the damped step -Jᵀ (J Jᵀ + λ)⁻¹ r that brings rows r (k,) with the Jacobian (k, n) to zero."""
    k = rows.size
    gram = jacobian @ jacobian.T
    entries = [[gram[i, j] + (_DAMPING if i == j else 0.0) for j in range(k)] for i in range(k)]
    L: list[list[Expression]] = [[as_expression(0.0)] * k for _ in range(k)]
    for i in range(k):
        for j in range(i + 1):
            left = entries[i][j] - sum((L[i][m] * L[j][m] for m in range(j)), as_expression(0.0))
            L[i][j] = as_expression(sqrt(left) if i == j else left / L[j][j])
    y: list[Expression] = []
    for i in range(k):
        y.append((rows[i] - sum((L[i][m] * y[m] for m in range(i)), as_expression(0.0))) / L[i][i])
    for i in reversed(range(k)):
        y[i] = (y[i] - sum((L[m][i] * y[m] for m in range(i + 1, k)), as_expression(0.0))) / L[i][i]
    return -(jacobian.T @ array(y))


def largest(rows: Expression) -> Expression:
    """Return the largest magnitude of rows (k,)."""
    result = abs(rows[0])
    for k in range(1, rows.size):
        result = as_expression(maximum(result, abs(rows[k])))
    return result
