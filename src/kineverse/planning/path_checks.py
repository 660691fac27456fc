"""Checks of configurations as they were when a path was planned."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock
from kineverse.errors import InvalidValueError
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State

from .collision_checker import RESOLUTION, BodyPairs, CollisionChecker

if TYPE_CHECKING:
    from .manifold import Manifold
    from .state_validity import SceneJudge

_ROUNDING = 1e-6


class PathChecks:
    """Checks of configurations in the surroundings of a path, wherever things are placed now."""

    def __init__(
        self,
        model: ModelView,
        state: State,
        checker: CollisionChecker,
        judge: SceneJudge,
        manifold: Manifold | None,
        touching: BodyPairs,
        restore: Callable[[], None],
        lock: CallLock,
    ) -> None:
        self.model, self.state, self._version = model, state, model.version
        self._checker, self._judge, self._manifold = checker, judge, manifold
        self._targets = None if manifold is None else manifold.targets
        self._touching, self._restore, self._lock = touching, restore, lock

    def clearance(self, points: Array) -> float:
        """Return the least signed distance of bodies along a polyline (N, n) by the scene [m]."""
        self.ensure_current()
        with self._lock:
            self._judge.place(self.state)
            return self._judge.clearance(points, 1 / RESOLUTION)

    def ensure_current(self) -> None:
        """Ensure that the model is the one for which the path was planned."""
        if self.model.version != self._version:
            raise InvalidValueError("The model has been edited since this path was planned. Plan it again.")

    @contextmanager
    def placed(self, points: Array) -> Iterator[None]:
        """Place the checker for a path, with limits about its points (N, n), while the context lasts."""
        checker = self._checker
        with self._lock:
            limits = checker.lower.copy(), checker.upper.copy()
            checker.place(self.state)
            if self._manifold is not None and self._targets is not None:
                self._manifold.place(self.state, self._targets)
            narrow = points.astype(np.float32)
            checker.lower[:] = narrow.min(axis=0) - _ROUNDING
            checker.upper[:] = narrow.max(axis=0) + _ROUNDING
            try:
                with checker.excepting(self._touching):
                    yield
            finally:
                checker.lower[:], checker.upper[:] = limits
                self._restore()

    def valid(self, Q: Array, residual: float) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of configurations (N, n) that are free and meet holds up to a residual."""
        flags = self._checker.valid(np.ascontiguousarray(Q, dtype=np.float32))
        if self._manifold is not None:
            flags &= self._manifold.residuals(Q) <= residual
        return flags

    def find_collision(self, points: Array) -> int | None:
        """Return the first edge of a polyline (N, n) that is not certainly free; None if all are."""
        found = self._checker.find_collision(np.ascontiguousarray(points, dtype=np.float32))
        return None if found is None else found[0]
