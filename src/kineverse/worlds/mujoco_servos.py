"""Servos of a robot in MuJoCo: speeds of a model become forces on joints.

A servo is a spring and a damper on a set point q_s that moves with the speed v,

    τ = I w² (q_s - q) + 2 I w (v - q̇),    |τ| <= effort,

with the inertial forces of the acceleration of v. It is critically damped with the bandwidth w. I is the
largest inertia about the joint in sampled configurations: with that of one configuration, such as a stretched
arm, a joint would be too soft in others. v reaches the commanded speed with an acceleration that the effort
allows.

Spring and damper correct what the inertial forces leave, and press on what stops the robot. So they have a
limit of their own, the force ``press`` at a slide and ``press`` times the longest lever at a hinge, and the
set point stays so near the joint that the spring alone does not exceed it: a servo that something stops does
not wind up. What presses on a robot at rest is held by each joint between it and the floor, so the weakest
of them limits the force, and the two slides of a base do it together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import as_expression
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .mujoco_state import MujocoCoordinates

BANDWIDTH = 80.0  # bandwidth w [1/s]: a robot stands still some 50 ms after its speeds are zero
_LEAD = 0.05  # largest distance of a set point from its joint [m], [rad]; less for a servo of much inertia
_ARMATURE = 0.1  # part of the largest inertia that is added to a joint as that of its motor
_ACCELERATION, _TRACTION = 20.0, 6.0
"""Acceleration that a servo without a stated effort can give to the largest inertia [m/s²], [rad/s²], and
that of a base that slides along the floor: its wheels have some friction of 0.6."""
_RAMP, _RESERVE = 0.05, 0.8  # time from rest to the limit of a speed [s], part of the effort to accelerate
_CONFIGURATIONS = 40
_PLANAR = 3


class SpeedMap:
    """Map from speeds of a robot to those of its coordinates, by the rates of the model."""

    def __init__(
        self, model: ModelView, coordinates: Sequence[Symbol], address: Mapping[Symbol, int]
    ) -> None:
        rows = [dict(model.rates.row(c) or {c.derivative(): as_expression(1.0)}) for c in coordinates]
        self.speeds = tuple(dict.fromkeys(s for row in rows for s in row))
        column = {speed: k for k, speed in enumerate(self.speeds)}
        self.columns = {key: column.get(s) for s in model.speeds for key in (s, str(s))}
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
                "is the position of no joint in MuJoCo. Replace that part of the robot."
            )
        self._at = np.array([address[s] for s in inputs], dtype=int)

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
    """Servos of all coordinates of a robot but those of its gripper."""

    def __init__(
        self,
        spec: Any,
        compiled: Any,
        coordinates: MujocoCoordinates,
        driven: Sequence[Symbol],
        model: ModelView,
        step: float,
        bandwidth: float,
        press: float,
        seed: int,
        remark: Callable[[str], None],
    ) -> None:
        engine = mujoco()
        self.coordinates = tuple(driven)
        self._at = np.array([coordinates.address[s] for s in driven], dtype=int)
        self._dof = np.array([coordinates.dof[s] for s in driven], dtype=int)
        self._ties = np.ascontiguousarray(coordinates.followers[:, self._dof])
        self._step, self._ahead = step, 2 / bandwidth
        inertia = sampled_inertia(compiled, coordinates, self._dof, seed)
        accelerations: list[float] = []
        forces: list[float] = []
        weight, lever = _sampled_loads(compiled, coordinates, self._dof, seed)
        raised: list[str] = []
        assumed, effort = [], stated_effort(model)
        base = base_coordinates(model)
        sliding = [spec.joint(s.path).type == engine.mjtJoint.mjJNT_SLIDE for s in driven]
        self._base = np.array([s in base and k for s, k in zip(driven, sliding, strict=True)], dtype=bool)
        for symbol, i in zip(driven, inertia.tolist(), strict=True):
            joint, armature = spec.joint(symbol.path), 0.0 if symbol in base else _ARMATURE * i
            joint.armature += armature
            joint.actfrclimited = False  # the servo has the limit
            i += armature
            force = effort.get(symbol, 0.0)
            if not force > 0:
                force = i * (_TRACTION if self._base[len(forces)] else _ACCELERATION)
                assumed.append(f"{symbol} {force:.3g}")
            elif force < (load := float(weight[len(forces)])):
                raised.append(f"{symbol} {force:g} to {load:.3g}")
                force = load
            forces.append(force)
            fastest = float(np.abs(model.limits(symbol.derivative())).min())
            ramp = (fastest if 0 < fastest < math.inf else 1.0) / _RAMP
            accelerations.append(min(_RESERVE * force / i, ramp))
            kp, kv = i * bandwidth**2, 2 * i * bandwidth
            servo = spec.add_actuator(name=f"{symbol.path}/servo", target=symbol.path)
            servo.trntype, servo.biastype = engine.mjtTrn.mjTRN_JOINT, engine.mjtBias.mjBIAS_AFFINE
            servo.gainprm[0], servo.biasprm[:3] = kp, (0, -kp, -kv)
            servo.forcelimited, servo.forcerange = True, (-force, force)
        self._acceleration: Array = np.array(accelerations)
        self.efforts = dict(zip(driven, forces, strict=True))
        # What moves no shape presses on nothing.
        self._press, self._presses = press, np.where(lever > 0, press * lever, math.inf)
        largest, smallest = (f(inertia) if len(inertia) else 0.0 for f in (np.max, np.min))
        remark(
            f"servos of bandwidth {bandwidth:g}/s drive {len(driven)} coordinates, with the largest "
            f"inertia of {_CONFIGURATIONS} configurations ({smallest:.2g} to {largest:.3g} kg m² or kg) and "
            f"the effort of the model; joints have {_ARMATURE:g} of it as armature"
        )
        remark(f"what stops a servo is pressed with {press:g} N at most, as far as its effort goes")
        if raised:
            remark(f"the effort is raised where it is less than the weight, [N], [N m]: {', '.join(raised)}")
        if assumed:
            remark(f"no effort is stated; servos have [N], [N m]: {', '.join(assumed)}")

    def connect(self, compiled: Any) -> None:
        """Find the servos in the final ``MjModel``."""
        names = [f"{s.path}/servo" for s in self.coordinates]
        self._actuators = np.array([compiled.actuator(name).id for name in names], dtype=int)
        joints = [compiled.joint(s.path).id for s in self.coordinates]
        limited = compiled.jnt_limited[joints].astype(bool)
        self._lower: Array = np.where(limited, compiled.jnt_range[joints, 0], -np.inf)
        self._upper: Array = np.where(limited, compiled.jnt_range[joints, 1], np.inf)
        self._compiled, self._product = compiled, np.zeros(compiled.nv)
        self._stiffness: Array = compiled.actuator_gainprm[self._actuators, 0].copy()
        self._lead = np.minimum(_LEAD, self._presses / self._stiffness)

    def reset(self, data: Any) -> None:
        """Set all set points to the present positions."""
        self._target: Array = data.qpos[self._at].copy()
        self._rates = np.zeros(len(self._at))
        data.ctrl[self._actuators] = self._target

    def drive(self, data: Any, rates: Array) -> None:
        """Move the set points by one time step at speeds (n,), and set the controls."""
        q, most = data.qpos[self._at], self._step * self._acceleration
        change = np.clip(rates - self._rates, -most, most)
        self._rates = self._rates + change
        self._target += self._step * self._rates
        np.clip(self._target, q - self._lead, q + self._lead, out=self._target)
        np.clip(self._target, self._lower, self._upper, out=self._target)
        # The servo is τ = kp (u - q) - kv q̇, and 2/w = kv/kp.
        damped = q + self._ahead * data.qvel[self._dof]
        control = damped + self._limit(self._target + self._ahead * self._rates - damped)
        if change.any():
            mujoco().mj_mulM(self._compiled, data, self._product, self._ties @ (change / self._step))
            control += (self._ties.T @ self._product) / self._stiffness
        data.ctrl[self._actuators] = control

    def _limit(self, feedback: Array) -> Array:
        """Return the part of a feedback, (n,) in units of the set points, that the limits of forces allow."""
        forces = np.clip(self._stiffness * feedback, -self._presses, self._presses)
        pushed = float(np.linalg.norm(forces[self._base]))
        if pushed > self._press:
            forces[self._base] *= self._press / pushed
        return forces / self._stiffness


def sampled_inertia(compiled: Any, coordinates: MujocoCoordinates, dofs: Array, seed: int) -> Array:
    """Return the largest inertia about each joint in sampled configurations (n,); what follows counts."""
    engine = mujoco()
    data, random, move = engine.MjData(compiled), np.random.default_rng(seed), coordinates.mover()
    columns = np.ascontiguousarray(coordinates.followers[:, dofs].T)
    largest, product = np.zeros(len(dofs)), np.zeros(compiled.nv)
    for _ in range(_CONFIGURATIONS):
        move(data, random.uniform)
        engine.mj_kinematics(compiled, data)
        engine.mj_comPos(compiled, data)
        engine.mj_crb(compiled, data)
        for k, column in enumerate(columns):
            engine.mj_mulM(compiled, data, product, column)
            largest[k] = max(largest[k], float(column @ product))
    return largest


def _sampled_loads(
    compiled: Any, coordinates: MujocoCoordinates, dofs: Array, seed: int
) -> tuple[Array, Array]:
    """Return the largest force of gravity on each joint, and the motion of the farthest point that it moves.

    Both are the largest in sampled configurations, (n,): [N], [N m], and [m/m], [m/rad].
    """
    engine, data, random = mujoco(), mujoco().MjData(compiled), np.random.default_rng(seed)
    move, columns = coordinates.mover(), np.ascontiguousarray(coordinates.followers[:, dofs])
    weights, levers = np.zeros(len(dofs)), np.zeros(len(dofs))
    slide, turn = np.zeros((3, compiled.nv)), np.zeros((3, compiled.nv))
    roots = compiled.body_rootid[compiled.dof_bodyid[dofs]]
    own = np.flatnonzero(np.isin(compiled.body_rootid[compiled.geom_bodyid], roots)).tolist()
    for _ in range(_CONFIGURATIONS):
        move(data, random.uniform)
        engine.mj_forward(compiled, data)
        np.maximum(weights, np.abs(data.qfrc_gravcomp @ columns), out=weights)
        for geom in own:
            body = int(compiled.geom_bodyid[geom])
            engine.mj_jac(compiled, data, slide, turn, data.geom_xpos[geom], body)
            reaches = np.linalg.norm(slide @ columns, axis=0)
            reaches += compiled.geom_rbound[geom] * np.linalg.norm(turn @ columns, axis=0)
            np.maximum(levers, reaches, out=levers)
    return weights, levers


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
