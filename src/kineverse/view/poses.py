"""Frame poses of a model from one compiled function."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

import kineverse as kv
from kineverse.errors import UnknownNameError, duplicate_value_error, suggest
from kineverse.lie import to_quaternion, to_rpy
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import parse_symbol_name

from .rendering.triangle_mesh import Floats


def to_wxyz(matrices: npt.ArrayLike) -> Floats:
    """Return the unit quaternions (N, 4), w x y z with w >= 0, of (N, 3, 3) or larger rotation matrices."""
    return np.roll(to_quaternion(np.asarray(matrices, dtype=float)[:, :3, :3]), 1, axis=1)


def roll_pitch_yaw(matrix: npt.ArrayLike) -> Floats:
    """Return the angles (3,) about fixed x, y, z of a rotation, as in URDF [rad].

    At a pitch of a quarter turn, where only a sum of roll and yaw is defined, the roll is 0.
    """
    m = np.asarray(matrix, dtype=float)[:3, :3]
    angles = to_rpy(m)
    if np.hypot(m[0, 0], m[1, 0]) < 1e-9:
        angles[0], angles[2] = 0.0, np.arctan2(-m[0, 1], m[1, 1])
    return angles


class FramePoses:
    """Poses of frames in the world, as a compiled function of the values of symbols."""

    def __init__(self, model: ModelView, names: Iterable[str] | None = None) -> None:
        everything = (WORLD, *(name for name in model.frames if name != WORLD))
        self.names = everything if names is None else tuple(names)
        self._index = {name: k for k, name in enumerate(self.names)}
        # The world does not move, and a function without outputs cannot be compiled.
        self.moving = tuple(name for name in self.names if name != WORLD)
        self._function = kv.compile([model.fk(name) for name in self.moving]) if self.moving else None
        self.inputs = tuple(map(str, self._function.inputs)) if self._function else ()

    def evaluate(self, values: Mapping[str, float]) -> Floats:
        """Return (N, 4, 4) poses; ``values`` may hold more symbols than are needed [m], [rad]."""
        poses = np.tile(np.eye(4), (len(self.names), 1, 1))
        if self._function is not None:
            x = np.array([values[name] for name in self.inputs], dtype=float)
            for name, pose in zip(self.moving, self._function(x), strict=True):
                poses[self._index[name]] = pose
        return poses

    def batch(self, rows: npt.NDArray[np.float64]) -> list[Floats]:
        """Return, for each frame but the world, the (K, 4, 4) poses at K rows of values of ``inputs``."""
        return [] if self._function is None else list(self._function.batch(rows))

    def unplaced(self, poses: Floats) -> list[str]:
        """Return the frames of :attr:`names` whose poses are not finite."""
        return [self.names[k] for k in np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))]

    def index(self, name: str) -> int:
        """Return the index of a frame in the results."""
        if name not in self._index:
            raise UnknownNameError(f"There is no frame '{name}'. {suggest(name, self.names, 'frame')}")
        return self._index[name]


def complete(model: ModelView, state: StateLike | None = None) -> dict[str, float]:
    """Return values of all symbols by name: the given ones, and the default state for the others."""
    values = {str(symbol): float(value) for symbol, value in model.default_state().items()}
    known = values.keys() | {str(symbol) for symbol in model.symbols}
    given = set[str]()
    for key, value in (state or {}).items():
        name = str(key)
        if name in given and not isinstance(state, State):
            raise duplicate_value_error(name)
        given.add(name)
        if name in known:
            values[name] = float(value)
        elif not isinstance(state, State):
            if parse_symbol_name(name)[1] and name.partition(":")[0] in known:
                raise UnknownNameError(f"'{name}' is a speed; poses depend on positions only.")
            raise UnknownNameError(f"The model has no symbol '{name}'. {suggest(name, known, 'symbol')}")
    return values


def keep_known(model: ModelView, values: Mapping[str, float]) -> dict[str, float]:
    """Return those values by name whose symbols a model has."""
    known = {str(symbol) for symbol in model.symbols}
    return {name: value for name, value in values.items() if name in known}
