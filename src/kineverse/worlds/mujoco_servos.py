"""Servos of a robot and its gripper in MuJoCo: speeds of a model become forces on joints.

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
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .mujoco_state import MujocoContacts, MujocoCoordinates

BANDWIDTH = 80.0  # bandwidth w [1/s]: a robot stands still some 50 ms after its speeds are zero
_LEAD = 0.05  # largest distance of a set point from its joint [m], [rad]; less for a servo of much inertia
_ARMATURE = 0.1  # part of the largest inertia that is added to a joint as that of its motor
_GEARED = 0.02  # least armature of a hinge [kg m²], as of a geared motor: else a light wrist is weak
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
        inertia = _sampled_inertia(compiled, coordinates, self._dof, seed)
        accelerations: list[float] = []
        forces: list[float] = []
        weight, lever = _sampled_loads(compiled, coordinates, self._dof, seed)
        raised: list[str] = []
        assumed, effort = [], stated_effort(model)
        base = base_coordinates(model)
        sliding = [spec.joint(s.path).type == engine.mjtJoint.mjJNT_SLIDE for s in driven]
        self._base = np.array([s in base and k for s, k in zip(driven, sliding, strict=True)], dtype=bool)
        for symbol, i in zip(driven, inertia.tolist(), strict=True):
            joint, slides = spec.joint(symbol.path), sliding[len(forces)]
            armature = 0.0 if symbol in base else max(_ARMATURE * i, 0.0 if slides else _GEARED)
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
            f"the effort of the model; armature is {_ARMATURE:g} of it, at hinges at least {_GEARED:g} kg m²"
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

    def take_over(self, other: JointServos, data: Any) -> None:
        """Go on with the speeds of the servos of another world."""
        rates = dict(zip(other.coordinates, other._rates.tolist(), strict=True))
        self.reset(data)
        self._rates[:] = [rates.get(s, 0.0) for s in self.coordinates]

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


def _sampled_inertia(compiled: Any, coordinates: MujocoCoordinates, dofs: Array, seed: int) -> Array:
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


_TOUCH_FORCE = 1.0  # normal force of each finger [N] above which a body between them is held
_FINGER_MASS = 2.0  # of a finger with its motor [kg]: light ones do not carry the force of their ties
_SMALLEST_LEVER = 0.02
_FOLLOWING = 10.0  # speed by the distance of a finger from its set point [1/s]
_MOST_AHEAD = 0.01  # largest distance of the gap between the fingers from that of the set point [m]
_STILL = 1e-6


class GripperDrive:
    """Velocity servo of fingers with a limited force, which becomes a force once both touch one body.

    The force τ of a coordinate q follows from virtual work. For fingers that press with F each,

        τ = F (|∂y_1/∂q| + |∂y_2/∂q|),

    where y_k is the position of a finger at the place of the grasp, along the closing motion.
    """

    def __init__(
        self,
        spec: Any,
        compiled: Any,
        coordinates: MujocoCoordinates,
        gripper: Gripper,
        force: float,
        step: float,
        tie: bool,
        remark: Callable[[str], None],
    ) -> None:
        engine = mujoco()
        self.coordinates: tuple[Symbol, ...] = tuple(gripper.joints)
        missing = [str(s) for s in self.coordinates if s not in coordinates.address]
        if missing or not self.coordinates:
            raise InvalidValueError(
                f"The gripper at '{gripper.hand}' moves by {', '.join(missing) or 'nothing'}, which is no "
                "free coordinate of one joint; give a Gripper with those that open and close the fingers."
            )
        self._gripper, self._force, self._step = gripper, force, step
        self._map, self._closing = (
            coordinates,
            np.sign([gripper.closed[s] - gripper.opened[s] for s in self.coordinates]),
        )
        self._at = np.array([coordinates.address[s] for s in self.coordinates], dtype=int)
        self._dof = np.array([coordinates.dof[s] for s in self.coordinates], dtype=int)
        self._tips = [_deepest(compiled, names) for names in gripper.fingers]
        data = engine.MjData(compiled)
        for symbol, at in zip(self.coordinates, self._at, strict=True):
            data.qpos[at] = (gripper.opened[symbol] + gripper.closed[symbol]) / 2
        coordinates.follow(data.qpos)
        engine.mj_kinematics(compiled, data)
        engine.mj_comPos(compiled, data)
        leverage = self._leverage(compiled, data)
        self._lead = _MOST_AHEAD / np.maximum(leverage, 1e-3)
        levers = np.abs(self._rows(compiled, data)).max(axis=0)
        levers[self._dof] = leverage
        hand = compiled.body(gripper.hand).id
        for k in range(compiled.njnt):
            dof = int(compiled.jnt_dofadr[k])
            # Also joints of fingers that nothing drives, such as springs in series.
            parent = compiled.body_parentid[compiled.jnt_bodyid[k]]
            if coordinates.followers[dof, self._dof].any() or _is_below(compiled, parent, hand):
                lever = max(float(levers[dof]), _SMALLEST_LEVER)
                spec.joint(compiled.joint(k).name).armature += _FINGER_MASS * lever**2
        for symbol in self.coordinates:
            drive = spec.add_actuator(name=f"{symbol.path}/grip", target=symbol.path)
            drive.trntype, drive.biastype = engine.mjtTrn.mjTRN_JOINT, engine.mjtBias.mjBIAS_AFFINE
            drive.forcelimited, drive.forcerange = True, (-force, force)
            spec.joint(symbol.path).actfrclimited = False
        self.tied: str | None = None  # body that is tied to the hand
        self._tie_name = f"{gripper.hand}/tie" if tie else ""
        if tie:
            weld = spec.add_equality(name=self._tie_name, name1=gripper.hand, name2=gripper.fingers[0][0])
            weld.type, weld.objtype = engine.mjtEq.mjEQ_WELD, engine.mjtObj.mjOBJ_BODY
            weld.active = False
            remark(f"grasp='tie': what both fingers touch is welded to '{gripper.hand}', so it cannot slip")
        remark(
            f"the gripper '{gripper.hand}' closes with {force:g} N for each finger by "
            f"{', '.join(map(str, self.coordinates))}; its fingers have {_FINGER_MASS:g} kg of armature each"
        )

    def connect(self, compiled: Any, contacts: MujocoContacts, seed: int) -> None:
        """Find the drives in the final ``MjModel``, and set their gains."""
        self._compiled, self._contacts = compiled, contacts
        names = [f"{s.path}/grip" for s in self.coordinates]
        self._actuators = np.array([compiled.actuator(name).id for name in names], dtype=int)
        # More would chatter where the limit of force switches off what the integrator damps.
        self._damping = 0.5 * _sampled_inertia(compiled, self._map, self._dof, seed) / self._step
        compiled.actuator_biasprm[self._actuators, 2] = -self._damping
        self._tie = compiled.equality(self._tie_name).id if self._tie_name else -1

    def reset(self, data: Any) -> None:
        """Open the grasp: the drives hold the present positions."""
        self.is_gripping = False
        self._target: Array = data.qpos[self._at].copy()
        self.update_limits(data)
        self._release(data)

    def update_limits(self, data: Any) -> None:
        """Set the limits of force by the leverage of the present positions."""
        limit = self._force * self._leverage(self._compiled, data)
        self._limit = limit
        self._compiled.actuator_forcerange[self._actuators, 0] = -limit
        self._compiled.actuator_forcerange[self._actuators, 1] = limit

    def drive(self, data: Any, rates: Array) -> None:
        """Set the controls for one time step at speeds of the fingers (n,)."""
        closing = rates * self._closing
        if (closing < -_STILL).any():
            if self.is_gripping:
                self.is_gripping = False
                self._target = data.qpos[self._at].copy()
                self._release(data)
        elif not self.is_gripping and (closing > _STILL).any() and self.pressed(data) is not None:
            self.hold(data)
        if self.is_gripping:
            data.ctrl[self._actuators] = self._closing * self._limit
            return
        q = data.qpos[self._at]
        self._target += self._step * rates
        np.clip(self._target, q - self._lead, q + self._lead, out=self._target)
        data.ctrl[self._actuators] = self._damping * (rates + _FOLLOWING * (self._target - q))

    def hold(self, data: Any, body: str | None = None) -> None:
        """Press what is between the fingers; where grasps are ties, bind it, or the body that is named."""
        self.is_gripping = True
        data.ctrl[self._actuators] = self._closing * self._limit
        self._bind(data, body or self.pressed(data))

    def pressed(self, data: Any) -> str | None:
        """Return the body that both fingers press, the one with most force; None if there is none."""
        result = {body: min(forces) for body, forces in self._contacts.grip(data).items()}
        best = max(result, key=result.__getitem__, default=None)
        return best if best is not None and result[best] > _TOUCH_FORCE else None

    def _leverage(self, compiled: Any, data: Any) -> Array:
        """Return |∂y_1/∂q| + |∂y_2/∂q| by coordinate (n,), with all joints that follow."""
        rows = self._rows(compiled, data) @ self._map.followers[:, self._dof]
        total: Array = np.abs(rows).sum(axis=0)
        return total

    def _rows(self, compiled: Any, data: Any) -> Array:
        """Return the Jacobians of the fingers along the closing motion, at the place of the grasp (2, nv)."""
        hand = compiled.body(self._gripper.hand).id
        rotation, grasp = data.xmat[hand].reshape(3, 3), self._gripper.grasp_pose
        point = data.xpos[hand] + rotation @ grasp[:3, 3]
        along, jacobian = rotation @ grasp[:3, 1], np.zeros((3, compiled.nv))
        rows = []
        for tip in self._tips:
            mujoco().mj_jac(compiled, data, jacobian, None, point, tip)
            rows.append(along @ jacobian)
        return np.array(rows)

    def _bind(self, data: Any, name: str | None) -> None:
        """Weld a body to the hand, where grasps are ties."""
        if self._tie < 0 or name is None:
            return
        engine, hand = mujoco(), self._compiled.body(self._gripper.hand).id
        body = self._compiled.body(name).id
        inverse, position, quaternion = np.zeros(4), np.zeros(3), np.zeros(4)
        engine.mju_negQuat(inverse, data.xquat[hand])
        engine.mju_rotVecQuat(position, data.xpos[body] - data.xpos[hand], inverse)
        engine.mju_mulQuat(quaternion, inverse, data.xquat[body])
        self._compiled.eq_obj2id[self._tie] = body
        self._compiled.eq_data[self._tie, :11] = [0, 0, 0, *position, *quaternion, 1]
        data.eq_active[self._tie] = 1
        self.tied = name

    def _release(self, data: Any) -> None:
        self.tied = None
        if self._tie >= 0:
            data.eq_active[self._tie] = 0


def _is_below(compiled: Any, body: int, root: int) -> bool:
    while body not in (0, root):
        body = int(compiled.body_parentid[body])
    return bool(body == root)


def _deepest(compiled: Any, names: Sequence[str]) -> int:
    def depth(body: int) -> int:
        return 0 if body == 0 else 1 + depth(int(compiled.body_parentid[body]))

    return max((int(compiled.body(name).id) for name in names), key=depth)
