"""Updates in C, compiled in the background and kept like compiled functions.

Until then, without a compiler, and where limits are curved, numpy does the same.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import numpy as np

from kineverse.compile import CompiledFunction
from kineverse.compile.source_library import SourceLibrary
from kineverse.estimation.noise import Array

from .belief import Belief, Indices
from .charted import Charted
from .layout import Layout
from .limits import Limits
from .native_motion import MOTION
from .native_quadratic import QUADRATIC
from .native_residual import RESIDUAL
from .native_source import UPDATE
from .reading import RIGID, Reading
from .solving import Found

# What the C has room for.
_MOST_UNKNOWNS, _MOST_NUMBERS = 64, 64

_COUNTS = ("observations", "groups", "coordinates", "directions", "known")
_INDICES = (
    "is_pose", "size", "value", "slope", "seen", "white",
    "first", "place", "own", "first_x", "place_x", "first_watch", "watch", "rates", "step", "first_bend",
)  # fmt: skip
_NUMBERS = ("bend", "period", "lower", "upper", "input", "output", "work", "squares")


class _Problem(ctypes.Structure):
    _fields_ = (
        ("compute", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in (*_INDICES, *_NUMBERS)),
    )


def _declare(code: Any) -> None:
    pointer = ctypes.c_void_p
    code.update.argtypes, code.update.restype = (pointer,) * 8, ctypes.c_int64
    code.predict.argtypes, code.predict.restype = (pointer,) * 4, ctypes.c_int64
    code.first_broken.argtypes = (pointer, pointer, pointer, ctypes.c_double)
    code.first_broken.restype = ctypes.c_int64


native_library = SourceLibrary(QUADRATIC + MOTION + RESIDUAL + UPDATE, _declare)
"""The compiled update, once there is one; for all trackers of the process."""


class NativeSolver:
    """What :class:`.solving.Solver` does for one tracker, in C.

    It has memory of its own, which threads use in turns.

    Parameters
    ----------
    layout, limits, function, charted
        The parts of a tracker.
    """

    def __init__(self, layout: Layout, limits: Limits, function: CompiledFunction, charted: Charted) -> None:
        self._layout, self._limits, self._function, self._charted = layout, limits, function, charted
        count, size, directions = len(layout.groups), len(layout.chart.coordinates), len(layout.chart.tangent)
        self._motions = [charted.motion(number) for number in range(count)]
        bends = [np.empty(0) if motion is None else motion.bends.reshape(-1) for motion in self._motions]
        self._input = np.zeros(len(layout.inputs))
        self._size = size
        widths = [len(group.tangent) for group in layout.groups]
        kept = {
            "is_pose": [one.is_pose for one in layout.observations],
            "size": [one.size for one in layout.observations],
            "value": [where.start for where in layout.value_slices],
            "slope": [where.start for where in layout.slope_slices],
            "seen": [where.start for where in layout.seen_slices],
            "white": [where.start for where in layout.white_slices],
            "first": np.cumsum([0, *widths]),
            "place": np.concatenate([group.t for group in layout.groups]),
            "own": np.concatenate([group.own for group in layout.groups]),
            "first_x": np.cumsum([0, *(len(group.x) for group in layout.groups)]),
            "place_x": np.concatenate([group.x for group in layout.groups]),
            "first_watch": np.cumsum([0, *(len(group.seen) for group in layout.groups)]),
            "watch": [i for group in layout.groups for i in group.seen],
            "rates": np.zeros(count),
            "step": np.zeros(count),
            "first_bend": np.cumsum([0, *map(len, bends)]),
        }
        self._indices: dict[str, Indices] = {name: np.array(v, dtype=np.int64) for name, v in kept.items()}
        self._squares = np.zeros(len(layout.observations))
        self._numbers = {
            "bend": np.concatenate(bends).astype(np.float64),
            "period": np.array([one.period for one in layout.observations]),
            "lower": limits.lower,
            "upper": limits.upper,
            "input": self._input,
            "output": np.zeros(function.shapes[0]),
            "work": np.zeros(sum(3 * len(g.t) + 3 * len(g.t) ** 2 + 2 * len(g.x) for g in layout.groups)),
            "squares": self._squares,
        }
        self._problem = _Problem(
            observations=len(layout.observations),
            groups=count,
            coordinates=size,
            directions=directions,
            known=len(layout.known),
        )
        for name, array in (*self._indices.items(), *self._numbers.items()):
            setattr(self._problem, name, array.ctypes.data)
        self._results = np.zeros((2, count))
        self._motion = np.zeros((2, size))
        # Buffers that stay where they are: asking an array for its address takes longer than copying it.
        self._belief = np.zeros(Belief((size, directions, count)).numbers.shape)
        self._reading = Reading(
            np.zeros(layout.seen_slices[-1].stop),
            np.zeros(len(layout.observations), dtype=bool),
            np.zeros(layout.white_slices[-1].stop),
            np.zeros(len(layout.observations)),
        )
        self._loaded: Reading | None = None
        self._lock = threading.Lock()
        self._where = ctypes.addressof(self._problem)
        self._moved = [row.ctypes.data for row in self._motion]
        self._seen = [array.ctypes.data for array in self._reading]
        self._written = [self._belief.ctypes.data, *self._seen, *(row.ctypes.data for row in self._results)]

    def __reduce__(self) -> Any:
        # Addresses mean something in this process only.
        return NativeSolver, (self._layout, self._limits, self._function, self._charted)

    @staticmethod
    def suits(layout: Layout) -> bool:
        """Whether C can do it: limits of single coordinates only, and not too many of anything."""
        return (
            not layout.limits
            and all(max(len(group.x), len(group.t)) <= _MOST_UNKNOWNS for group in layout.groups)
            and all(one.size <= _MOST_NUMBERS for one in layout.observations)
        )

    @property
    def is_ready(self) -> bool:
        """Whether the update, the model and how it moves are compiled."""
        if native_library.code is None or self._function.address is None:
            return False
        self._problem.compute = self._function.address
        for number, motion in enumerate(self._motions):
            if motion is not None:
                addresses = motion.addresses
                if addresses is None:
                    return False
                self._indices["rates"][number], self._indices["step"][number] = addresses
        return True

    def update(self, belief: Belief, reading: Reading, known: Array) -> Found | None:
        """Do what :meth:`.solving.Solver.update` does for all groups that are seen; None if that is not easy.

        Then numpy finds out why.
        """
        with self._lock:
            self._load(reading)
            self._belief[:] = belief.numbers
            self._input[self._size :] = known
            rounds = native_library.code.update(self._where, *self._written)
            if rounds < 0:
                return None
            nis, dof = self._results.copy()
            after = Belief(belief.sizes, self._belief.copy(), belief.standing)
            return Found(after, nis, dof, rounds, squares=self._squares.copy())

    def predict(self, belief: Belief, moved: Array, grown: Array) -> Belief | None:
        """Return the belief inside the limits after steps and with variances added, both by coordinate.

        None if that is not easy.
        """
        with self._lock:
            self._belief[:] = belief.numbers
            self._motion[0], self._motion[1] = moved, grown
            if native_library.code.predict(self._where, self._written[0], *self._moved) < 0:
                return None
            return Belief(belief.sizes, self._belief.copy(), belief.standing)

    def are_rigid(self, reading: Reading) -> bool:
        """Whether all poses that were seen are rigid; False if that is not known."""
        code = native_library.code
        if code is None:
            return False
        with self._lock:
            self._load(reading)
            return bool(code.first_broken(self._where, *self._seen[:2], RIGID) < 0)

    def _load(self, reading: Reading) -> None:
        if self._loaded is reading:
            return
        for mine, theirs in zip(self._reading, reading, strict=True):
            mine[:] = theirs
        self._loaded = reading
