"""Servos of a robot in MuJoCo: speeds of a model become forces on joints.

A servo is a spring and a damper on a set point q_s that moves with the speed v,

    τ = I w² (q_s - q) + 2 I w (v - q̇),    |τ| <= effort,

critically damped with the bandwidth w. I is the largest inertia about the joint in sampled configurations:
with that of one configuration, such as a stretched arm, a joint would be too soft in others. The set point
stays near the joint, so that a servo that something stops does not wind up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.compile import compile  # noqa: A004
from kineverse.errors import ExpressionError, InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import as_expression
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .mujoco_coordinates import MujocoCoordinates

BANDWIDTH = 80.0
"""Bandwidth w [1/s]: a robot stands still some 50 ms after its speeds are zero."""
_LEAD = 0.05
"""Largest distance of a set point from its joint [m], [rad]."""
_ARMATURE = 0.1
"""Part of the largest inertia that is added to a joint as that of its motor."""
_ACCELERATION = 20.0
"""Acceleration [m/s²], [rad/s²] that a servo without a stated effort can give to the largest inertia."""
_BASE_FORCE = 1500.0
_CONFIGURATIONS = 40
_PLANAR = 3


class SpeedMap:
    """Map from speeds of a robot to those of its coordinates, by the rates of the model.

    Parameters
    ----------
    model
        The model.
    coordinates
        Coordinates of the robot, in the order of the results.
    address
        Index in ``qpos`` of coordinates on which the map depends.

    Attributes
    ----------
    speeds
        Speeds of the robot, in the order of the columns.
    """

    def __init__(
        self, model: ModelView, coordinates: Sequence[Symbol], address: Mapping[Symbol, int]
    ) -> None:
        rows = [dict(model.rates.row(c) or {c.derivative(): as_expression(1.0)}) for c in coordinates]
        self.speeds = tuple(dict.fromkeys(s for row in rows for s in row))
        column = {speed: k for k, speed in enumerate(self.speeds)}
        self._known = {str(s): s for s in model.speeds}
        self._column = column
        self._matrix: Array = np.zeros((len(rows), len(self.speeds)))
        varying = []
        for i, row in enumerate(rows):
            for speed, factor in row.items():
                if factor.symbols:
                    varying.append((i, column[speed], factor))
                else:
                    self._matrix[i, column[speed]] = float(factor)
        self._entries = np.array([(i, k) for i, k, _ in varying], dtype=int).reshape(-1, 2)
        self._function = compile([factor for _, _, factor in varying]) if varying else None
        inputs = self._function.inputs if self._function is not None else ()
        missing = [str(s) for s in inputs if s not in address]
        if missing:
            raise InvalidValueError(
                f"The speeds of {', '.join(map(str, coordinates))} depend on {', '.join(missing)}, which "
                "MuJoCo has not as the position of one joint. Replace that part of the robot."
            )
        self._at = np.array([address[s] for s in inputs], dtype=int)

    def vector(self, speeds: StateLike) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the speeds of the robot in a mapping, (n,), and flags of the given ones, (n,).

        Raises
        ------
        InvalidValueError
            For a speed that is not finite.
        UnknownNameError
            For a speed that the model does not have.
        """
        if not isinstance(speeds, Mapping):
            raise ExpressionError(f"Speeds are given as a mapping {{name: number}}, not as {speeds!r}.")
        vector, given = np.zeros(len(self.speeds)), np.zeros(len(self.speeds), dtype=bool)
        for key, value in speeds.items():
            speed = self._known.get(str(key))
            if speed is None:
                if isinstance(speeds, State):
                    continue  # a state may have further values
                raise UnknownNameError(
                    f"The model has no speed '{key}'. {suggest(str(key), self._known, 'speed')}"
                )
            number = finite_number(value)
            if number is None:
                raise InvalidValueError(f"The speed '{key}' is {value!r}; it must be finite.")
            k = self._column.get(speed)
            if k is not None:
                vector[k], given[k] = number, True
        return vector, given

    def columns_of(self, coordinates: Sequence[Symbol]) -> npt.NDArray[np.bool_]:
        """Return flags of the speeds (n,) that move some of the coordinates alone."""
        names = {s.path for s in coordinates}
        return np.array([speed.path in names for speed in self.speeds], dtype=bool)

    def rates(self, speeds: Array, qpos: Array) -> Array:
        """Return the speeds of the coordinates, (n,)."""
        if self._function is not None:
            values = self._function(qpos[self._at])
            self._matrix[self._entries[:, 0], self._entries[:, 1]] = [float(v) for v in values]
        return self._matrix @ speeds


