"""Benchmark ``inverse_kinematics``: poses that five arms can reach, with restarts, by four libraries."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from time import thread_time_ns
from typing import Any, Protocol

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Goal, InverseKinematics, Target, same_pose
from kineverse.errors import MissingDependencyError, UnknownNameError
from kineverse.formats import load
from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse.symbols import Symbol

from .control_workloads import export_urdf
from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, install_advice

POSITION_TOLERANCE, ANGLE_TOLERANCE, LIMIT_TOLERANCE = 1e-4, 1e-3, 1e-6
"""Largest errors of a solution [m], [rad], and beyond limits [m], [rad]."""
STARTS, BUDGET = 20, 0.01  # number of starts of a target, and CPU time [s]
ARMS: Mapping[str, tuple[str, str]] = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "ee_link"),
    "tiago": ("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"),
    "pr2": ("pr2_description/robots/pr2.urdf", "r_gripper_tool_frame"),
    "fetch": ("fetch_description/robots/fetch.urdf", "gripper_link"),
}
"""Files and frames of arms by name."""


@dataclass(frozen=True)
class ReachingProblem:
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
        return [joint.path for joint in self.joints]

    def within_limits(self, q: Array) -> bool:
        slack = np.minimum(q - self.lower, self.upper - q)
        return bool(np.all(slack[self.bounded] >= -LIMIT_TOLERANCE))


def make_reaching_problem(arm: str, count: int, starts: int = STARTS, seed: int = 0) -> ReachingProblem:
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


class TaskReaching:
    """Full Gauss-Newton steps of pink or mink within limits of positions, an :class:`.IterativeSolver`."""

    iterations = 25
    configuration: Any
    task: Any

    def solve(self) -> Array:
        raise NotImplementedError

    def iterate(self) -> float:
        step = self.solve()
        self.configuration.integrate_inplace(step, 1.0)
        return float(np.abs(step).max())

    def errors(self) -> tuple[float, float]:
        error = self.task.compute_error(self.configuration)
        return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


@dataclass(frozen=True, slots=True)
class Search:
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


STALLED = 1e-6  # change of all joints [m], [rad] below which a start is given up


def searches(solver: IterativeSolver, problem: ReachingProblem, budget: float = BUDGET) -> Iterator[Search]:
    for index in range(len(problem.targets)):
        yield search(solver, problem, index, budget)


OURS, SAME_STARTS = "kineverse", "kineverse, starts of the peers"
PEERS = {
    "pink": ("pink", "PinkReaching"),
    "mink": ("mink", "MinkReaching"),
    "pinocchio's example": ("pink", "PinocchioReaching"),
}
"""Module and class of each peer; the example's loop is in the module of pink."""
LEAST_SOLVED = 99.0  # target share of solved poses [%]
_MORE = 10  # number of our targets per configuration, and of configurations per target of a peer


