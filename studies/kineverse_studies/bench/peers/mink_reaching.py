"""Inverse kinematics with restarts by mink."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import mink
import mujoco
import numpy as np

from kineverse.lie import Array
from kineverse_studies.bench.reaching import ReachingProblem

from .mink_control import SOLVER, remove_masses
from .mujoco_kinematics import add_mujoco_options


class MinkReaching:
    """Full Gauss-Newton steps of mink within the limits of positions; see :class:`.IterativeSolver`."""

    def __init__(self, problem: ReachingProblem, iterations: int = 25, lm_damping: float = 1e-2) -> None:
        self.iterations = iterations
        root = remove_masses(ElementTree.fromstring(problem.urdf()))
        model: Any = mujoco.MjModel.from_xml_string(add_mujoco_options(root))
        self._columns = [int(model.joint(name).qposadr[0]) for name in problem.names()]
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(
            problem.frame, "body", position_cost=1.0, orientation_cost=1.0, lm_damping=lm_damping
        )
        self._limits = [mink.ConfigurationLimit(model)]

    def aim(self, target: Array) -> None:
        """Set the target pose."""
        self._task.set_target(mink.SE3.from_matrix(target))

    def start(self, q: Array) -> None:
        """Set the joint positions."""
        positions = self._configuration.q
        positions[self._columns] = q
        self._configuration.update(positions)

    def iterate(self) -> float:
        """Do one step."""
        step = mink.solve_ik(
            self._configuration, [self._task], 1.0, SOLVER, damping=1e-8, limits=self._limits
        )
        self._configuration.integrate_inplace(step, 1.0)
        return float(np.abs(step).max())

    def errors(self) -> tuple[float, float]:
        """Return the errors of position and orientation."""
        error = self._task.compute_error(self._configuration)
        return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))

    def positions(self) -> Array:
        """Return the joint positions."""
        return np.array(self._configuration.q[self._columns])
