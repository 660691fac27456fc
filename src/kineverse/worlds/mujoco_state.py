"""State of a model in MuJoCo: coordinates in the vector of positions, limits that depend on it, contacts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import array
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.formats.poses import pose_from_quaternion
from kineverse.lie import Array, to_quaternion
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .robot import Robot
from .simulated_world import Contact

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
            result = self._loops(values.vector(self._symbols))
            for (at, symbol), value in zip(self._dependent, result, strict=True):
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

    def mover(self) -> Callable[[Any, Callable[[Array, Array], Array]], None]:
        """Return a function that sets an ``MjData`` to values which a function takes from the ends of ranges.

        Coordinates without limits are within half a turn, loops stay where they are.
        """
        compiled, free = self._compiled, np.array(sorted(self.address.values()), dtype=int)
        joints = [int(np.flatnonzero(compiled.jnt_qposadr == at)[0]) for at in free.tolist()]
        limited = compiled.jnt_limited[joints].astype(bool)
        lower = np.where(limited, compiled.jnt_range[joints, 0], -np.pi)
        upper = np.where(limited, compiled.jnt_range[joints, 1], np.pi)

        def move(data: Any, draw: Callable[[Array, Array], Array]) -> None:
            data.qpos[free] = draw(lower, upper)
            self.follow(data.qpos)

        return move


def _pose(position: Array, wxyz: Array) -> Array:
    """Return a pose (4, 4) from a position and a quaternion with its scalar first."""
    w, x, y, z = np.asarray(wxyz, dtype=float).tolist()
    a, b, c = np.asarray(position, dtype=float).tolist()
    return pose_from_quaternion((a, b, c), (x, y, z, w)).matrix


_OPEN = 1e-9  # bound of a speed from which on it is free [m/s], [rad/s]


class MujocoLocks:
    """Limits of furniture that depend on the state, such as locks, as ranges of joints in each time step.

    A position ends at its bound. A speed whose bound is 0 is locked: the joint ends where it is. A position
    beyond a bound that comes is not pushed back, but moves no further away from it. These are the laws of the
    kinematic world. Other bounds of speeds do nothing.
    """

    def __init__(self, model: ModelView, robot: Robot, leave_out: Collection[str]) -> None:
        self._default = model.default_state()
        self._found: dict[str, tuple[Symbol, Constraint]] = {}
        for name, constraint in model.constraints.items():
            symbols, line = constraint.expression.symbols, constraint.line
            if not _bound_symbols(constraint) or name in leave_out or len(symbols) != 1 or line is None:
                continue
            (symbol,) = symbols
            coordinate = symbol.position if symbol.order else symbol
            if symbol.order <= 1 and coordinate.has_derivative and not robot.moves(coordinate):
                self._found[name] = coordinate, constraint

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the constraints."""
        return tuple(self._found)

    def keep(self, address: Mapping[Symbol, int]) -> tuple[str, ...]:
        """Keep the limits of joints by the positions of joints, and return the names of the others."""
        known = {name: {q, *_bound_symbols(c)} <= address.keys() for name, (q, c) in self._found.items()}
        self._found = {name: one for name, one in self._found.items() if known[name]}
        return tuple(name for name, is_known in known.items() if not is_known)

    def connect(self, compiled: Any, address: Mapping[Symbol, int]) -> None:
        """Find the joints in the final ``MjModel``."""
        found = list(self._found.values())
        self._compiled = compiled
        self._at = np.array([address[q] for q, _ in found], dtype=int)
        joint_at = {int(at): k for k, at in enumerate(compiled.jnt_qposadr)}
        joints = np.array([joint_at[at] for at in self._at.tolist()], dtype=int)
        self._joints, self._rows = np.unique(joints, return_inverse=True)
        limited = compiled.jnt_limited[self._joints].astype(bool)
        ranges = compiled.jnt_range[self._joints]
        self._range: Array = np.where(limited[:, None], ranges, (-math.inf, math.inf))
        compiled.jnt_limited[self._joints] = 1
        self._is_speed = np.array([c.order > 0 for _, c in found], dtype=bool)
        lines = np.array([c.line for _, c in found], dtype=float).reshape(-1, 2)
        self._slope, self._offset = lines.T
        function = compile([array([getattr(c, end) for _, c in found]) for end in ("lower", "upper")])
        self._bounds = function.bind()
        self._bounds.input[:] = [self._default[s] for s in function.inputs]
        moving = [k for k, s in enumerate(function.inputs) if s in address]
        self._moving = np.array(moving, dtype=int)
        self._sources = np.array([address[function.inputs[k]] for k in moving], dtype=int)
        self.reset()

    def reset(self) -> None:
        """Forget what has been beyond a bound."""
        self._lower = np.full(len(self._at), -math.inf)
        self._upper = np.full(len(self._at), math.inf)

    def update(self, data: Any) -> None:
        """Set the ranges of the joints for the next time step."""
        if not len(self._at):
            return
        self._bounds.input[self._moving] = data.qpos[self._sources]
        self._bounds()
        ends = (np.array(self._bounds.outputs) - self._offset) / self._slope
        low, high = np.minimum(*ends), np.maximum(*ends)
        low[self._is_speed & (low < -_OPEN)], high[self._is_speed & (high > _OPEN)] = -math.inf, math.inf
        blocked_low, blocked_high = self._is_speed & (low > -math.inf), self._is_speed & (high < math.inf)
        low[blocked_low], high[blocked_high] = math.inf, -math.inf
        q = data.qpos[self._at]
        # A joint that is held on both sides stays there, though it yields a bit to whatever presses on it.
        pinned = blocked_low & blocked_high & np.isfinite(self._lower) & np.isfinite(self._upper)
        self._lower = np.where(pinned, self._lower, np.minimum(low, np.maximum(self._lower, q)))
        self._upper = np.where(pinned, self._upper, np.maximum(high, np.minimum(self._upper, q)))
        result, rows = self._range.copy(), self._rows
        # What is held at an end of its range is held there, and not where it yields beyond.
        np.maximum.at(result[:, 0], rows, np.minimum(self._lower, self._range[rows, 1]))
        np.minimum.at(result[:, 1], rows, np.maximum(self._upper, self._range[rows, 0]))
        self._compiled.jnt_range[self._joints] = result


