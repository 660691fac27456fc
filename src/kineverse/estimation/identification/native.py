"""The solver in C, compiled in the background and kept like compiled functions.

Until then, and without a compiler, numpy takes the same steps.
"""

from __future__ import annotations

import ctypes
import hashlib
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kineverse.compile.cache import library_cache
from kineverse.compile.toolchain import CLOSED, toolchain
from kineverse.compile.worker import Build, request

from .groups import PITCHES, REACH, GroupMotion
from .motion import Linear, Member
from .native_source import SOLVE
from .observations import Observations
from .rigid import Array, pose
from .solving import CLOSE, CLOSE_ENOUGH, FIRST_STEPS, STEPS, Belief, Solution, Start, solve, solve_first

# Numbers of its own, that need not agree with those of an interpreter to the last bit.
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-rounding-math", "-lm", *CLOSED)
_COUNTS = ("count", "rows", "joints", "lefts", "rights", "pitched", "reach", "known", "marginal")
_ARRAYS = ("parent", "child", "parent_covariance", "child_covariance")


class _Problem(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_int64 * 6) for name in ("joint", "left", "right")),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
        *((name, ctypes.c_double) for name in ("reach_scale", "pitch_scale", "close")),
        *((name, ctypes.c_double * 6) for name in ("mean", "precision")),
    )


class SolverLibrary:
    """The compiled solver, once there is one; for the whole process."""

    def __init__(self) -> None:
        self._code: Any = None
        self._build: Build | None = None
        self._hopeless = False
        self._lock = threading.Lock()

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return self._code is not None

    @property
    def code(self) -> Any:
        """The compiled functions, or None."""
        return self._code

    def prepare(self, wait: bool = False) -> bool:
        """Take it from the cache or have it compiled in the background; return whether it is there."""
        if self._code is not None:
            return True
        with self._lock:
            if self._build is None and self._code is None:
                self._build = self._seek()
            build = self._build
        if wait and build is not None:
            build.wait(None)
            self._built(build)
        return self.is_native

    def _seek(self) -> Build | None:
        compiler = None if self._hopeless else toolchain()
        if compiler is None:
            self._hopeless = True
            return None
        key = hashlib.sha256(repr((SOLVE, _FLAGS, compiler.identity)).encode()).hexdigest()[:40]
        path = library_cache().find(key)
        if path is not None:
            self._load(path)
            return None
        return request(key, compiler, lambda: SOLVE, _FLAGS, self._built)

    def _built(self, build: Build) -> None:
        if build.path is not None and self._code is None:
            self._load(build.path)
        self._hopeless = self._code is None and not build.forgotten
        self._build = None

    def _load(self, path: str) -> None:
        try:
            code = ctypes.CDLL(path)
        except OSError:
            self._hopeless = True
            return
        pointer = ctypes.c_void_p
        counter = ctypes.c_int64
        code.solve.argtypes = (pointer, counter, *(pointer,) * 3, counter, counter, *(pointer,) * 6)
        code.solve.restype = ctypes.c_int64
        code.alone.argtypes = (*(counter,) * 3, ctypes.c_double, *(pointer,) * 5)
        code.widths.argtypes = (counter, counter, *(pointer,) * 3, counter, *(pointer,) * 3)
        code.alone.restype = code.widths.restype = ctypes.c_double
        self._code = code

    def solve(
        self,
        seen: Observations,
        motion: Member,
        values: Array,
        parent: Array | None = None,
        belief: Belief | None = None,
        steps: int = STEPS,
    ) -> Solution[Member]:
        """Do what :func:`.solving.solve` does."""
        if self._code is None or not isinstance(motion, GroupMotion):
            return solve(seen, motion, values, parent, belief, steps)
        return self._settled(seen, [(motion, values)], parent, belief, steps)

    def solve_first(self, seen: Observations, starts: Sequence[Start]) -> Solution[Member]:
        """Do what :func:`.solving.solve_first` does."""
        groups = [(s.motion, s.values) for s in starts if isinstance(s.motion, GroupMotion)]
        if self._code is None or len(groups) < len(starts):
            return solve_first(seen, starts)
        return self._settled(seen, groups, None, None, STEPS)

    def _settled(
        self,
        seen: Observations,
        starts: Sequence[tuple[GroupMotion, Array]],
        parent: Array | None,
        belief: Belief | None,
        steps: int,
    ) -> Solution[Member]:
        motion = starts[0][0]
        count, rows, joints, size = len(seen), seen.rows, motion.joints, motion.size
        belief = belief or Belief.vague(joints)
        moved = np.array([_packed(start) for start, _ in starts])
        values = np.array([v for _, v in starts], dtype=np.float64, order="C")
        parents = np.array(seen.parent if parent is None else parent, order="C")
        cost = ctypes.c_double()
        residuals, covariances = np.empty((count, rows)), np.empty((count, rows, rows))
        poses = np.zeros((count, 4, 4))
        poses[:, 3, 3] = 1.0
        linear = Linear(poses, np.empty((count, rows, size)), np.empty((count, rows, joints)))
        problem = _problem(seen, motion, belief)
        converged = self._code.solve(
            ctypes.addressof(problem),
            len(starts),
            moved.ctypes.data,
            values.ctypes.data,
            parents.ctypes.data,
            FIRST_STEPS,
            steps,
            ctypes.addressof(cost),
            *(array.ctypes.data for array in (residuals, covariances, *linear)),
        )
        if converged < 0:
            raise MemoryError("There is no memory for so many observations.")
        settled = converged == 1
        motion = _unpacked(motion, moved[0])
        return Solution(
            motion, values[0], cost.value, residuals, covariances, linear, parents, belief, settled
        )


def _packed(motion: GroupMotion) -> Array:
    """Return what C knows of a member: rotation and place of both sides, and the pitch."""
    result = np.empty(25)
    for at, side in ((0, motion.left), (12, motion.right)):
        result[at : at + 9] = side[:3, :3].ravel()
        result[at + 9 : at + 12] = side[:3, 3]
    result[24] = motion.pitch
    return result


def _unpacked(motion: GroupMotion, packed: Array) -> GroupMotion:
    left, right = (pose(packed[at : at + 9].reshape(3, 3), packed[at + 9 : at + 12]) for at in (0, 12))
    return replace(motion, left=left, right=right, pitch=float(packed[24]))


def _problem(seen: Observations, motion: GroupMotion, belief: Belief) -> _Problem:
    freedom = motion.freedom
    problem = _Problem()
    problem.count, problem.rows, problem.joints = len(seen), seen.rows, motion.joints
    problem.lefts, problem.rights = len(freedom.left), len(freedom.right)
    problem.pitched, problem.reach = motion.group.pitch, motion.group.reach
    problem.known = seen.parent_covariance is None
    for name, components in (("joint", freedom.joints), ("left", freedom.left), ("right", freedom.right)):
        getattr(problem, name)[: len(components)] = components
    for name in _ARRAYS:
        array = getattr(seen, name)
        setattr(problem, name, None if array is None else array.ctypes.data)
    close = CLOSE_ENOUGH if belief.marginal else CLOSE
    problem.reach_scale, problem.pitch_scale, problem.close = REACH, PITCHES, close
    problem.marginal = belief.marginal
    problem.mean[: motion.joints] = belief.mean.tolist()
    problem.precision[: motion.joints] = belief.precision.tolist()
    return problem


solver = SolverLibrary()
