"""Default process noise: that of furniture which a hand moves.

A hand moves a frame by random steps of some variance per second, or accelerates it at random. A speed has the
largest noise with which no observed frame moves by more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from kineverse.errors import InvalidValueError, KineverseError, suggest
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .measurements import require_number

if TYPE_CHECKING:
    from .step import UpdateStep

Process: TypeAlias = Literal["position", "velocity", "static"]

PROCESSES: Mapping[str, tuple[float, float]] = {"position": (0.004, 0.01), "velocity": (0.1, 0.3)}
"""Linear and angular noise of frames: of positions [m²/s], [rad²/s], or of speeds [m²/s³], [rad²/s³].

They suit a kitchen door that a hand opens within 3.5 s (``kineverse reproduce stream``)."""

INITIAL_SPEED_TIME = 3.0
"""The initial variance of a speed is its process noise during this time [s]."""

# Relative positions between limits at which frames are sampled beside the start.
_SAMPLES = (0.2, 0.5, 0.8)
_LEAST = 1e-6


def check_process(process: str) -> None:
    """Check the name of a process model."""
    known = (*PROCESSES, "static")
    if process not in known:
        raise InvalidValueError(f"There is no process {process!r}. {suggest(str(process), known, 'process')}")


def require_noise(key: object, given: Any) -> float:
    """Check the process noise of ``key``."""
    number = require_number(given, f"The process noise of '{key}'")
    if not (math.isfinite(number) and number >= 0):
        raise InvalidValueError(
            f"The process noise of '{key}' is positive and finite, or 0 for a part that never moves, not "
            f"{given!r}."
        )
    return number


def default_process_noise(
    update_step: UpdateStep, process: Process, start: Array, inputs: Array
) -> dict[Symbol, float]:
    """Return the process noise of each speed: variances per second, or spectral densities of accelerations."""
    if process == "static":
        return {}
    linear, angular = PROCESSES[process]
    largest = dict.fromkeys(update_step.process_model.speeds.values(), 0.0)
    for x in _sample_states(update_step, start):
        try:
            out = update_step.residuals.evaluate(x, inputs)
            _raise_to(largest, update_step, x, inputs, out, linear, angular)
        except KineverseError:  # infeasible
            continue
    return {v: 1.0 / shown if shown > _LEAST else angular for v, shown in largest.items()}


def _sample_states(update_step: UpdateStep, start: Array) -> list[Array]:
    """Return the start, and states between the limits."""
    limits = update_step.limits
    bounded = np.isfinite(limits.upper - limits.lower)
    lower, upper = limits.lower[bounded], limits.upper[bounded]
    states = [start]
    for share in _SAMPLES:
        states.append(start.copy())
        states[-1][bounded] = lower + share * (upper - lower)
    return states


def _raise_to(
    largest: dict[Symbol, float],
    update_step: UpdateStep,
    x: Array,
    inputs: Array,
    out: Array,
    linear: float,
    angular: float,
) -> None:
    """Raise the largest square of the motion of a frame by each speed, in units of the noise of frames."""
    layout, process_model = update_step.layout, update_step.process_model
    for number, group in enumerate(layout.groups):
        _, _, gain = process_model.transition(
            number, x[group.x], np.zeros(len(process_model.speeds_of(number))), inputs
        )
        for i in group.observation_indices:
            one = layout.observations[i]
            if not one.frame:
                continue
            slope = out[layout.jacobian_slices[i]].reshape(one.size, len(group.t)) @ gain
            squares = np.square(slope[:3]).sum(axis=0) / linear
            if one.is_pose:
                squares = np.maximum(squares, np.square(slope[3:]).sum(axis=0) / angular)
            for v, square in zip(process_model.speeds_of(number), squares.tolist(), strict=True):
                if np.isfinite(square):
                    largest[v] = max(largest[v], square)
