"""RRT-Connect of VAMP, for its own robots among boxes, cylinders and spheres."""

from __future__ import annotations

import numpy as np
import vamp

from kineverse.lie import to_rpy
from kineverse_studies.bench.planning_problems import Attempt, PublishedProblem


class VampRrtConnect:
    """RRT-Connect of VAMP with its default settings, measured by its own clock.

    As in its own evaluation, cylinders are capsules, and boxes in the problems of the set ``box``, where the
    hand has to come close to one from above.
    """

    def __init__(self, robot: str) -> None:
        configured = vamp.configure_robot_and_planner_with_kwargs(robot, "rrtc")
        self._robot, self._plan, self._settings, _ = configured
        self._environment = vamp.Environment()

    def place(self, problem: PublishedProblem) -> None:
        self._environment = environment = vamp.Environment()
        for _, kind, pose, size in problem.objects:
            T = np.array(pose)
            where, angles = T[:3, 3].tolist(), to_rpy(T[:3, :3]).tolist()
            if kind == "sphere":
                environment.add_sphere(vamp.Sphere(where, size[0]))
            elif kind == "box":
                environment.add_cuboid(vamp.Cuboid(where, angles, [0.5 * edge for edge in size]))
            elif problem.name.startswith("box "):
                height, radius = size
                environment.add_cuboid(vamp.Cuboid(where, angles, [radius, radius, 0.5 * height]))
            else:
                height, radius = size
                environment.add_capsule(vamp.Cylinder(where, angles, radius, height))

    def plan(self, problem: PublishedProblem, seed: int) -> Attempt:
        sampler = self._robot.halton()
        sampler.skip(seed)
        start, goal = problem.start.tolist(), problem.goal.tolist()
        found = self._plan(start, [goal], self._environment, self._settings, sampler)
        seconds = 1e-9 * found.nanoseconds
        return Attempt(bool(found.solved), seconds, seconds)
