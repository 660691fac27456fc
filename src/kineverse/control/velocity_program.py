"""Quadratic program of one control step, as one compiled function of the state.

Over the speeds v and the progress s in [0, 1] of each hold::

    minimise    Σ w |J v - r|²                      goals
              + Σ w_r |a·v + k x|²                  recovery of violated rows, x the violation
              + Σ (c_i d + Δt Σ κ_i w|g e|) v_i²    damping, larger where goals are far (Sugihara 2011)
              + Σ c_i (m (v_i - v_i⁻)² + j (v_i - 2 v_i⁻ + v_i⁻⁻)²)      smoothness, jerk
              + Σ c_i p (v_i - g (q_i* - q_i))²     posture, while goals are not reached
              + w_s (1 - s)²                        progress
    subject to  J v = -k s e                        holds
                lower <= [v; A v] <= upper          velocity rows, keeps, accelerations, contacts

The damping by |g e| bounds the second derivative of the errors, Δt |g e| |∂J/∂q|, which a linear program
leaves out; κ_i estimates it for each goal, so a goal damps only the speeds that serve it. A goal out of reach
ends at rest, with a stretched arm. w_r and w_s are multiples of the largest diagonal entry of Σ w JᵀJ, so
that neither weights nor units of goals outweigh limits and holds. All rows but those of keeps on speeds and
of accelerations contain 0, and accelerations give way. So v = 0, s = 0 is feasible.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import reduce

import casadi as ca
import numpy as np

from kineverse.compilation import CompiledFunction, compile
from kineverse.compilation.function import WantedTier
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression, binary
from kineverse.expressions.functions import norm
from kineverse.lie import Array
from kineverse.model.velocity_constraints.speed_limits import INFINITE, ZERO, is_infinite, raw_max
from kineverse.symbols import Symbol, parameter

from .formulation import Formulation, GoalRows, HoldRows
from .regularization import Costs, JointWeights

RECOVERY_WEIGHT = 1e3
"""Weight of the recovery of a violated row, as a multiple of the largest weight of goals."""
INWARDS = 1e-3
"""Distance inside of a bound at which recovery aims, so that it ends at the bound and not near it."""
POSTURE_GAIN = 0.5
REACHED = 0.1  # speed by which goals are reached below which the posture fades [unit/s]


class VelocityProgram:
    """Compiled quadratic program of a formulation."""

    def __init__(
        self,
        formulation: Formulation,
        costs: Costs,
        *,
        joint_weights: JointWeights,
        posture: Mapping[Symbol, tuple[float, float]],
        accelerations: Mapping[Symbol, ExpressionLike],
        contacts: int,
        dt: Symbol,
        tier: WantedTier = "auto",
    ) -> None:
        self.formulation = formulation
        self.speeds = speeds = formulation.speeds
        holds = [hold for hold in formulation.holds if hold.name not in joint_weights.immovable]
        # Each hold has a progress of its own, so that one which cannot be corrected stops no other. The
        # equalities of the model share one: they are satisfied together or not at all.
        progresses: dict[str, int] = {}
        for hold in holds:
            progresses.setdefault("" if hold.closure else hold.name, len(progresses))
        n, held = len(speeds), len(progresses)
        self.columns = n + held
        last = [parameter(f"control/last/{s}", 0.0) for s in speeds]
        before = [parameter(f"control/before/{s}", 0.0) for s in speeds] if costs.jerk else []

        diagonal = [ZERO] * n
        hessian: Expression = as_expression(np.zeros((n, n)))
        wanted: Expression = as_expression(np.zeros(n))
        effort = ZERO
        for goal in formulation.goals:
            weighted = goal.jacobian * goal.weight.reshape(goal.weight.size, 1)
            hessian = hessian + weighted.T @ goal.jacobian
            wanted = wanted + weighted.T @ goal.rate
            effort = effort + (goal.weight * goal.rate) @ goal.rate
            if goal.name in joint_weights.curvatures:
                distance = norm(goal.weight * goal.correction)
                for i, curvature in enumerate(joint_weights.curvatures[goal.name]):
                    diagonal[i] = diagonal[i] + curvature * dt * distance
        linear = [-wanted[i] for i in range(n)]
        largest = reduce(raw_max, [hessian[i, i] for i in range(n)], as_expression(1.0))
        rows = formulation.rows
        bounds, general = rows.bounds, rows.general
        for i in range(n):
            violation = bounds.violation[i]
            if violation.symbols:
                weight, rate = _recovery(violation, costs.recovery, largest)
                diagonal[i] = diagonal[i] + weight
                linear[i] = linear[i] - weight * rate
        for k in range(len(general.names)):
            violation = general.violation[k]
            if violation.symbols:
                weight, rate = _recovery(violation, costs.recovery, largest)
                row = general.matrix[k]
                hessian = hessian + weight * (row.reshape(n, 1) @ row.reshape(1, n))
                linear = [linear[i] - weight * rate * row[i] for i in range(n)]
        fade = effort / (effort + REACHED**2 * largest)
        for i, speed in enumerate(speeds):
            share = joint_weights.shares[i]
            diagonal[i] = diagonal[i] + share * (costs.smooth + costs.jerk + costs.damping)
            linear[i] = linear[i] - share * costs.smooth * last[i]
            if before:
                linear[i] = linear[i] - share * costs.jerk * (2 * last[i] - before[i])
            if speed in posture:
                own, middle = posture[speed]
                towards = POSTURE_GAIN * (middle - speed.position)
                diagonal[i] = diagonal[i] + share * own
                linear[i] = linear[i] - share * own * fade * towards
        H = hessian + as_expression(np.diag(array(diagonal)))
        lower, upper = [bounds.lower[i] for i in range(n)], [bounds.upper[i] for i in range(n)]
        names: list[tuple[str, ...]] = list(bounds.names)
        if held:
            progress = costs.progress * largest
            column = as_expression(np.zeros((n, held)))
            corner = as_expression(np.eye(held)) * progress
            H = as_expression(np.block([[H, column], [column.T, corner]]))
            linear += [-progress] * held
            lower += [ZERO] * held
            upper += [as_expression(1.0)] * held
            names += [("progress",)] * held
        matrix: list[Expression] = []
        soft: list[bool] = []
        for hold in holds:
            own_progress = progresses["" if hold.closure else hold.name]
            for k in range(hold.error.size):
                decay = hold.gain * hold.error[k]
                matrix += [*hold.jacobian[k], *(decay if j == own_progress else ZERO for j in range(held))]
                lower.append(ZERO)
                upper.append(ZERO)
                names.append((hold.name,))
                soft.append(False)
        for k, name in enumerate(general.names):
            matrix += [*general.matrix[k], *[ZERO] * held]
            lower.append(general.lower[k])
            upper.append(general.upper[k])
            names.append((name,))
            soft.append(False)
        for i, speed in enumerate(speeds):
            if speed in accelerations:
                change = as_expression(accelerations[speed]) * dt
                matrix += [as_expression(float(i == j)) for j in range(self.columns)]
                lower.append(last[i] - change)
                upper.append(last[i] + change)
                names.append((f"acceleration of {speed.position}",))
                soft.append(True)
        first = len(soft)
        self.contact_rows = slice(first, first + contacts)
        for _ in range(contacts):
            matrix += [ZERO] * self.columns
            lower.append(-INFINITE)
            upper.append(INFINITE)
            soft.append(False)
        self.equalities = frozenset({"progress", *(hold.name for hold in formulation.holds)})
        self.rows = len(soft)
        self.names = tuple(names)
        self.soft = np.array([False] * self.columns + soft)
        shape = self.rows, self.columns
        A = array(matrix).reshape(*shape) if matrix else as_expression(np.zeros(shape))
        f = array(linear)
        finite = [b for b in (*lower, *upper) if not is_infinite(b)]
        check = sum((part.sum() for part in (H, f, A, array([ZERO, *finite])) if part.size), ZERO)
        tasks: tuple[GoalRows | HoldRows, ...] = (*formulation.goals, *formulation.holds)
        residuals = {row.name: norm(row.error) for row in tasks}
        residuals |= {name: self._keep_residual(name) for name in formulation.keeps}
        self.residuals = tuple(residuals)
        about_speeds = [goal for goal in formulation.goals if goal.about_speeds]
        places = [self.residuals.index(goal.name) for goal in about_speeds]
        self.speed_goals = np.array(places, dtype=np.intp)
        self.speed_rows = np.cumsum([0, *(goal.error.size for goal in about_speeds)])[:-1]
        self.function: CompiledFunction[tuple[Array, ...]]
        outputs = [H, f, A, array(lower), array(upper), array(list(residuals.values())), check, largest]
        if about_speeds:
            parts = [g.jacobian for g in about_speeds], [g.rate for g in about_speeds]
            outputs += [as_expression(np.concatenate(part)) for part in parts]
        used = {s for output in outputs for s in output.symbols}
        self.inputs = arrange_inputs(used - {dt, *last, *before})
        self.function = compile(outputs, (*self.inputs, dt, *last, *before), tier=tier)

    def _keep_residual(self, name: str) -> Expression:
        """Return the violation of a keep; 0 for one on speeds, which a command satisfies."""
        rows = self.formulation.rows
        violations = [abs(rows.violation[k]) for k, row in enumerate(rows.names) if row == name]
        return reduce(raw_max, violations, ZERO)


def arrange_inputs(symbols: Iterable[Symbol]) -> tuple[Symbol, ...]:
    """Return symbols in the order of vectors of states: coordinates first, then parameters."""
    return tuple(sorted(symbols, key=lambda s: (s.value is not None, s.sort_key)))


def _recovery(violation: Expression, gain: float, largest: Expression) -> tuple[Expression, Expression]:
    """Return weight and wanted rate of the recovery of a row; the weight is 0 inside of the bounds."""
    outside = binary(ca.OP_NE, violation, 0)
    sign = binary(ca.OP_LT, 0, violation) - binary(ca.OP_LT, violation, 0)
    return RECOVERY_WEIGHT * largest * outside, -gain * (violation + INWARDS * sign)
