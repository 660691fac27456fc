"""Search for configurations by Gauss-Newton steps: the parts of inverse kinematics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kineverse.errors import NoSolutionError
from kineverse.lie import Array

from .command import SATURATED
from .position_program import PositionProgram
from .qp import QpSolver

if TYPE_CHECKING:
    from .clearance import Clearance

STEPS, _CLEARING_STEPS, _LAST_STEPS = 40, 60, 200
_PATIENCE = 5  # number of steps after which the errors have to be smaller
PROGRESS = 0.9**2
_SETTLED, _SHORTEST = 1 - 1e-9, 1e-7
_HALVINGS, _APPROACHES = 8, 8
_COLLIDING = 1e9  # smallest penalty of an overlap, above all weighted sums of squares
_EXACT_WEIGHT = 1e4  # weight of equalities and violated constraints, relative to goals that are out of reach


class SearchEnd(NamedTuple):
    """End of a search: coordinates, and the weighted sum of squares there."""

    coordinates: Array
    error: float


class ConfigurationSearch:
    """Present coordinates of a program, and steps that change them."""

    def __init__(self, program: PositionProgram, clearance: Clearance | None) -> None:
        self.program, self.clearance, self.space = program, clearance, program.space
        self._run = program.function.bind()
        self.outputs = self._run.outputs
        n, first = len(program.coordinates), len(program.inputs)
        self.x = self._run.input[:n]
        self.constants = self._run.input[:first]
        self.weights = self._run.input[first:]
        self._solver = QpSolver(n, len(program.names) - n)
        self.rows: dict[str, slice] = {}
        self.exact = np.ones(len(program.weights), dtype=bool)
        start = 0
        for part in program.parts:
            self.rows[part.name] = rows = slice(start, start + part.error.size)
            self.exact[rows] = part.exact
            start = rows.stop
        self.first_violation = start
        self.iterations = 0

    def evaluate(self) -> float:
        """Evaluate the program; return the weighted sum of squares, inf where it is undefined."""
        try:
            self._run()
        except NoSolutionError:
            return math.inf
        total: float = self.outputs[6].item()
        return total if total < math.inf else math.inf

    def is_done(self) -> bool:
        """Evaluate the program; return whether all tasks are done."""
        return self.evaluate() < math.inf and self.outputs[7].item() <= 1.0

    def enter_limits(self) -> None:
        """Bring coordinates that are outside of their limits to the nearest one."""
        if self.evaluate() < math.inf:
            self.x -= self.outputs[5][self.first_violation :][: len(self.x)]
        else:
            self.space.clip(self.x)

    def descend(self, steps: int, ratio: float) -> float:
        """Take Gauss-Newton steps; return 0 if all tasks are done, else the weighted sum of squares.

        Ends as well when the sum is more than ``ratio`` times that of five steps ago.
        """
        x, solve, normalize = self.x, self._solver.solve, self.space.normalize
        H, f, A, lower, upper, _, _, excess = self.outputs
        quaternions = bool(self.space.quaternions)
        recent = [math.inf] * _PATIENCE
        before, step = x.copy(), None
        total = math.inf
        for k in range(steps):
            self.iterations += 1
            total = self.evaluate()
            if total == math.inf:
                if step is None:
                    return math.inf
                total = self._halve(before, step)
                if total == math.inf:
                    x[:] = before
                    return recent[(k - 1) % _PATIENCE]
            if excess.item() <= 1.0:
                return 0.0
            if not total <= ratio * recent[k % _PATIENCE]:
                break
            recent[k % _PATIENCE] = total
            result = solve(H, f, A, lower, upper)
            if result.status != "solved":
                break
            before[:] = x
            step = result.x
            x += step
            if quaternions:
                normalize(x)
        return total

    def _halve(self, before: Array, step: Array) -> float:
        """Halve a step that leads out of the domain of a closed loop."""
        for k in range(1, _HALVINGS + 1):
            self.x[:] = before + step / 2**k
            self.space.normalize(self.x)
            total = self.evaluate()
            if total < math.inf:
                return total
        return math.inf

    def approach(self, home: Array, end: Array, generator: np.random.Generator) -> None:
        """Search the best point: equalities and constraints first, then goals as far as these allow.

        It starts at the end of a search, at a home state and at random, until two points satisfy the
        constraints. If none does, all of them have weights at the first start.
        """
        x, exact_only = self.x, np.where(self.exact, 1.0, 0.0)
        best = SearchEnd(end, math.inf)
        satisfied = 0
        for k in range(_APPROACHES):
            x[:] = end if k == 0 else home if k == 1 else self.space.draw(generator, home)
            self.enter_limits()
            self.weights[:] = exact_only
            if self.descend(STEPS, PROGRESS) > 0.0:
                continue
            satisfied += 1
            self._minimize_within()
            if self.descend(STEPS, PROGRESS) == 0.0:
                self.weights[:] = 1.0
                total = self.evaluate()
                if total < best.error:
                    best = SearchEnd(x.copy(), total)
            if satisfied == 2:
                break
        x[:] = best.coordinates
        if best.error == math.inf:
            self._minimize_within()
        self.weights[:] = 1.0
        if self.clearance is not None:
            self.clear()

    def _minimize_within(self) -> None:
        """Minimize with large weights of equalities and violations; then leave the weights to these alone."""
        self.weights[:] = np.where(self.exact, _EXACT_WEIGHT, 1.0)
        self._minimize()
        self.weights[:] = np.where(self.exact, 1.0, 0.0)

    def _minimize(self) -> None:
        """Take steps that reduce the weighted sum of squares, with as much damping as that needs.

        Far from all solutions, curvature that a Gauss-Newton step leaves out exceeds the damping by the error
        (Levenberg-Marquardt method).
        """
        x = self.x
        H, f, A, lower, upper, *_ = self.outputs
        best, least, damping = x.copy(), self.evaluate(), 0.0
        for _ in range(_LAST_STEPS):
            self.iterations += 1
            if least == math.inf:
                return
            H.reshape(-1)[:: len(x) + 1] += damping
            result = self._solver.solve(H, f, A, lower, upper)
            if result.status != "solved":
                return
            x += result.x
            self.space.normalize(x)
            total = self.evaluate()
            if total < least:
                settled = total > _SETTLED * least
                best[:], least, damping = x, total, damping / 3
                if settled:
                    return
            else:
                if np.abs(result.x).max() < _SHORTEST:
                    break
                x[:], damping = best, max(4 * damping, 0.01 * least)
                self.evaluate()
        x[:] = best

    def clear(self) -> float:
        """Leave collisions while the tasks are kept; return 0 if that succeeds.

        Else return the weighted sum of squares if the bodies are apart, and more than that if they are not.
        """
        clearance, x = self.clearance, self.x
        assert clearance is not None
        H, f, A, lower, upper, _, _, excess = self.outputs
        last = x.copy()
        for _ in range(_CLEARING_STEPS):
            self.iterations += 1
            if self.evaluate() == math.inf:
                x[:] = last
                break
            depth = clearance.measure(x)
            if depth == 0.0 and excess.item() <= 1.0:
                return 0.0
            step = clearance.find_step(H, f, A, lower, upper)
            if step is None:
                break
            last[:] = x
            x += step
            self.space.normalize(x)
        depth, total = clearance.measure(x), self.evaluate()
        if depth == 0.0:
            return 0.0 if excess.item() <= 1.0 else total
        return _COLLIDING + depth

    def residuals(self) -> dict[str, float]:
        """Return the norm of the errors of each task and equality, and the violations of keeps."""
        self.evaluate()
        values = self.outputs[5]
        # Unlike numpy's norm, hypot does not overflow.
        result = {name: math.hypot(*values[rows].tolist()) for name, rows in self.rows.items()}
        violations = values[self.first_violation :]
        for keep in self.program.keeps:
            rows = [k for k, names in enumerate(self.program.names) if keep in names]
            result[keep] = max((abs(float(violations[k])) for k in rows), default=0.0)
        return result

    def active(self) -> tuple[str, ...]:
        """Return the names of the constraints whose multipliers are not 0 at the present coordinates."""
        self.weights[:] = np.where(self.exact, _EXACT_WEIGHT, 1.0)
        if self.evaluate() == math.inf:
            return ()
        result = self._solver.solve(*self.outputs[:5])
        sizes = np.abs(result.multipliers)
        order = sorted(np.flatnonzero(sizes > SATURATED).tolist(), key=lambda k: -float(sizes[k]))
        return tuple(dict.fromkeys(name for k in order for name in self.program.names[k]))
