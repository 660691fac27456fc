"""Simulated streams of two markers on one door, with correlated errors, dropouts and gross outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.compile import compile  # noqa: A004
from kineverse.lie import Array, exp_so3, retract, transform
from kineverse.model.model import Model

DOOR = "kitchen/fridge_door"
FRAMES = (DOOR, "kitchen/fridge_door_handle")
"""Coordinate of the door, and the two frames on it that carry markers."""

RATE = 30.0
"""Looks per second."""

POSITION, ORIENTATION = 0.004, math.radians(1.5)
"""Standard deviations of each coordinate of a marker [m] and about each axis [rad]."""

OPENED, HALF_SHUT, MOVING_TIME = 10.0, 34.0, 3.5
"""Times at which a hand begins to open and to half shut the door, and the duration of each motion [s]."""

OPEN_ANGLE, HALF_SHUT_ANGLE = 1.3, 0.65
"""Angles of the open and of the half shut door [rad]."""


@dataclass(frozen=True)
class StreamErrors:
    """Errors of a stream of looks."""

    correlation: float = 0.95
    share: float = 0.7
    dropouts: float = 0.15  # fractions of markers that are missing, and that are somewhere else
    outliers: float = 0.05
    reach: float = 2.0  # outliers are uniform in a cube of this edge about the marker [m], in any orientation


@dataclass(frozen=True, eq=False)
class Stream:
    """Stream of looks at the markers of a door."""

    times: Array  # times of the looks (N,) [s]
    angles: Array  # true angles of the door (N,) [rad]
    poses: Array  # measured poses of the markers (N, 2, 4, 4)
    seen: npt.NDArray[np.bool_]  # true where a marker was seen, and where its pose is an outlier (N, 2)
    gross: npt.NDArray[np.bool_]

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """True while the door turns (N,)."""
        speed = np.abs(np.gradient(self.angles, self.times))
        return np.asarray(speed > 1e-6)

    def look(self, k: int) -> dict[str, Array]:
        """Return the poses of the seen markers, by name."""
        return {frame: self.poses[k, i] for i, frame in enumerate(FRAMES) if self.seen[k, i]}


def hand_motion(times: Array) -> Array:
    """Return the angles (N,) of a door that a hand opens, and later half shuts, smoothly (minimum jerk)."""

    def share(began: float) -> Array:
        t = np.clip((times - began) / MOVING_TIME, 0.0, 1.0)
        return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))

    return OPEN_ANGLE * share(OPENED) - (OPEN_ANGLE - HALF_SHUT_ANGLE) * share(HALF_SHUT)


def simulate_stream(
    model: Model, angles: Array, random: np.random.Generator, errors: StreamErrors | None = None
) -> Stream:
    """Return a stream of looks at a door with the given angles (N,), one for each look."""
    errors = StreamErrors() if errors is None else errors
    count = len(angles)
    true = np.stack(
        [compile(model.fk(f), [model.symbol(DOOR)]).batch(angles[:, None]) for f in FRAMES], axis=1
    )
    deviations = np.array([POSITION] * 3 + [ORIENTATION] * 3)
    noise = correlated_errors(count, (len(FRAMES), 6), random, errors) * deviations
    poses = retract(true, noise)
    gross = random.random((count, len(FRAMES))) < errors.outliers
    wrong = int(gross.sum())
    away = random.uniform(-errors.reach / 2, errors.reach / 2, (wrong, 3))
    turns = exp_so3(random.uniform(0, math.pi, (wrong, 1)) * _directions(random, wrong))
    poses[gross] = transform(turns, true[gross][:, :3, 3] + away)
    seen = random.random((count, len(FRAMES))) >= errors.dropouts
    return Stream(np.arange(count) / RATE, angles, poses, seen, gross)


def correlated_errors(
    count: int, shape: tuple[int, ...], random: np.random.Generator, errors: StreamErrors
) -> Array:
    """Return errors of unit variance (count, *shape): a stationary first-order process and white noise."""
    white = random.standard_normal((count, *shape))
    slow = np.empty((count, *shape))
    slow[0] = random.standard_normal(shape)
    innovation = math.sqrt(1.0 - errors.correlation**2) * random.standard_normal((count, *shape))
    for k in range(1, count):
        slow[k] = errors.correlation * slow[k - 1] + innovation[k]
    return math.sqrt(errors.share) * slow + math.sqrt(1.0 - errors.share) * white


def _directions(random: np.random.Generator, count: int) -> Array:
    vectors = random.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