def _bound_symbols(constraint: Constraint) -> set[Symbol]:
    """Return the symbols of the bounds that change: parameters do not."""
    both = (*constraint.lower.symbols, *constraint.upper.symbols)
    return {s for s in both if s.has_derivative or s.order}


class MujocoContacts:
    """Contacts of one ``MjModel``."""

    def __init__(
        self, compiled: Any, robot: Callable[[str], bool], fingers: Sequence[Sequence[str]] = ()
    ) -> None:
        self._compiled = compiled
        self._names = [compiled.body(k).name for k in range(compiled.nbody)]
        self._is_robot = np.array([robot(name) for name in self._names])
        self._side = np.zeros(compiled.nbody, dtype=int)
        for side, names in enumerate(fingers, 1):
            for name in names:
                self._side[compiled.body(name).id] = side

    def contacts(self, data: Any) -> tuple[Contact, ...]:
        """Return one contact for each pair of bodies that touch, but those of the robot with itself.

        The force is the size of the sum over all points of contact. Point, normal and distance are those of
        the deepest one.
        """
        engine, result = mujoco(), dict[tuple[int, int], list[Any]]()
        wrench = np.zeros(6)
        for k in range(data.ncon):
            contact = data.contact[k]
            a, b = self._compiled.geom_bodyid[contact.geom].tolist()
            if self._is_robot[a] and self._is_robot[b]:
                continue
            frame = contact.frame.reshape(3, 3)
            engine.mj_contactForce(self._compiled, data, k, wrench)
            force, normal = frame.T @ wrench[:3], frame[0]
            if self._is_robot[b] or (b < a and not self._is_robot[a]):
                a, b, force, normal = b, a, -force, -normal
            known = result.get((a, b))
            if known is None:
                result[a, b] = [contact.pos.copy(), normal.copy(), contact.dist, force]
                continue
            known[3] = known[3] + force
            if contact.dist < known[2]:
                known[:3] = contact.pos.copy(), normal.copy(), contact.dist
        return tuple(
            Contact(
                self._names[a], self._names[b], point, normal, float(distance), float(np.linalg.norm(force))
            )
            for (a, b), (point, normal, distance, force) in result.items()
        )

    def largest_force(self, data: Any) -> float:
        """Return the largest normal force between a body of the robot and another body [N]."""
        if not data.ncon:
            return 0.0
        contact = data.contact
        bodies: Array = self._compiled.geom_bodyid[contact.geom]
        wanted = (self._is_robot[bodies].sum(axis=1) == 1) & (contact.efc_address >= 0)
        if not wanted.any():
            return 0.0
        # Contacts are few, and this runs in each time step: plain Python is faster than arrays here.
        sums: dict[tuple[int, int], float] = {}
        forces = data.efc_force[contact.efc_address[wanted]]
        for (one, other), force in zip(bodies[wanted].tolist(), forces.tolist(), strict=True):
            pair = (one, other) if one < other else (other, one)
            sums[pair] = sums.get(pair, 0.0) + force
        return max(sums.values())

    def grip(self, data: Any) -> dict[str, tuple[float, float]]:
        """Return the normal forces of both fingers by what they touch [N].

        Bodies that are rigidly connected and move count as one; its name is that of the one pressed most.
        """
        if not data.ncon:
            return {}
        contact = data.contact
        bodies: Array = self._compiled.geom_bodyid[contact.geom]
        sides = self._side[bodies]
        # Fingers with something that is not the robot's, in contacts that the solver has rows for.
        wanted = (sides.max(axis=1) > 0) & ~self._is_robot[bodies].all(axis=1) & (contact.efc_address >= 0)
        pressed: dict[tuple[bool, int], dict[int, Array]] = {}
        for k in np.flatnonzero(wanted).tolist():
            finger = int(sides[k, 1] > 0)
            body = int(bodies[k, 1 - finger])
            root = int(self._compiled.body_weldid[body])
            forces = pressed.setdefault((root > 0, root or body), {}).setdefault(body, np.zeros(2))
            forces[sides[k, finger] - 1] += data.efc_force[contact.efc_address[k]]
        result = {}
        for parts in pressed.values():
            most = max(parts, key=lambda body: float(parts[body].sum()))
            one, other = sum(parts.values(), np.zeros(2)).tolist()
            result[self._names[most]] = one, other
        return result
