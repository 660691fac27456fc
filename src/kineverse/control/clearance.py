"""Steps out of collision for inverse kinematics: contact rows over coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from kineverse.errors import NoSolutionError, UnknownNameError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.gradient import stack_columns
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResult
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .contact_constraints import ContactSlots
from .position_program import PositionProgram
from .qp import QpSolver

_SLOTS, _RADIUS = 24, 0.1
_LONGEST = 0.2  # largest step of a coordinate [m], [rad], since contact rows are valid only nearby
_SAMPLES = 16


class Clearance:
    """Distances of bodies at the coordinates of a program, and steps that increase them.

    Pairs that are nearer than the margin in all of some random states do not count.
    """

    def __init__(self, scene: Scene, program: PositionProgram, margin: float) -> None:
        missing = sorted(str(s) for s in {*program.coordinates} - {*scene.model.symbols})
        if missing:
            raise UnknownNameError(
                f"scene= is the scene of a model without {', '.join(map(repr, missing[:6]))}. Make the scene "
                "of the model of the tasks: Scene(model)."
            )
        self._scene, self._program, self.margin = scene, program, margin
        self._speeds = [s.derivative() for s in program.coordinates]
        try:
            rules = scene.find_always_colliding(self._sample(), margin)
        except NoSolutionError:  # Some of the states are outside of the domain of a closed loop.
            rules = scene.find_always_colliding(margin=margin)
        reach = margin + _RADIUS
        self._contacts = ContactSlots(
            scene, self._speeds, _SLOTS, margin=margin, radius=reach, gain=1.0, twist=self._twist, rules=rules
        )
        self.inputs: Sequence[Symbol] = self._contacts.inputs
        place = {s: k for k, s in enumerate(program.coordinates)}
        self._values = np.zeros(len(self.inputs))
        moved = [k for k, s in enumerate(self.inputs) if s in place]
        self._moved = np.array(moved, dtype=np.intp)
        self._source = np.array([place[self.inputs[k]] for k in moved], dtype=np.intp)
        n, rows = len(program.coordinates), len(program.names) - len(program.coordinates)
        self._n, self._static = n, n + rows
        self._A = np.zeros((rows + _SLOTS, n))
        self._lower, self._upper = np.zeros((2, n + rows + _SLOTS))
        self._H, self._f = np.zeros((n, n)), np.zeros(n)
        self._contacts.bind(self._H, self._f, self._A[rows:], self._lower[n + rows :])
        self._solver = QpSolver(n, rows + _SLOTS)

    def load(self, values: Mapping[Symbol, float]) -> None:
        """Set the values of all inputs."""
        self._values[:] = [values[s] for s in self.inputs]

    def measure(self, coordinates: Array) -> float:
        """Find the near pairs; return by how much the nearest falls short of the margin [m], or 0."""
        self._values[self._moved] = coordinates[self._source]
        self._contacts.update(self._values)
        distances = self._contacts.found.distances
        return max(0.0, self.margin - float(distances[0])) if len(distances) else 0.0

    @property
    def near(self) -> tuple[DistanceResult, ...]:
        """Pairs of the last measurement that are nearer than the margin, each once, nearest first."""
        result = self._contacts.found
        near: dict[tuple[str, str], DistanceResult] = {}
        for k in range(int(np.count_nonzero(result.distances < self.margin))):
            near.setdefault((result[k].a, result[k].b), result[k])
        return tuple(near.values())

    def find_step(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """Return the step of the coordinates that separates the last near pairs; None if there is none."""
        n, static = self._n, self._static
        self._A[: static - n], self._A[static - n :] = A, 0.0
        self._lower[:static], self._lower[static:] = lower, -np.inf
        self._upper[:static], self._upper[static:] = upper, np.inf
        self._lower[:n] = np.maximum(lower[:n], -_LONGEST)
        self._upper[:n] = np.minimum(upper[:n], _LONGEST)
        self._H[:], self._f[:] = H, f
        self._contacts.write(1.0)
        result = self._solver.solve(self._H, self._f, self._A, self._lower, self._upper)
        return result.x if result.status == "solved" else None

    def _twist(self, body: str) -> Expression:
        """Return the spatial twist of a body over the coordinates, (6, n)."""
        pose = self._program.make_plain(self._scene.model.fk(body))
        gradient = pose.gradient(heuristic=False)
        R, p = pose[:3, :3], pose[:3, 3]
        columns: list[Expression | None] = []
        for speed in self._speeds:
            if speed not in gradient:
                columns.append(None)
                continue
            W = gradient[speed][:3, :3] @ R.T
            w = array([W[2, 1], W[0, 2], W[1, 0]])
            columns.append(as_expression(np.concatenate([gradient[speed][:3, 3] + np.cross(p, w), w])))
        return stack_columns(columns, (6,))

    def _sample(self) -> Iterator[State]:
        home, generator = self._scene.model.default_state(), np.random.default_rng(0)
        start = home.vector(self._program.coordinates)
        for _ in range(_SAMPLES):
            q = self._program.space.draw(generator, start)
            yield home | dict(zip(self._program.coordinates, q.tolist(), strict=True))
