"""Random hinges and sliders of the joint-type experiment, and noisy poses of their two parts.

Noise, number of observations, range and lever are random, within the constants below. The axis goes through
the origin of the parent in a random direction; the origin of a slider's child is on it. In :data:`MOVING` of
the cases the observer has a random pose at each observation and measures the parent with the same noise as
the child. In the others the parent is exact. Errors are in the observer's axes:
``(p + δp, Exp(δθ) R)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.lie import Array, exp_so3, quaternion, retract, transform, translation, unit_vector
from kineverse_studies.experiments.estimation_grid.samples import Joint

SEED = 2017

COUNTS = (6, 120)
"""Least and largest number of observations, log-uniform."""

POSITIONS = (0.0007, 0.04)
ORIENTATIONS = (math.radians(0.25), math.radians(7.0))
"""Standard deviations of each component of the errors [m], [rad], log-uniform and independent."""

RANGES: dict[Joint, tuple[float, float]] = {
    "revolute": (math.radians(12.0), math.radians(130.0)),
    "prismatic": (0.04, 0.6),
}
"""Ranges [rad], [m], uniform."""

BETA = (0.7, 0.9)
"""Parameters of the Beta distribution of the joint values over the range."""

LEVERS = (0.08, 0.9)
"""Distances of the child's origin from the axis of a hinge [m], uniform."""

MOVING = 0.6
"""Share of the cases with a moving observer and a parent that is measured with noise, too."""


@dataclass(frozen=True, eq=False)
class JointCase:
    """Observations of a random joint."""

    joint: Joint  # true family
    position: float  # standard deviations of the errors [m], [rad]
    orientation: float
    range: float  # range of the joint [rad], [m]
    # measured poses of the parent, (N, 4, 4); None if they are exact and the observer's frame
    parent: Array | None
    child: Array  # measured poses of the child, (N, 4, 4)


def draw_case(number: int) -> JointCase:
    """Draw the case of a number. Each has a random generator of its own."""
    rng = np.random.default_rng([SEED, number])
    joint: Joint = "revolute" if rng.random() < 0.5 else "prismatic"
    count = round(_log_uniform(rng, *COUNTS))
    position, orientation = _log_uniform(rng, *POSITIONS), _log_uniform(rng, *ORIENTATIONS)
    reach = rng.uniform(*RANGES[joint])
    axis = _random_direction(rng)
    lever = rng.uniform(*LEVERS) * _random_orthogonal(rng, axis)
    turn = rng.uniform(-math.pi, math.pi) * _random_direction(rng)
    along = reach * rng.beta(*BETA, count)[:, None] * axis
    if joint == "prismatic":
        children = translation(along) @ transform(exp_so3(turn), np.zeros(3))
    else:
        children = transform(exp_so3(along), np.zeros(3)) @ transform(exp_so3(turn), lever)
    parents = None
    if rng.random() < MOVING:
        wxyz = rng.standard_normal((count, 4))
        parents = transform(quaternion(np.roll(wxyz, -1, axis=-1)), rng.uniform(-1.0, 1.0, (count, 3)))
        children = parents @ children

    def observe(poses: Array) -> Array:
        errors = rng.standard_normal((count, 6)) * np.repeat([position, orientation], 3)
        return retract(poses, errors)

    return JointCase(
        joint,
        position,
        orientation,
        reach,
        None if parents is None else observe(parents),
        observe(children),
    )


def _log_uniform(rng: np.random.Generator, least: float, most: float) -> float:
    return float(least * (most / least) ** rng.random())


def _random_direction(rng: np.random.Generator) -> Array:
    return unit_vector(rng.standard_normal(3))


def _random_orthogonal(rng: np.random.Generator, axis: Array) -> Array:
    return unit_vector(np.cross(axis, _random_direction(rng)))
