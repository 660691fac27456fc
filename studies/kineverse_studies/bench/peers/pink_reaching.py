"""Inverse kinematics with restarts by pink, and by pinocchio's example loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pink
import pinocchio as pin
from pink.limits import ConfigurationLimit
from pink.tasks import FrameTask

from kineverse.lie import Array
from kineverse_studies.bench.reaching import ReachingProblem

from .pink_control import SOLVER


class _PinocchioArm:
    """Arm in pinocchio, with joint positions in Kineverse's order."""

    def __init__(self, problem: ReachingProblem) -> None:
        self.model: Any = pin.buildModelFromXML(problem.urdf())
        self._joints = [self.model.joints[self.model.getJointId(name)] for name in problem.names()]
        self._neutral = pin.neutral(self.model)

    def to_pinocchio(self, positions: Array) -> Array:
        """Return pinocchio's coordinates; a continuous joint has cosine and sine."""
        q = self._neutral.copy()
        for joint, value in zip(self._joints, positions, strict=True):
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                value if joint.nq == 1 else (np.cos(value), np.sin(value))
            )
        return np.array(q)

    def from_pinocchio(self, q: Array) -> Array:
        """Return joint positions."""
        return np.array(
            [q[j.idx_q] if j.nq == 1 else np.arctan2(q[j.idx_q + 1], q[j.idx_q]) for j in self._joints]
        )


class PinkReaching:
    """Full Gauss-Newton steps of pink within the limits of positions; see :class:`.IterativeSolver`."""

    def __init__(self, problem: ReachingProblem, iterations: int = 25, lm_damping: float = 1e-2) -> None:
        self.iterations = iterations
        self._arm = _PinocchioArm(problem)
        model = self._arm.model
        self._configuration: Any = pink.Configuration(
            model, model.createData(), self._arm.to_pinocchio(problem.starts[0, 0])
        )
        self._task = FrameTask(problem.frame, position_cost=1.0, orientation_cost=1.0, lm_damping=lm_damping)
        self._limits = [ConfigurationLimit(model)]

    def aim(self, target: Array) -> None:
        """Set the target pose."""
        self._task.set_target(pin.SE3(target))

    def start(self, q: Array) -> None:
        """Set the joint positions."""
        self._configuration.update(self._arm.to_pinocchio(q))

    def iterate(self) -> float:
        """Do one step."""
        step = pink.solve_ik(
            self._configuration,
            [self._task],
            1.0,
            solver=SOLVER,
            damping=1e-8,
            limits=self._limits,
            safety_break=False,
        )
        self._configuration.integrate_inplace(step, 1.0)
        return float(np.abs(step).max())

    def errors(self) -> tuple[float, float]:
        """Return the errors of position and orientation."""
        error = self._task.compute_error(self._configuration)
        return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))

    def positions(self) -> Array:
        """Return the joint positions."""
        return self._arm.from_pinocchio(self._configuration.q)


class PinocchioReaching:
    """Closed-loop inverse kinematics as in pinocchio's example: damped pseudoinverse, no limits.

    Positions are taken modulo 2π before they are compared with limits.
    """

    def __init__(self, problem: ReachingProblem, iterations: int = 1000, rate: float = 0.1) -> None:
        self.iterations = iterations
        self._problem, self._rate = problem, rate
        self._arm = _PinocchioArm(problem)
        self._data: Any = self._arm.model.createData()
        self._frame = self._arm.model.getFrameId(problem.frame, pin.FrameType.BODY)
        self._damping = 1e-12 * np.eye(6)

    def aim(self, target: Array) -> None:
        """Set the target pose."""
        self._target = pin.SE3(target)

    def start(self, q: Array) -> None:
        """Set the joint positions."""
        self._q = self._arm.to_pinocchio(q)
        self._look()

    def iterate(self) -> float:
        """Do one step."""
        model, data = self._arm.model, self._data
        jacobian = pin.computeFrameJacobian(model, data, self._q, self._frame, pin.ReferenceFrame.LOCAL)
        jacobian = -pin.Jlog6(self._offset.inverse()) @ jacobian
        step = -jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + self._damping, self._error)
        self._q = pin.integrate(model, self._q, step * self._rate)
        self._look()
        return float(np.abs(step).max())

    def errors(self) -> tuple[float, float]:
        """Return the errors of position and orientation."""
        return float(np.linalg.norm(self._error[:3])), float(np.linalg.norm(self._error[3:]))

    def positions(self) -> Array:
        """Return the joint positions, those of revolute joints within π of the middle of the limits."""
        q, middle = self._arm.from_pinocchio(self._q), 0.5 * (self._problem.lower + self._problem.upper)
        turns = np.round((q - middle) / (2.0 * np.pi))
        return np.array(q - 2.0 * np.pi * turns * self._revolute)

    @property
    def _revolute(self) -> Array:
        return np.array(["Prismatic" not in joint.shortname() for joint in self._arm._joints], float)

    def _look(self) -> None:
        pin.forwardKinematics(self._arm.model, self._data, self._q)
        pose = pin.updateFramePlacement(self._arm.model, self._data, self._frame)
        self._offset = pose.actInv(self._target)
        self._error = pin.log(self._offset).vector
