"""Forward kinematics and Jacobians of the robot in pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from kineverse.lie import Array
from kineverse_studies.bench.workloads import BenchmarkRobot


class PinocchioRobot:
    def __init__(self, robot: BenchmarkRobot, reduced: bool = False) -> None:
        model = pin.buildModelFromUrdf(str(robot.file))
        moving = [symbol.path for symbol in robot.chain]
        if reduced:
            others = [k for k in range(1, model.njoints) if model.names[k] not in moving]
            model = pin.buildReducedModel(model, others, pin.neutral(model))
        self.model: Any = model
        self.data: Any = model.createData()
        self.frame: int = model.getFrameId(robot.frame, pin.FrameType.BODY)
        self.pose: Any = self.data.oMf[self.frame]
        self.columns: list[int] = [model.joints[model.getJointId(name)].idx_v for name in moving]

    def rows(self, positions: dict[str, Array]) -> list[Array]:
        """Return configurations in pinocchio's coordinates; a continuous joint has cosine and sine."""
        columns: list[Array] = []
        for name, joint in list(zip(self.model.names, self.model.joints, strict=True))[1:]:
            angle = positions[name]
            columns += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        return list(np.ascontiguousarray(np.column_stack(columns)))

    def pose_and_jacobian(self, row: Array) -> tuple[Array, Array]:
        """Return the frame's pose (4, 4) and world-aligned Jacobian (6, n), columns in Kineverse's order."""
        jacobian = pin.computeFrameJacobian(
            self.model, self.data, row, self.frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        return self.pose.homogeneous, jacobian[:, self.columns]
