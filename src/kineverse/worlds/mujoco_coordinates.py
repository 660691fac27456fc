"""Coordinates of a model in MuJoCo's vector of positions, and back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import InvalidValueError
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.formats.poses import pose_from_quaternion
from kineverse.lie import Array, to_quaternion
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

_QUATERNION = ("qw", "qx", "qy", "qz")


class MujocoCoordinates:
    """Map between states of a model and positions of its joints in MuJoCo.

    A joint that follows another has the value of its polynomial. A coordinate that depends on others by a
    loop has the value of its expression.
    """

    def __init__(self, model: ModelView, compiled: Any) -> None:
        self._model, self._compiled = model, compiled
        self._symbols = tuple(model.symbols)
        self.default = model.default_state()
        plain = {s.path: s for s in self._symbols if s.has_derivative and not s.order}
        dependent = {s.path: s for s in model.rates.dependent}
        engine = mujoco()
        self.address: dict[Symbol, int] = {}
        self.dof: dict[Symbol, int] = {}
        self.followers: Array = np.eye(compiled.nv)
        self._follow: list[tuple[int, int, Array]] = []
        self._balls: list[tuple[int, list[Symbol]]] = []
        self._free: list[tuple[int, list[Symbol], Array]] = []
        self._dependent: list[tuple[int, Symbol]] = []
        ties = {
            int(compiled.eq_obj1id[k]): k
            for k in range(compiled.neq)
            if compiled.eq_type[k] == engine.mjtEq.mjEQ_JOINT
        }
        for k in range(compiled.njnt):
            name, kind = compiled.joint(k).name, compiled.jnt_type[k]
            at, dof = int(compiled.jnt_qposadr[k]), int(compiled.jnt_dofadr[k])
            if kind == engine.mjtJoint.mjJNT_BALL:
                self._balls.append((at, [plain[f"{name}/{c}"] for c in _QUATERNION]))
            elif kind == engine.mjtJoint.mjJNT_FREE:
                body = int(compiled.jnt_bodyid[k])
                rest = _pose(compiled.body_pos[body], compiled.body_quat[body])
                self._free.append((at, [plain[f"{name}/{c}"] for c in ("x", "y", "z", *_QUATERNION)], rest))
            elif name in plain:
                self.address[plain[name]], self.dof[plain[name]] = at, dof
            elif k in ties:
                leader, data = int(compiled.eq_obj2id[ties[k]]), compiled.eq_data[ties[k]][:5].copy()
                self._follow.append((at, int(compiled.jnt_qposadr[leader]), data))
                self.followers[dof, int(compiled.jnt_dofadr[leader])] = data[1]
                self.followers[dof, dof] = 0.0
            elif name in dependent:
                self._dependent.append((at, dependent[name]))
        known = set(self.address)
        known.update(s for _, symbols in self._balls for s in symbols)
        known.update(s for _, symbols, _ in self._free for s in symbols)
        self._others = {s: self.default[s] for s in self._symbols if s not in known}
        values = [model.rates.dependent[s] for _, s in self._dependent]
        self._loops = compile(values, self._symbols) if values else None

    def positions(self, state: StateLike) -> Array:
        """Return the positions ``qpos`` of a state; coordinates without a value have their default."""
        given = as_state(state, self._symbols)
        values = self.default | State({s: v for s in self._symbols if (v := given.given(s)) is not None})
        qpos: Array = np.array(self._compiled.qpos0, dtype=float)
        for symbol, at in self.address.items():
            qpos[at] = values[symbol]
        for at, symbols in self._balls:
            quaternion = values.vector(symbols)
            qpos[at : at + 4] = quaternion / np.linalg.norm(quaternion)
        for at, symbols, rest in self._free:
            place = values.vector(symbols)
            pose = rest @ _pose(place[:3], place[3:])
            qpos[at : at + 7] = [*pose[:3, 3], *to_quaternion(pose[:3, :3])[[3, 0, 1, 2]]]
        if self._loops is not None:
            found = self._loops(values.vector(self._symbols))
            for (at, symbol), value in zip(self._dependent, found, strict=True):
                if not math.isfinite(value):
                    raise InvalidValueError(f"No loop closes in this state: '{symbol}' has no value.")
                qpos[at] = float(value)
        self.follow(qpos)
        return qpos

    def follow(self, qpos: Array) -> None:
        """Set the positions of all joints that follow another one."""
        for at, leader, coefficients in self._follow:
            qpos[at] = np.polynomial.polynomial.polyval(qpos[leader], coefficients)

    def state(self, qpos: Array, stamp: float) -> State:
        """Return the state of positions."""
        values = dict(self._others)
        values.update((symbol, float(qpos[at])) for symbol, at in self.address.items())
        for at, symbols in self._balls:
            values.update(zip(symbols, qpos[at : at + 4].tolist(), strict=True))
        for at, symbols, rest in self._free:
            pose = np.linalg.inv(rest) @ _pose(qpos[at : at + 3], qpos[at + 3 : at + 7])
            x, y, z, w = to_quaternion(pose[:3, :3]).tolist()
            values.update(zip(symbols, [*pose[:3, 3].tolist(), w, x, y, z], strict=True))
        return State({s: values[s] for s in self._symbols}, stamp=stamp, source="mujoco")

    def sampler(self) -> Callable[[Any, np.random.Generator], None]:
        """Return a function that sets an ``MjData`` to a random state within the limits.

        Coordinates without limits are within half a turn, loops stay where they are.
        """
        free, lower, upper = self._ranges()

        def move(data: Any, random: np.random.Generator) -> None:
            data.qpos[free] = random.uniform(lower, upper)
            self.follow(data.qpos)

        return move

    def sweep(self) -> Callable[[Any, float], None]:
        """Return a function that sets an ``MjData`` to a share of the range of all coordinates."""
        free, lower, upper = self._ranges()

        def move(data: Any, share: float) -> None:
            data.qpos[free] = lower + share * (upper - lower)
            self.follow(data.qpos)

        return move

    def _ranges(self) -> tuple[Array, Array, Array]:
        """Return the places of hinges and slides in ``qpos``, and the ends of their ranges."""
        compiled, free = self._compiled, np.array(sorted(self.address.values()), dtype=int)
        joints = [int(np.flatnonzero(compiled.jnt_qposadr == at)[0]) for at in free.tolist()]
        limited = compiled.jnt_limited[joints].astype(bool)
        lower = np.where(limited, compiled.jnt_range[joints, 0], -np.pi)
        upper = np.where(limited, compiled.jnt_range[joints, 1], np.pi)
        return free, lower, upper


def _pose(position: Array, wxyz: Array) -> Array:
    """Return a pose (4, 4) from a position and a quaternion with its scalar first."""
    w, x, y, z = np.asarray(wxyz, dtype=float).tolist()
    a, b, c = np.asarray(position, dtype=float).tolist()
    return pose_from_quaternion((a, b, c), (x, y, z, w)).matrix
