"""Inverse kinematics of arms: targets, starts and the meaning of solved, which all libraries share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from time import thread_time_ns
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.formats import load
from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse.symbols import Symbol

from .control_workloads import export_urdf

POSITION_TOLERANCE, ANGLE_TOLERANCE, LIMIT_TOLERANCE = 1e-4, 1e-3, 1e-6
"""Largest errors of a solution [m], [rad], and beyond limits [m], [rad]."""

STARTS, BUDGET = 20, 0.01
"""Number of starts of a target, and CPU time [s]."""

ARMS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
        "ur5": ("ur_description/urdf/ur5_robot.urdf", "ee_link"),
        "tiago": ("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"),
        "pr2": ("pr2_description/robots/pr2.urdf", "r_gripper_tool_frame"),
        "fetch": ("fetch_description/robots/fetch.urdf", "gripper_link"),
    }
)
"""Files and frames of arms by name."""


@dataclass(frozen=True)
class ReachingProblem:
    """Poses that an arm can reach, with the starts of their searches."""

    model: Model
    frame: str  # frame that reaches
    joints: tuple[Symbol, ...]  # joints that move the frame
    lower: Array  # their limits [m], [rad], shape (n,); ±π for continuous joints
    upper: Array
    bounded: Array  # true for joints with limits, shape (n,)
    targets: Array  # poses of the frame at uniform states within limits, shape (count, 4, 4)
    # uniform states within limits, shape (count, starts, n); the first is the middle of the limits
    starts: Array

    def urdf(self) -> str:
        """Return the robot as URDF text without shapes, all joints fixed that do not move the frame."""
        kept = set(self.joints)
        return export_urdf(
            self.model,
            [
                name
                for name, articulation in self.model.articulations.items()
                if articulation.kind != "fixed" and not kept.intersection(articulation.coordinates)
            ],
        )

    def names(self) -> list[str]:
        """Return the names of the joints."""
        return [joint.path for joint in self.joints]

    def within_limits(self, q: Array) -> bool:
        """Return True for a state within limits."""
        slack = np.minimum(q - self.lower, self.upper - q)
        return bool(np.all(slack[self.bounded] >= -LIMIT_TOLERANCE))


def make_reaching_problem(arm: str, count: int, starts: int = STARTS, seed: int = 0) -> ReachingProblem:
    """Return targets and starts for an arm; the first start is the middle of the limits."""
    file, frame = ARMS[arm]
    model = load(file, prefix="")
    pose = model.fk(frame)
    joints = pose.symbols
    limits = np.array([model.limits(joint) for joint in joints])
    bounded = np.isfinite(limits).all(axis=1)
    lower, upper = np.where(bounded, limits.T, [[-np.pi], [np.pi]])
    random = np.random.default_rng(seed)
    states = random.uniform(lower, upper, (count, len(joints)))
    searches = random.uniform(lower, upper, (count, starts, len(joints)))
    searches[:, 0] = np.clip(0.5 * (lower + upper), lower, upper)
    function = compile(pose, joints)
    targets = np.array([function(state) for state in states])
    return ReachingProblem(model, frame, joints, lower, upper, bounded, targets, searches)


class IterativeSolver(Protocol):
    """Iterative inverse kinematics of a library."""

    iterations: int  # largest number of iterations from one start

    def aim(self, target: Array) -> None:
        """Set the target pose, (4, 4)."""

    def start(self, q: Array) -> None:
        """Set the joint positions."""

    def iterate(self) -> float:
        """Do one iteration; return the largest change of a joint [m], [rad]."""

    def errors(self) -> tuple[float, float]:
        """Return the errors of position [m] and orientation [rad]."""

    def positions(self) -> Array:
        """Return the joint positions."""


@dataclass(frozen=True, slots=True)
class Search:
    """Search for joint positions that reach a target."""

    solved: bool  # true if a start led to the target within limits
    starts: int  # number of starts used
    iterations: int
    seconds: float  # CPU time [s]


def search(solver: IterativeSolver, problem: ReachingProblem, index: int, budget: float) -> Search:
    """Solve one target from start after start, until solved or the CPU time [s] is spent."""
    begin = thread_time_ns()
    end = begin + int(budget * 1e9) if np.isfinite(budget) else np.inf
    solver.aim(problem.targets[index])
    total = 0
    for used, start in enumerate(problem.starts[index], 1):
        solver.start(start)
        for _ in range(solver.iterations):
            change = solver.iterate()
            total += 1
            position, angle = solver.errors()
            now = thread_time_ns()
            if position <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE:
                if problem.within_limits(solver.positions()):
                    return Search(now <= end, used, total, (now - begin) * 1e-9)
                break
            if now > end:
                return Search(False, used, total, (now - begin) * 1e-9)
            if not change > STALLED:
                break
    return Search(False, len(problem.starts[index]), total, (thread_time_ns() - begin) * 1e-9)


STALLED = 1e-6
"""Change of all joints [m], [rad] below which a start is given up."""


def searches(solver: IterativeSolver, problem: ReachingProblem, budget: float = BUDGET) -> Iterator[Search]:
    """Yield the search for each target."""
    for index in range(len(problem.targets)):
        yield search(solver, problem, index, budget)


def summarise(results: list[Search]) -> dict[str, Any]:
    """Return the success rate, and the median and mean CPU time of all searches [s]."""
    seconds = np.array([result.seconds for result in results])
    return {
        "solved": float(np.mean([result.solved for result in results])),
        "median": float(np.median(seconds)),
        "mean": float(np.mean(seconds)),
        "iterations": float(np.mean([result.iterations for result in results])),
    }
