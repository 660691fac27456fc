"""Motion of every degree of freedom through its range, with checks of poses and constraints."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.model.model_view import ModelView
from kineverse.view.poses import FramePoses, complete
from kineverse.view.sliders import Ranges, choose_slider_range, infer_units

from .output import show_progress

SAMPLES_PER_RANGE = 65
"""Number of samples of each range, limits included."""

CHECKED_PER_RANGE = 5
"""Number of these samples at which constraints are evaluated, limits included."""


@dataclass(frozen=True, slots=True)
class ExerciseResult:
    """Result of an exercise."""

    freedoms: int  # number of degrees of freedom
    poses: int  # number of frame poses computed
    rate: float  # frame poses per second
    violations: int  # number of constraints violated inside the ranges
    problems: list[str]  # texts for these constraints, and for frames whose poses are not finite and rigid


def exercise_model(model: ModelView) -> ExerciseResult:
    """Move each degree of freedom of a model from limit to limit, with the others at their defaults.

    Problems are poses that are not finite and rigid, and constraints that are violated although each
    coordinate is within its limits.
    """
    values = complete(model)
    poses, ranges = FramePoses(model), Ranges(model)
    unit = infer_units(model, values, ranges.names)
    limits = ranges.limits_at(values)
    base = np.array([values[name] for name in poses.inputs])
    count, seconds, violated, problems = 0, 0.0, set(), []
    for name in show_progress(ranges.names, "driving", "DoF"):
        path = np.linspace(*choose_slider_range(limits[name], values[name], unit[name]), SAMPLES_PER_RANGE)
        # Rounding must not move the last sample beyond the limit.
        path = np.clip(path, *limits[name])
        if name in poses.inputs:
            rows = np.tile(base, (SAMPLES_PER_RANGE, 1))
            rows[:, poses.inputs.index(name)] = path
            start = time.perf_counter()
            results = poses.batch(rows)
            seconds += time.perf_counter() - start
            count += SAMPLES_PER_RANGE * len(results)
            wrong = [frame for frame, pose in zip(poses.moving, results, strict=True) if not _rigid(pose)]
            if wrong:
                problems.append(f"{name}: {len(wrong)} frames have no rigid pose, such as {wrong[0]}")
        for value in path[:: (SAMPLES_PER_RANGE - 1) // (CHECKED_PER_RANGE - 1)]:
            violated |= {v.name for v in model.violations({**values, name: float(value)})}
    problems += [f"{name} is violated inside the limits" for name in sorted(violated)]
    return ExerciseResult(len(ranges.names), count, count / max(seconds, 1e-9), len(violated), problems)


def _rigid(poses: npt.NDArray[np.float64]) -> bool:
    """Return whether all of (K, 4, 4) matrices are finite and their rotations orthonormal."""
    rotation = poses[:, :3, :3]
    error = rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)
    return bool(np.isfinite(poses).all() and np.abs(error).max() < 1e-6)
