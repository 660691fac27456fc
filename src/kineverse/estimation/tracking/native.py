"""Bindings of the C update, with the fast path for unambiguous inliers.

Before compilation ends, without a compiler, and for curved limits, numpy does the same.

The fast path leaves a group to numpy if the inlier probability of a measurement in it is ambiguous. A
rejected measurement might be an inlier and others outliers instead. The evidence of this alternative is
bounded from above by the evidence of that measurement alone times the peak density of each other measurement.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction
from kineverse.compilation.c_library import SourceLibrary
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array

from .bounds import StateBounds
from .gaussian_sum import PRUNING_LOG_RATIO, Candidate, GaussianSum
from .information_state import InformationState
from .map_update import MapResult
from .process_model import ProcessModel
from .residuals import RIGID, Measurements
from .state_space import Layout

_MAX_UNKNOWNS, _MAX_MEASUREMENT_SIZE = 64, 64  # sizes of the arrays on the stack of the C code

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


# With -O3 the compiler takes three times as long, for the same speed.
native_library = SourceLibrary(
    "tracking.c", _declare, ("-O2",), MOST=_MAX_UNKNOWNS, WIDE=_MAX_MEASUREMENT_SIZE
)
"""Compiled update, shared by all trackers of the process."""


class NativeMapSolver:
    """Compiled counterpart of :class:`.MapSolver` for one tracker, with its own memory and a lock."""

    def __init__(
        self, layout: Layout, limits: StateBounds, function: CompiledFunction, process_model: ProcessModel
    ) -> None:
        self._layout, self._limits = layout, limits
        self._function, self._process_model = function, process_model
        count, size = len(layout.groups), len(layout.tangent_space.coordinates)
        directions = len(layout.tangent_space.tangent)
        self._motions = [process_model.flow(number) for number in range(count)]
        is_varying = [np.empty(0) if m is None else m.is_varying.reshape(-1) for m in self._motions]
        self._input, self._size = np.zeros(len(layout.arguments)), size
        indices = {
            "is_pose": [one.is_pose for one in layout.observations],
            "size": [one.size for one in layout.observations],
            "value": [where.start for where in layout.value_slices],
            "slope": [where.start for where in layout.jacobian_slices],
            "seen": [where.start for where in layout.measurement_slices],
            "white": [where.start for where in layout.whitening_slices],
            "first": np.cumsum([0, *(len(group.tangent) for group in layout.groups)]),
            "place": np.concatenate([group.t for group in layout.groups]),
            "own": np.concatenate([group.coordinate_indices for group in layout.groups]),
            "first_x": np.cumsum([0, *(len(group.x) for group in layout.groups)]),
            "place_x": np.concatenate([group.x for group in layout.groups]),
            "first_watch": np.cumsum([0, *(len(group.observation_indices) for group in layout.groups)]),
            "watch": [i for group in layout.groups for i in group.observation_indices],
            "rates": np.zeros(count),
            "step": np.zeros(count),
            "first_bend": np.cumsum([0, *map(len, is_varying)]),
        }
        self._indices = {name: np.array(v, dtype=np.int64) for name, v in indices.items()}
        self._squares = np.zeros(len(layout.observations))
        self._numbers = {
            "bend": np.concatenate(is_varying).astype(np.float64),
            "period": np.array([one.period for one in layout.observations]),
            "lower": limits.lower,
            "upper": limits.upper,
            "input": self._input,
            "output": np.zeros(function.shapes[0]),
            "work": np.zeros(sum(3 * len(g.t) + 3 * len(g.t) ** 2 + 2 * len(g.x) for g in layout.groups)),
            "squares": self._squares,
        }
        counts = (len(layout.observations), count, size, directions, len(layout.inputs))
        self._problem = _Problem(**dict(zip(_COUNTS, counts, strict=True)))
        for name, array in (*self._indices.items(), *self._numbers.items()):
            setattr(self._problem, name, array.ctypes.data)
        self._results = np.zeros((2, count))
        self._motion = np.zeros((2, size))
        # Buffers with fixed addresses: asking an array for its address takes longer than copying it.
        self._belief = np.zeros(InformationState((size, directions, count)).numbers.shape)
        self._reading = Measurements(
            np.zeros(layout.measurement_slices[-1].stop),
            np.zeros(len(layout.observations), dtype=bool),
            np.zeros(layout.whitening_slices[-1].stop),
            np.zeros(len(layout.observations)),
        )
        self._loaded: Measurements | None = None
        self._lock = threading.Lock()
        self._problem_address = ctypes.addressof(self._problem)
        self._motion_addresses = [row.ctypes.data for row in self._motion]
        self._reading_addresses = [array.ctypes.data for array in self._reading]
        results = (row.ctypes.data for row in self._results)
        self._addresses = [self._belief.ctypes.data, *self._reading_addresses, *results]

    def __reduce__(self) -> Any:
        # Addresses are valid in this process only.
        return NativeMapSolver, (self._layout, self._limits, self._function, self._process_model)

    @staticmethod
    def suits(layout: Layout) -> bool:
        """Return True if C supports the layout: bounds on single coordinates only, and small groups."""
        return (
            not layout.limits
            and all(max(len(group.x), len(group.t)) <= _MAX_UNKNOWNS for group in layout.groups)
            and all(one.size <= _MAX_MEASUREMENT_SIZE for one in layout.observations)
        )

    @property
    def is_ready(self) -> bool:
        """True once the update, the measurement function and the process model are compiled."""
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

    def update(self, belief: InformationState, reading: Measurements, inputs: Array) -> MapResult | None:
        """Update measured groups as :meth:`.MapSolver.update`; None on any difficulty, numpy reports it."""
        with self._lock:
            self._load(reading)
            self._belief[:] = belief.numbers
            self._input[self._size :] = inputs
            rounds = native_library.code.update(self._problem_address, *self._addresses)
            if rounds < 0:
                return None
            nis, dof = self._results.copy()
            after = belief.with_numbers(self._belief.copy())
            return MapResult(after, nis, dof, rounds, squares=self._squares.copy())

    def predict(
        self, belief: InformationState, displacement: Array, added_variance: Array
    ) -> InformationState | None:
        """Predict a belief by displacements and variances, inside the limits; None on any difficulty."""
        addresses = self._problem_address, self._addresses[0], *self._motion_addresses
        with self._lock:
            self._belief[:] = belief.numbers
            self._motion[0], self._motion[1] = displacement, added_variance
            is_done = native_library.code.predict(*addresses) >= 0
            return belief.with_numbers(self._belief.copy()) if is_done else None

    def are_rigid(self, reading: Measurements) -> bool:
        """Return True if all measured poses are rigid; False if that is unknown."""
        code = native_library.code
        if code is None:
            return False
        with self._lock:
            self._load(reading)
            return bool(code.first_broken(self._problem_address, *self._reading_addresses[:2], RIGID) < 0)

    def _load(self, reading: Measurements) -> None:
        if self._loaded is reading:
            return
        for mine, theirs in zip(self._reading, reading, strict=True):
            mine[:] = theirs
        self._loaded = reading


_CERTAIN = 1 - 1e-6  # above this inlier probability a measurement is taken as an inlier
_MOST_TRIMMED = 4  # groups with more outliers are left to numpy


class NativeInlierSolver:
    """Compiled update of groups whose measurements are unambiguous inliers or outliers."""

    def __init__(self, layout: Layout, native: NativeMapSolver, outliers: Outliers) -> None:
        self._layout, self._native, self._outliers = layout, native, outliers
        self._log_inlier = math.log(1 - outliers.fraction)

    def solve(
        self, mixture: GaussianSum, reading: Measurements, inputs: Array, groups: Sequence[int]
    ) -> tuple[list[Candidate], int]:
        """Return candidates for the groups that have no alternative, and the number of evaluations."""
        unambiguous = [number for number in groups if mixture.alive[:, number].sum() == 1]
        result = self._native.update(mixture.best, reading, inputs)
        if result is None:
            return [], 0
        pairs = zip(self._layout.observations, reading.log_scale.tolist(), strict=True)
        log_outlier = np.array([self._outliers.log_density(one, scale) for one, scale in pairs])  # log(ε u)
        inliers = self._inlier_probabilities(result, reading, log_outlier) > 0.5
        all_right = [n for n in unambiguous if inliers[self._measured(n, reading)].all()]
        candidates = [self._candidate(mixture, result, reading, log_outlier, inliers, all_right)]
        split = [n for n in unambiguous if n not in all_right]
        if not split:
            return candidates, result.rounds
        trimmed = self._trim_worst(mixture, result, reading, inputs, log_outlier, split)
        if trimmed is None:
            return candidates, result.rounds
        refined, inliers = trimmed
        rivals = self._rival_evidence(mixture, reading, inputs, log_outlier, inliers, split)
        candidates.append(self._candidate(mixture, refined, reading, log_outlier, inliers, split, rivals))
        return candidates, max(result.rounds, refined.rounds)

    def _trim_worst(
        self,
        mixture: GaussianSum,
        result: MapResult,
        reading: Measurements,
        inputs: Array,
        log_outlier: Array,
        groups: Sequence[int],
    ) -> tuple[MapResult, npt.NDArray[np.bool_]] | None:
        """Reject the worst measurement of each group, which drags the estimate, until none is an outlier."""
        mask, left = reading.mask.copy(), list(groups)
        for _ in range(_MOST_TRIMMED):
            probable = self._inlier_probabilities(result, reading._replace(mask=mask), log_outlier) > 0.5
            left = [n for n in left if not all(probable[i] for i in self._measured(n, reading) if mask[i])]
            if not left:
                break
            assert result.squares is not None
            for number in left:
                kept = [i for i in self._measured(number, reading) if mask[i]]
                mask[max(kept, key=result.squares.__getitem__)] = False
            after = self._native.update(mixture.best, reading._replace(mask=mask), inputs)
            if after is None:
                return None
            result = after
        return result, mask

    def _measured(self, number: int, reading: Measurements) -> list[int]:
        return [i for i in self._layout.groups[number].observation_indices if reading.mask[i]]

    def _inlier_probabilities(self, result: MapResult, reading: Measurements, log_outlier: Array) -> Array:
        weights = np.zeros(len(reading.mask))
        assert result.squares is not None
        for i in np.flatnonzero(reading.mask).tolist():
            square, scale = float(result.squares[i]), float(reading.log_scale[i])
            weights[i], _ = self._outliers.weigh(square, scale, float(log_outlier[i]))
        return weights

    def _rival_evidence(
        self,
        mixture: GaussianSum,
        reading: Measurements,
        inputs: Array,
        log_outlier: Array,
        inliers: npt.NDArray[np.bool_],
        groups: Sequence[int],
    ) -> dict[int, float]:
        """Return an upper bound on the evidence of each group if a rejected measurement is an inlier."""
        best = dict.fromkeys(groups, -np.inf)
        rejected = {n: [i for i in self._measured(n, reading) if not inliers[i]] for n in groups}
        peaks = np.maximum(self._log_inlier - reading.log_scale, log_outlier)
        for index in range(max(map(len, rejected.values()))):
            alone = {n: those[index] for n, those in rejected.items() if index < len(those)}
            mask = np.zeros_like(reading.mask)
            mask[list(alone.values())] = True
            result = self._native.update(mixture.best, reading._replace(mask=mask), inputs)
            for n, i in alone.items():
                others = sum(float(peaks[k]) for k in self._measured(n, reading) if k != i)
                gained = np.inf if result is None else _evidence_gain(result, mixture, n)
                best[n] = max(best[n], gained + self._log_inlier + others)
        return best

    def _candidate(
        self,
        mixture: GaussianSum,
        result: MapResult,
        reading: Measurements,
        log_outlier: Array,
        inliers: npt.NDArray[np.bool_],
        groups: Sequence[int],
        rivals: dict[int, float] | None = None,
    ) -> Candidate:
        """Return the result as a candidate for the groups of which it is the only one."""
        weights = self._inlier_probabilities(result, reading, log_outlier)
        certain = []
        for number in groups:
            measured = self._measured(number, reading)
            accepted = [i for i in measured if inliers[i]]
            all_outliers = float(log_outlier[measured].sum())
            by_outliers = len(accepted) * self._log_inlier + all_outliers - float(log_outlier[accepted].sum())
            gained = _evidence_gain(result, mixture, number) + by_outliers
            result.belief.evidence[number] += by_outliers
            others = [rivals[number]] if rivals else []
            rival = max([all_outliers, *others] if accepted else others)
            if gained - rival > PRUNING_LOG_RATIO and all(weights[i] > _CERTAIN for i in accepted):
                certain.append(number)
        return Candidate(result.belief, np.empty(0), inliers.astype(float), result.nis, result.dof, certain)


def _evidence_gain(result: MapResult, mixture: GaussianSum, number: int) -> float:
    return float(result.belief.evidence[number] - mixture.best.evidence[number])
