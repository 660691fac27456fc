"""Bindings of the C update, with the fast path for unambiguous inliers.

Until then, without a compiler, and where limits are curved, numpy does the same.

A group is left to others if something in it is neither right nor wrong beyond doubt. What is taken to be
wrong might be right, and others wrong instead: the evidence of that is bounded from above by what it says
alone, and by the largest density that each of the others can have.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compile import CompiledFunction
from kineverse.compile.c_library import SourceLibrary
from kineverse.estimation.c_source.tracking_primitives import PROCESS_MODEL, QUADRATIC_PROGRAM, RESIDUAL
from kineverse.estimation.c_source.tracking_update import MAP_UPDATE
from kineverse.estimation.robust import Outliers
from kineverse.lie import Array

from .bounds import StateBounds
from .gaussian import InformationState, TangentIndices
from .gaussian_sum import PRUNING_LOG_RATIO, Candidate, GaussianSum
from .layout import Layout
from .map_update import MapResult
from .process_model import ProcessModel
from .residuals import RIGID, Measurements

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


native_library = SourceLibrary(QUADRATIC_PROGRAM + PROCESS_MODEL + RESIDUAL + MAP_UPDATE, _declare)
"""The compiled update, once there is one; for all trackers of the process."""


class NativeMapSolver:
    """What :class:`.map_update.MapSolver` does for one tracker, in C.

    It has memory of its own, which threads use in turns.

    Parameters
    ----------
    layout, limits, function, charted
        The parts of a tracker.
    """

    def __init__(
        self, layout: Layout, limits: StateBounds, function: CompiledFunction, charted: ProcessModel
    ) -> None:
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
        self._indices: dict[str, TangentIndices] = {
            name: np.array(v, dtype=np.int64) for name, v in kept.items()
        }
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
        self._belief = np.zeros(InformationState((size, directions, count)).numbers.shape)
        self._reading = Measurements(
            np.zeros(layout.seen_slices[-1].stop),
            np.zeros(len(layout.observations), dtype=bool),
            np.zeros(layout.white_slices[-1].stop),
            np.zeros(len(layout.observations)),
        )
        self._loaded: Measurements | None = None
        self._lock = threading.Lock()
        self._where = ctypes.addressof(self._problem)
        self._moved = [row.ctypes.data for row in self._motion]
        self._seen = [array.ctypes.data for array in self._reading]
        self._written = [self._belief.ctypes.data, *self._seen, *(row.ctypes.data for row in self._results)]

    def __reduce__(self) -> Any:
        # Addresses mean something in this process only.
        return NativeMapSolver, (self._layout, self._limits, self._function, self._charted)

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

    def update(self, belief: InformationState, reading: Measurements, known: Array) -> MapResult | None:
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
            after = InformationState(belief.sizes, self._belief.copy(), belief.standing)
            return MapResult(after, nis, dof, rounds, squares=self._squares.copy())

    def predict(self, belief: InformationState, moved: Array, grown: Array) -> InformationState | None:
        """Return the belief inside the limits after steps and with variances added, both by coordinate.

        None if that is not easy.
        """
        with self._lock:
            self._belief[:] = belief.numbers
            self._motion[0], self._motion[1] = moved, grown
            if native_library.code.predict(self._where, self._written[0], *self._moved) < 0:
                return None
            return InformationState(belief.sizes, self._belief.copy(), belief.standing)

    def are_rigid(self, reading: Measurements) -> bool:
        """Whether all poses that were seen are rigid; False if that is not known."""
        code = native_library.code
        if code is None:
            return False
        with self._lock:
            self._load(reading)
            return bool(code.first_broken(self._where, *self._seen[:2], RIGID) < 0)

    def _load(self, reading: Measurements) -> None:
        if self._loaded is reading:
            return
        for mine, theirs in zip(self._reading, reading, strict=True):
            mine[:] = theirs
        self._loaded = reading


# Who is right with this probability is not doubted: what is left changes nothing that counts.
_SURE = 1 - 1e-6


class NativeInlierSolver:
    """Explains groups in C.

    Parameters
    ----------
    layout, native, outliers
        The parts of a tracker.
    """

    def __init__(self, layout: Layout, native: NativeMapSolver, outliers: Outliers) -> None:
        self._layout, self._native, self._outliers = layout, native, outliers
        self._wrong = np.array([outliers.log_density(one) for one in layout.observations])
        self._fair = math.log(1 - outliers.fraction)

    def explained(
        self, modes: GaussianSum, reading: Measurements, known: Array, groups: Sequence[int]
    ) -> tuple[list[Candidate], int]:
        """Return explanations of those groups of which there is no other, and the number of evaluations."""
        single = [number for number in groups if modes.alive[:, number].sum() == 1]
        found = self._native.update(modes.best, reading, known)
        if found is None:
            return [], 0
        right = self._believed(found, reading) > 0.5
        all_right = [n for n in single if right[self._seen(n, reading)].all()]
        candidates = [self._candidate(modes, found, reading, right, all_right)]
        split = [n for n in single if n not in all_right]
        if not split:
            return candidates, found.rounds
        again = self._native.update(modes.best, reading._replace(seen=reading.seen & right), known)
        if again is None:
            return candidates, found.rounds
        rivals = self._rivals(modes, reading, known, right, split)
        candidates.append(self._candidate(modes, again, reading, right, split, rivals))
        return candidates, max(found.rounds, again.rounds)

    def _seen(self, number: int, reading: Measurements) -> list[int]:
        return [i for i in self._layout.groups[number].seen if reading.seen[i]]

    def _believed(self, found: MapResult, reading: Measurements) -> Array:
        """Return how probable it is that each observation is right."""
        weights = np.zeros(len(reading.seen))
        assert found.squares is not None
        for i in np.flatnonzero(reading.seen).tolist():
            square, scale = float(found.squares[i]), float(reading.log_scale[i])
            weights[i], _ = self._outliers.judge(square, scale, float(self._wrong[i]))
        return weights

    def _rivals(
        self,
        modes: GaussianSum,
        reading: Measurements,
        known: Array,
        right: npt.NDArray[np.bool_],
        groups: Sequence[int],
    ) -> dict[int, float]:
        """Return how much evidence there is at most for each group if a doubted one is right after all."""
        best = dict.fromkeys(groups, -np.inf)
        doubted = {n: [i for i in self._seen(n, reading) if not right[i]] for n in groups}
        peaks = np.maximum(self._fair - reading.log_scale, self._wrong)
        for turn in range(max(map(len, doubted.values()))):
            alone = {n: those[turn] for n, those in doubted.items() if turn < len(those)}
            mask = np.zeros_like(reading.seen)
            mask[list(alone.values())] = True
            found = self._native.update(modes.best, reading._replace(seen=mask), known)
            for n, i in alone.items():
                others = sum(float(peaks[k]) for k in self._seen(n, reading) if k != i)
                gained = np.inf if found is None else _gained(found, modes, n)
                best[n] = max(best[n], gained + self._fair + others)
        return best

    def _candidate(
        self,
        modes: GaussianSum,
        found: MapResult,
        reading: Measurements,
        right: npt.NDArray[np.bool_],
        groups: Sequence[int],
        rivals: dict[int, float] | None = None,
    ) -> Candidate:
        """Return what was found as an explanation of those groups of which it is the only one."""
        believed = self._believed(found, reading)
        sure = []
        for number in groups:
            seen = self._seen(number, reading)
            kept = [i for i in seen if right[i]]
            nothing = float(self._wrong[seen].sum())
            by_outliers = len(kept) * self._fair + nothing - float(self._wrong[kept].sum())
            gained = _gained(found, modes, number) + by_outliers
            found.belief.evidence[number] += by_outliers
            others = [rivals[number]] if rivals else []
            rival = max([nothing, *others] if kept else others)
            if gained - rival > PRUNING_LOG_RATIO and all(believed[i] > _SURE for i in kept):
                sure.append(number)
        return Candidate(found.belief, np.empty(0), right.astype(float), found.nis, found.dof, sure)


def _gained(found: MapResult, modes: GaussianSum, number: int) -> float:
    return float(found.belief.evidence[number] - modes.best.evidence[number])
