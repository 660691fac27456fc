"""Bounds of speeds and forces beyond which a simulation in MuJoCo is not to be trusted.

They follow from what the robot can do, with a wide margin: what is beyond them was made by the solver.

- *Speed of a coordinate of the robot*: ten times its limit.
- *Speed of any other coordinate*: that at which its farthest point is as fast as what a fall through the
  whole scene adds to twice the largest speed of a point of the robot, as after an elastic impact.
- *Force between the robot and another body*: what stops the whole robot from the largest speed of its base
  within one time step, and ten times what all servos press at their farthest points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kineverse.formats.mjcf.mujoco_api import mujoco
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .mujoco_coordinates import MujocoCoordinates
from .mujoco_servos import base_coordinates

_MARGIN = 10.0
_UNSTATED = 1.0
"""Limit of a speed that states none [m/s], [rad/s]: walking pace."""


class SimulationBounds:
    """Largest credible speeds and force of one ``MjModel``."""

    def __init__(
        self,
        compiled: Any,
        coordinates: MujocoCoordinates,
        model: ModelView,
        efforts: Mapping[Symbol, float],
        is_robot: Callable[[str], bool],
    ) -> None:
        engine, data = mujoco(), mujoco().MjData(compiled)
        self._names = [compiled.joint(int(k)).name for k in compiled.dof_jntid]
        data.qpos[:] = coordinates.positions(coordinates.default)
        engine.mj_forward(compiled, data)
        own = np.array([is_robot(compiled.body(k).name) for k in range(compiled.nbody)])
        limits, base = np.zeros(compiled.nv), np.zeros(compiled.nv)
        for symbol, dof in coordinates.dof.items():
            if own[compiled.dof_bodyid[dof]]:
                limit = float(np.abs(model.limits(symbol.derivative())).min())
                limits[dof] = limit if 0.0 < limit < math.inf else _UNSTATED
        for symbol in base_coordinates(model) & coordinates.dof.keys():
            base[coordinates.dof[symbol]] = limits[coordinates.dof[symbol]]
        levers, fastest = np.zeros(compiled.nv), 0.0
        slide, turn = np.zeros((3, compiled.nv)), np.zeros((3, compiled.nv))
        for geom in range(compiled.ngeom):
            body = int(compiled.geom_bodyid[geom])
            engine.mj_jac(compiled, data, slide, turn, data.geom_xpos[geom], body)
            ways = np.linalg.norm(slide, axis=0) + np.linalg.norm(turn, axis=0) * compiled.geom_rbound[geom]
            np.maximum(levers, ways, out=levers)
            if own[body]:
                fastest = max(fastest, float(limits @ ways))
        fall = math.sqrt(2.0 * abs(float(compiled.opt.gravity[2])) * float(compiled.stat.extent))
        with np.errstate(divide="ignore"):
            others = (2.0 * fastest + fall) / levers
        self.speeds: Array = np.where(limits > 0.0, _MARGIN * limits, others)
        mass = float(compiled.body_mass[own].sum())
        reach = {s: max(float(levers[coordinates.dof[s]]), 1e-3) for s in efforts}
        pressed = sum(effort / reach[s] for s, effort in efforts.items())
        step = float(compiled.opt.timestep)
        self.force = mass * max(float(base.max(initial=0.0)), _UNSTATED) / step + _MARGIN * pressed

    def find_problem(self, data: Any, force: float) -> str:
        """Return what is beyond reason after a time step, or an empty text."""
        speeds = data.qvel
        if not (np.abs(speeds) <= self.speeds).all():
            k = int(np.argmax(np.abs(speeds) / self.speeds))
            return f"'{self._names[k]}' has a speed of {speeds[k]:.3g}, beyond {self.speeds[k]:.3g}"
        if not force <= self.force:
            return f"a force is {force:.3g} N, beyond {self.force:.3g} N"
        return ""
