"""Bindings of the C update.

Before compilation ends, without a compiler, and for larger groups, numpy does the same.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Iterable, Sequence, Sized
from types import SimpleNamespace
from typing import Any

import numpy as np

from kineverse.compilation import CompiledFunction
from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.estimation.noise import RIGID
from kineverse.lie import Array

from .map_update import Loss, MapResult, MapSolver
from .residuals import Measurements
from .state_space import InformationState, Layout

_MAX_UNKNOWNS, _MAX_MEASUREMENT_SIZE = 64, 64  # sizes of the arrays on the stack of the C code
_LOSSES: tuple[Loss, ...] = ("gaussian", "cauchy", "mixture")  # in the order of the C code


class _Problem(ctypes.Structure):
    _fields_ = struct_fields(
        "p compute; i observations groups coordinates directions known; p is_pose size value slope seen "
        "white first place own first_x place_x first_watch watch first_limit limit rates step first_bend "
        "bend period lower upper input output work numbers mask whitening log_scale outlier selected "
        "belief prior nis dof squares weights"
    )


def _declare(code: Any) -> None:
    pointer = ctypes.c_void_p
    code.update.argtypes, code.update.restype = (pointer, ctypes.c_int64, ctypes.c_double), ctypes.c_int64
    code.predict.argtypes, code.predict.restype = (pointer,) * 3, ctypes.c_int64
    code.first_broken.argtypes, code.first_broken.restype = (pointer, ctypes.c_double), ctypes.c_int64


# With -O3 the compiler takes three times as long, for the same speed.
native_library = SourceLibrary(
    "tracking.c", _declare, ("-O2",), MOST=_MAX_UNKNOWNS, WIDE=_MAX_MEASUREMENT_SIZE
)
"""Compiled update, shared by all trackers of the process."""


class NativeMapSolver:
    """Compiled counterpart of a :class:`.MapSolver`, with its own memory and a lock."""

    def __init__(self, solver: MapSolver, function: CompiledFunction) -> None:
        self._solver, self._function = solver, function
        layout, groups, space = solver.layout, solver.layout.groups, solver.layout.tangent_space
        count, observed = len(groups), layout.observations
        size, directions = len(space.coordinates), len(space.tangent)
        self._motions = [solver.process_model.flow(number) for number in range(count)]
        is_varying = [np.empty(0) if m is None else m.is_varying.reshape(-1) for m in self._motions]
        is_carried = map(solver.process_model.is_carried, range(count))
        self._size, self._is_linear = size, not (any(is_carried) or layout.limits)
        indices: dict[str, Any] = {
            "is_pose": [one.is_pose for one in observed],
            "size": [one.size for one in observed],
            "value": [where.start for where in layout.value_slices],
            "slope": [where.start for where in layout.jacobian_slices],
            "seen": [where.start for where in layout.measurement_slices],
            "white": [where.start for where in layout.whitening_slices],
            "first": _starts(group.t for group in groups),
            "place": np.concatenate([group.t for group in groups]),
            "own": np.concatenate([group.coordinate_indices for group in groups]),
            "first_x": _starts(group.x for group in groups),
            "place_x": np.concatenate([group.x for group in groups]),
            "first_watch": _starts(group.observation_indices for group in groups),
            "watch": [i for group in groups for i in group.observation_indices],
            "first_limit": _starts(group.limits for group in groups),
            "limit": [layout.limit_slices[k].start for group in groups for k in group.limits],
            "rates": np.zeros(count),
            "step": np.zeros(count),
            "first_bend": _starts(is_varying),
        }
        numbers = InformationState((size, directions, count)).numbers.size
        room = (
            len(g.t) * (3 + 3 * len(g.t) + len(g.limits)) + 2 * len(g.x) + 3 * len(g.limits) for g in groups
        )
        sizes = {
            **dict.fromkeys(("log_scale", "outlier", "squares", "weights"), len(observed)),
            **{"nis": count, "dof": count, "belief": numbers, "prior": numbers, "work": sum(room)},
            **{"input": len(layout.arguments), "output": function.shapes[0][0]},
            "numbers": layout.measurement_slices[-1].stop,
            "whitening": layout.whitening_slices[-1].stop,
        }
        self._indices = {name: np.array(v, dtype=np.int64) for name, v in indices.items()}
        # The problem has the addresses of these arrays only.
        self._arrays = arrays = SimpleNamespace(
            **{name: np.zeros(size) for name, size in sizes.items()},
            bend=np.concatenate(is_varying).astype(np.float64),
            period=np.array([one.period for one in observed]),
            lower=solver.limits.lower,
            upper=solver.limits.upper,
            mask=np.zeros(len(observed), dtype=bool),
            selected=np.zeros(count, dtype=np.uint8),
        )
        self._reading = Measurements(arrays.numbers, arrays.mask, arrays.whitening, arrays.log_scale)
        self._problem = _Problem(0, len(observed), count, size, directions, len(layout.inputs))
        for name, array in (*self._indices.items(), *vars(arrays).items()):
            setattr(self._problem, name, array.ctypes.data)
        self._address = ctypes.addressof(self._problem)
        self._motion = np.zeros((2, size))
        self._motion_addresses = [row.ctypes.data for row in self._motion]
        self._loaded: Measurements | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> Any:
        # Addresses are valid in this process only.
        return NativeMapSolver, (self._solver, self._function)

    @staticmethod
    def suits(layout: Layout) -> bool:
        """Return True if the groups and observations of a layout are small enough for C."""
        groups = all(max(len(g.x), len(g.t), len(g.limits)) <= _MAX_UNKNOWNS for g in layout.groups)
        return groups and all(one.size <= _MAX_MEASUREMENT_SIZE for one in layout.observations)

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

    def update(
        self,
        belief: InformationState,
        reading: Measurements,
        inputs: Array,
        groups: Sequence[int],
        loss: Loss = "gaussian",
    ) -> MapResult | None:
        """Update some groups as :meth:`.MapSolver.update`; None on any difficulty, which numpy reports."""
        arrays, log_inlier = self._arrays, 0.0
        with self._lock:
            self._load(reading)
            arrays.belief[:] = arrays.prior[:] = belief.numbers
            arrays.input[self._size :] = inputs
            arrays.selected[:] = are_all = len(groups) == len(arrays.selected)
            if not are_all:
                arrays.selected[groups] = 1
            if loss == "mixture" and self._solver.outliers is not None:
                arrays.outlier[:] = self._solver.outlier_densities(reading)
                log_inlier = math.log(1 - self._solver.outliers.fraction)
            rounds = native_library.code.update(self._address, _LOSSES.index(loss), log_inlier)
            if rounds < 0:
                return None
            after, prior, nis, dof = (
                each.copy() for each in (arrays.belief, arrays.prior, arrays.nis, arrays.dof)
            )
            squares, weights = arrays.squares.copy(), arrays.weights.copy()
        prior[: self._size] = after[: self._size]
        return MapResult(belief.with_numbers(after), prior, nis, dof, rounds, squares, weights)

    def predict(
        self, belief: InformationState, displacement: Array, added_variance: Array
    ) -> InformationState | None:
        """Predict a belief inside its bounds; None for rates, curved limits, or on any difficulty."""
        if not self._is_linear:
            return None
        with self._lock:
            self._arrays.belief[:] = belief.numbers
            self._motion[0], self._motion[1] = displacement, added_variance
            is_done = native_library.code.predict(self._address, *self._motion_addresses) >= 0
            return belief.with_numbers(self._arrays.belief.copy()) if is_done else None

    def are_rigid(self, reading: Measurements) -> bool:
        """Return True if all measured poses are rigid; False if that is unknown."""
        code = native_library.code
        if code is None:
            return False
        with self._lock:
            self._load(reading)
            return bool(code.first_broken(self._address, RIGID) < 0)

    def _load(self, reading: Measurements) -> None:
        if self._loaded is reading:
            return
        for mine, theirs in zip(self._reading, reading, strict=True):
            mine[:] = theirs
        self._loaded = reading


def _starts(parts: Iterable[Sized]) -> Array:
    return np.cumsum([0, *map(len, parts)])