def measure_inverse_kinematics(settings: BenchmarkSettings) -> BenchmarkResult:
    one = Benchmark("inverse_kinematics", settings)
    installed = [*filter(one.has, ("pink", "mink"))]
    found: dict[tuple[str, str], tuple[Search, ...]] = {}
    count = max(_MORE * settings.configurations, settings.rounds)
    few = max(settings.configurations // _MORE, settings.rounds)
    for arm in settings.progress(tuple(ARMS), one.name, "arm"):
        try:
            problem = make_reaching_problem(arm, count, starts=1)
            peer_problem = make_reaching_problem(arm, few)
        except UnknownNameError:
            one.missing.append(f"the arm {arm} is not among the models")
            continue
        found[arm, OURS] = tuple(search_with_kineverse(problem))
        runs = {SAME_STARTS: search_from_same_starts(peer_problem)}
        for peer, (module, kind) in PEERS.items():
            if module in installed:
                make = getattr(importlib.import_module(f"{__package__}.peers.{module}"), kind)
                runs[peer] = searches(make(peer_problem), peer_problem)
        # All search for one target before the next one, because times drift.
        interleaved = zip(*zip(*runs.values(), strict=True), strict=True)
        found |= {(arm, contender): own for contender, own in zip(runs, interleaved, strict=True)}
    if not found:
        raise MissingDependencyError(f"no arm is among the models. {install_advice('pinocchio')}")
    solved = {pair: 100.0 * float(np.mean([s.solved for s in own])) for pair, own in found.items()}
    for (arm, contender), own in found.items():
        groups = np.array_split([s.seconds for s in own], settings.rounds)
        one.note(f"{contender}, {arm}", "s", *(group.mean() for group in groups))
    for (arm, contender), share in solved.items():
        one.note(f"{contender}, {arm}, solved", "%", share)
    for (arm, contender), share in solved.items():
        if contender == OURS:
            one.compare(f"{OURS}, {arm}, solved", share, "%", LEAST_SOLVED, at_least=True)
        for peer in PEERS if contender == SAME_STARTS else ():
            one.speed(f"{SAME_STARTS}, {arm}", f"{peer}, {arm}", at_least=1.0)
            more = share - solved[arm, peer] if (arm, peer) in solved else None
            name = f"{SAME_STARTS}, {arm}, solved more than {peer}, {arm}"
            one.compare(name, more, "%", 0.0, at_least=True)
    return one.result(
        f"{count} poses of uniform states, solved to {1e3 * POSITION_TOLERANCE:g} mm and "
        f"{1e3 * ANGLE_TOLERANCE:g} mrad within limits, with at most {STARTS} starts and "
        f"{1e3 * BUDGET:g} ms of CPU time; {few} of them in turns with the peers, from the same "
        "starts; mean time of a pose"
    )


class _Reaching:
    """Our solver for a problem; what counts as solved is checked by forward kinematics."""

    def __init__(self, problem: ReachingProblem) -> None:
        pose = problem.model.fk(problem.frame)
        self._problem, self._target = problem, Target("target", problem.targets[0])
        self._solver = InverseKinematics(problem.model, [Goal(same_pose(self._target.expression, pose))])
        self._solver.wait()
        self._forward = compile(pose, problem.joints)

    def search(self, index: int, start: Array, starts: int) -> Search:
        problem, wanted = self._problem, self._problem.targets[index]
        values = dict(zip(problem.joints, start.tolist(), strict=True)) | self._target.values(wanted)
        begin = thread_time_ns()
        result = self._solver.solve(values, starts=starts)
        seconds = (thread_time_ns() - begin) * 1e-9
        q = result.best.vector(problem.joints)
        solved = seconds <= BUDGET and problem.within_limits(q)
        solved = solved and _agree(np.asarray(self._forward(q)), wanted)
        return Search(solved, result.starts, result.iterations, seconds)


def search_with_kineverse(problem: ReachingProblem) -> Iterator[Search]:
    """Yield our search for each target, from the first start and random ones of our own."""
    solver = _Reaching(problem)
    for index, starts in enumerate(problem.starts):
        yield solver.search(index, starts[0], STARTS)


def search_from_same_starts(problem: ReachingProblem) -> Iterator[Search]:
    """Yield our search for each target, from the starts of the problem, one after the other."""
    solver = _Reaching(problem)
    for index, starts in enumerate(problem.starts):
        used, iterations, seconds, solved = 0, 0, 0.0, False
        for start in starts:
            found = solver.search(index, start, 1)
            used, iterations, seconds = used + 1, iterations + found.iterations, seconds + found.seconds
            solved = found.solved and seconds <= BUDGET
            if solved or seconds > BUDGET:
                break
        yield Search(solved, used, iterations, seconds)


def _agree(found: Array, wanted: Array) -> bool:
    cosine = 0.5 * (np.trace(found[:3, :3].T @ wanted[:3, :3]) - 1.0)
    sine = 0.5 * np.linalg.norm(found[:3, :3] @ wanted[:3, :3].T - wanted[:3, :3] @ found[:3, :3].T) / 2**0.5
    near = np.linalg.norm(found[:3, 3] - wanted[:3, 3]) <= POSITION_TOLERANCE
    return bool(near and np.arctan2(sine, cosine) <= ANGLE_TOLERANCE)
