"""Drive of a gripper in MuJoCo: speeds until both fingers touch, then a force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.grasping.gripper_detection import Gripper
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .mujoco_servos import sampled_inertia
from .mujoco_state import MujocoContacts, MujocoCoordinates

_TOUCH_FORCE = 1.0  # normal force of each finger [N] above which a body between them is held
_FINGER_MASS = 2.0  # of a finger with its motor [kg]: light ones do not carry the force of their ties
_SMALLEST_LEVER = 0.02
_STIFFNESS = 10.0  # speed by the distance of a finger from its set point [1/s]
_LEAD = 0.01  # largest distance of the gap between the fingers from that of the set point [m]
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
        self._lead = _LEAD / np.maximum(leverage, 1e-3)
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
        self._damping = 0.5 * sampled_inertia(compiled, self._map, self._dof, seed) / self._step
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
            self.is_gripping = True
            self._bind(data)
        if self.is_gripping:
            data.ctrl[self._actuators] = self._closing * self._limit
            return
        q = data.qpos[self._at]
        self._target += self._step * rates
        np.clip(self._target, q - self._lead, q + self._lead, out=self._target)
        data.ctrl[self._actuators] = self._damping * (rates + _STIFFNESS * (self._target - q))

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

    def _bind(self, data: Any) -> None:
        """Weld the held body to the hand, where grasps are ties."""
        name = self.pressed(data)
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
