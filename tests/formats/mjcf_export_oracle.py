"""Poses of an MJCF file in MuJoCo, by the coordinates of the model that it was written from."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

mujoco = pytest.importorskip("mujoco")

Matrix = npt.NDArray[np.float64]
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)


class MujocoReference:
    """Model in MuJoCo without its meshes, at the configuration set by :meth:`place`."""

    def __init__(self, file: Path) -> None:
        text = re.sub(r'<geom [^>]*type="mesh"[^>]*/>|<(mesh|texture|material) [^>]*/>', "", file.read_text())
        self.model = mujoco.MjModel.from_xml_string(re.sub(r' material="[^"]*"', "", text))
        self.data = mujoco.MjData(self.model)

    def place(self, values: dict[str, float]) -> None:
        """Set the joints that are coordinates, and those that follow them by an equality."""
        m, q = self.model, self.data.qpos
        for number in range(m.njnt):
            name, start, kind = m.joint(number).name, m.jnt_qposadr[number], m.jnt_type[number]
            if kind in (_FREE, _BALL):
                turn = np.array([values[f"{name}/q{c}"] for c in "wxyz"])
                turn /= np.linalg.norm(turn)
                if kind == _FREE:
                    # MuJoCo counts from the world, the coordinates from where the body is placed.
                    rest = m.qpos0[start : start + 7]
                    offset, whole = np.zeros(3), np.zeros(4)
                    mujoco.mju_rotVecQuat(offset, np.array([values[f"{name}/{c}"] for c in "xyz"]), rest[3:])
                    mujoco.mju_mulQuat(whole, rest[3:], turn)
                    q[start : start + 7] = [*(rest[:3] + offset), *whole]
                else:
                    q[start : start + 4] = turn
            elif name in values:
                q[start] = values[name]
        for number in range(m.neq):
            if m.eq_type[number] == _JOINT:
                follower, leader = m.eq_obj1id[number], m.eq_obj2id[number]
                x = values[m.joint(leader).name]
                q[m.jnt_qposadr[follower]] = np.polynomial.polynomial.polyval(x, m.eq_data[number][:5])
        mujoco.mj_fwdPosition(m, self.data)

    def pose(self, body: str) -> Matrix:
        """Return world_T_body."""
        there, result = self.data.body(body), np.eye(4)
        result[:3, :3], result[:3, 3] = there.xmat.reshape(3, 3), there.xpos
        return result

    @property
    def violation(self) -> float:
        """Largest violation of an equality."""
        rows = self.data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        return float(np.abs(self.data.efc_pos[rows]).max(initial=0.0))
