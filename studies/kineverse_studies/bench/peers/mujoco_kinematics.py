"""Forward kinematics and Jacobians of the robot in MuJoCo."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from kineverse.lie import Array, transform
from kineverse_studies.bench.workloads import BenchmarkRobot, strip_shapes


class MujocoRobot:
    """Robot in MuJoCo, with all links and without shapes."""

    def __init__(self, robot: BenchmarkRobot) -> None:
        self.model: Any = mujoco.MjModel.from_xml_string(make_robot_mjcf(robot))
        self.data: Any = mujoco.MjData(self.model)
        self.body: int = self.model.body(robot.frame).id
        self.jacobian = np.zeros((6, self.model.nv))
        self.columns: list[int] = [int(self.model.joint(s.path).dofadr[0]) for s in robot.chain]

    def rows(self, positions: dict[str, Array]) -> list[Array]:
        """Return configurations in the order of MuJoCo's joints."""
        columns = [positions[self.model.joint(k).name] for k in range(self.model.njnt)]
        return list(np.ascontiguousarray(np.column_stack(columns)))

    def pose_and_jacobian(self, row: Array) -> tuple[Array, Array]:
        """Return the frame's pose (4, 4) and world-aligned Jacobian (6, n), columns in Kineverse's order."""
        self.data.qpos[:] = row
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_jacBody(self.model, self.data, self.jacobian[:3], self.jacobian[3:], self.body)
        return self.pose(self.body), self.jacobian[:, self.columns]

    def pose(self, body: int) -> Array:
        """Return the pose of a body, (4, 4)."""
        return transform(self.data.xmat[body].reshape(3, 3), self.data.xpos[body])


def make_robot_mjcf(robot: BenchmarkRobot) -> str:
    """Return the robot's file with options for MuJoCo.

    By default MuJoCo requires mesh files, merges fixed links, and refuses moving links without inertia.
    """
    return add_mujoco_options(ElementTree.fromstring(strip_shapes(robot.file)))


def add_mujoco_options(root: ElementTree.Element) -> str:
    """Return the text of a URDF without shapes, with options that MuJoCo needs."""
    options = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-6", "boundinertia": "1e-9"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    return ElementTree.tostring(root, encoding="unicode")