class JointServos:
    """Servos of all coordinates of a robot but those of its gripper.

    Parameters
    ----------
    spec
        Specification to which servos and armature are added.
    compiled
        Its ``MjModel`` without servos.
    coordinates
        Positions and velocities of the model in ``compiled``.
    driven
        Coordinates with a servo.
    model
        The model, which states the effort of its joints.
    step
        Time step of the simulation [s].
    bandwidth
        w [1/s].
    seed
        Seed of the sampled configurations.
    remark
        Receives the assumptions.
    """

    def __init__(
        self,
        spec: Any,
        compiled: Any,
        coordinates: MujocoCoordinates,
        driven: Sequence[Symbol],
        model: ModelView,
        step: float,
        bandwidth: float,
        seed: int,
        remark: Callable[[str], None],
    ) -> None:
        engine = mujoco()
        self.coordinates = tuple(driven)
        self._at = np.array([coordinates.address[s] for s in driven], dtype=int)
        self._dof = np.array([coordinates.dof[s] for s in driven], dtype=int)
        self._step, self._ahead = step, 2 / bandwidth
        inertia = sampled_inertia(compiled, coordinates, self._dof, seed)
        assumed, effort = [], stated_effort(model)
        base = base_coordinates(model)
        for symbol, i in zip(driven, inertia.tolist(), strict=True):
            joint, armature = spec.joint(symbol.path), 0.0 if symbol in base else _ARMATURE * i
            joint.armature += armature
            i += armature
            force = effort.get(symbol, 0.0)
            if not force > 0:
                force = max(_ACCELERATION * i, _BASE_FORCE if symbol in base else 0.0)
                assumed.append(f"{symbol} {force:.3g}")
            kp, kv = i * bandwidth**2, 2 * i * bandwidth
            servo = spec.add_actuator(name=f"{symbol.path}/servo", target=symbol.path)
            servo.trntype, servo.biastype = engine.mjtTrn.mjTRN_JOINT, engine.mjtBias.mjBIAS_AFFINE
            servo.gainprm[0], servo.biasprm[:3] = kp, (0, -kp, -kv)
            servo.forcelimited, servo.forcerange = True, (-force, force)
        largest, smallest = (f(inertia) if len(inertia) else 0.0 for f in (np.max, np.min))
        remark(
            f"servos of bandwidth {bandwidth:g}/s drive {len(driven)} coordinates, with the largest "
            f"inertia of {_CONFIGURATIONS} configurations ({smallest:.2g} to {largest:.3g} kg m² or kg) and "
            f"the effort of the model; joints have {_ARMATURE:g} of it as armature"
        )
        if assumed:
            remark(f"no effort is stated; servos have [N], [N m]: {', '.join(assumed)}")

    def connect(self, compiled: Any) -> None:
        """Find the servos in the final ``MjModel``."""
        names = [f"{s.path}/servo" for s in self.coordinates]
        self._actuators = np.array([compiled.actuator(name).id for name in names], dtype=int)

    def reset(self, data: Any) -> None:
        """Set all set points to the present positions."""
        self._target: Array = data.qpos[self._at].copy()
        data.ctrl[self._actuators] = self._target

    def stop(self, data: Any) -> None:
        """Move all set points to the present positions."""
        self._target = data.qpos[self._at].copy()

    def drive(self, data: Any, rates: Array) -> None:
        """Move the set points by one time step at speeds (n,), and set the controls."""
        q = data.qpos[self._at]
        self._target += self._step * rates
        np.clip(self._target, q - _LEAD, q + _LEAD, out=self._target)
        # The servo is τ = kp (u - q) - kv q̇, and 2/w = kv/kp.
        data.ctrl[self._actuators] = self._target + self._ahead * rates


def sampled_inertia(compiled: Any, coordinates: MujocoCoordinates, dofs: Array, seed: int) -> Array:
    """Return the largest inertia about each joint in sampled configurations (n,); what follows counts."""
    engine = mujoco()
    data, random, move = engine.MjData(compiled), np.random.default_rng(seed), coordinates.sampler()
    columns = np.ascontiguousarray(coordinates.followers[:, dofs].T)
    largest, product = np.zeros(len(dofs)), np.zeros(compiled.nv)
    for _ in range(_CONFIGURATIONS):
        move(data, random)
        engine.mj_kinematics(compiled, data)
        engine.mj_comPos(compiled, data)
        engine.mj_crb(compiled, data)
        for k, column in enumerate(columns):
            engine.mj_mulM(compiled, data, product, column)
            largest[k] = max(largest[k], float(column @ product))
    return largest


def base_coordinates(model: ModelView) -> set[Symbol]:
    """Return the coordinates of bodies that move in the plane or in space: mobile bases."""
    records = model.articulations.values()
    return {s for r in records if len(r.coordinates) >= _PLANAR for s in r.coordinates}


def stated_effort(model: ModelView) -> dict[Symbol, float]:
    """Return the effort by coordinate that a model states [N], [N m]."""
    efforts: dict[Symbol, float] = {}
    for record in model.articulations.values():
        effort = dict(record.dynamics).get("effort")
        if len(record.coordinates) == 1 and isinstance(effort, (int, float)) and math.isfinite(effort):
            efforts[record.coordinates[0]] = float(effort)
    return efforts
