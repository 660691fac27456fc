"""Benchmark ``control``: a PR2, a Fetch and an HSR open a fridge that they hold, with pink and mink."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from time import thread_time_ns

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Command, Controller, Goal, Hold, InverseKinematics, same_pose
from kineverse.errors import InvalidValueError, MissingDependencyError, NoSolutionError
from kineverse.expressions.functions import norm
from kineverse.formats import load
from kineverse.geometry import Rule, Scene
from kineverse.model.model import Model
from kineverse.spatial import rotation_y, rpy, translation
from kineverse.state import State
from kineverse.symbols import Symbol

from .control_workloads import WORKLOADS, ControlLoop, ControlWorkload
from .harness import (
    Bar,
    Benchmark,
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    Contender,
    Measurement,
    run_program,
)


class ControllerLoop:
    command: Command

    def __init__(
        self, controller: Controller, start: State, clock: Symbol | None = None, task: str | None = None
    ) -> None:
        self.controller = controller
        model = controller.model
        self._symbols = model.symbols
        self._integrate = model.integrator(controller.speeds)
        self._start = start.vector(self._symbols)
        place = {s: k for k, s in enumerate(self._symbols)}
        inputs = controller.inputs
        self._input = np.array([0.0 if s.value is None else s.value for s in inputs])
        self._own = np.array([k for k, s in enumerate(inputs) if s in place], dtype=np.intp)
        self._places = np.array([place[s] for s in inputs if s in place], dtype=np.intp)
        self._clock = [k for k, s in enumerate(inputs) if s == clock]
        self._error = compile(norm(_find_task(controller, task).error[:3]), inputs)
        self.reset()

    def reset(self) -> None:
        self.controller.reset()
        self._q = self._start.copy()

    def aim(self, time: float) -> None:
        self._input[self._clock] = time

    def step(self) -> None:
        self._input[self._own] = self._q[self._places]
        self.command = self.controller.step(self._input)

    def advance(self) -> None:
        self._q = self._integrate(
            self._q, np.fromiter(self.command.speeds.values(), float), self.controller.dt
        )

    def error(self) -> float:
        self._input[self._own] = self._q[self._places]
        return float(self._error(self._input))

    @property
    def state(self) -> State:
        return State(dict(zip(self._symbols, self._q.tolist(), strict=True)))


def _find_task(controller: Controller, name: str | None) -> Goal | Hold:
    tasks = [task for task in controller.tasks if isinstance(task, Goal | Hold) and name in (None, task.name)]
    if not tasks:
        raise InvalidValueError(f"The controller has no goal or hold {name!r}.")
    return tasks[0]


class TimedLoop:
    """Control loop whose steps are timed, from the state in to the command out."""

    def __init__(self, name: str, loop: ControlLoop, period: float, steps: int) -> None:
        self.name, self.loop = name, loop
        self.period, self.steps = period, steps
        self.times: list[float] = []
        self._solver: list[float] = []

    @property
    def contender(self) -> Contender:
        return Contender(self.name, self.run)

    def _steps(self, count: int) -> Iterator[int]:
        """Run the motion from its start, and yield the CPU time of each step [ns] before it is integrated."""
        loop = self.loop
        loop.reset()
        for k in range(count):
            loop.aim(k * self.period)
            start = thread_time_ns()
            loop.step()
            yield thread_time_ns() - start
            loop.advance()

    def run(self) -> float:
        """Run the motion; return the median CPU time of a step [s]."""
        loop = self.loop
        times: list[float] = []
        solver: list[float] = []
        for nanoseconds in self._steps(self.steps):
            times.append(nanoseconds * 1e-9)
            if isinstance(loop, ControllerLoop):
                solver.append(loop.command.times.solve)
        self.times += times
        if solver:
            self._solver.append(float(np.median(solver)))
        return float(np.median(times))

    def mean_error(self, steps: int | None = None) -> Measurement:
        """Run the motion, or a number of steps; return the mean error of the task [m], [rad]."""
        self.loop.reset()
        found = []
        for k in range(steps or self.steps):
            self.loop.aim(k * self.period)
            self.loop.step()
            self.loop.advance()
            found.append(self.loop.error())
        return Measurement(f"{self.name}, mean error", "m, rad", (float(np.mean(found)),))

    def slots_in_use(self, count: int) -> Measurement:
        """Run the motion of our controller; return the mean number of contact slots in use."""
        loop = self.loop
        assert isinstance(loop, ControllerLoop)
        used = [min(len(loop.command.contacts), count) for _ in self._steps(self.steps)]
        return Measurement(f"{self.name}, in use", "slots", (float(np.mean(used)),))

    def p99(self) -> Measurement:
        return Measurement(f"{self.name}, p99", "s", (float(np.percentile(self.times, 99)),))

    def solver_alone(self) -> list[Measurement]:
        """Return the median wall times of our solver by round; nothing for other loops."""
        rounds = tuple(self._solver[1:])
        return [Measurement(f"{self.name}, solver alone", "s", rounds)] if rounds else []

    def bounds(self, **limits: float) -> list[Comparison]:
        """Return statistics of all steps with their targets [s]: ``mean``, ``median``, ``p99``, ``worst``."""
        shares = {"median": 50, "p99": 99, "worst": 100}
        return [
            Comparison(
                f"{self.name}, {kind}",
                float(np.percentile(self.times, shares[kind]) if kind in shares else np.mean(self.times)),
                "s",
                Bar(limit, at_least=False),
            )
            for kind, limit in limits.items()
        ]


OPENING = "opening"  # name of the workload among those of peers
DOOR, GRASP = "kitchen/fridge_door", "grasp"
"""Joint of the door, and the frame on its handle that a gripper holds."""
GRIPPERS: Mapping[str, str] = {
    "pr2": "pr2/r_gripper_tool_frame",
    "fetch": "fetch/gripper_link",
    "hsr": "hsr/hand_palm_link",
}
"""Frames of grippers by robot."""
_FINGERS = {"pr2": "pr2/r_gripper*", "fetch": "fetch/*gripper*", "hsr": "hsr/hand*"}
DOOR_GAIN, OPEN = 1.0, 1.5
"""Gain of the door's opening [1/s], and the angle [rad] from which the door counts as open."""
PERIOD, STEPS = 0.02, 250  # control period [s], and number of steps of an opening
CONTACTS, MARGIN, RADIUS = 24, 0.005, 0.15
"""Number of contact slots, the distance that pairs keep and the one from which they count [m].

Within this radius there are more pairs than slots, nearly all of the time.
"""
_STARTS, _SEEDS = 64, 20


@dataclass(frozen=True, eq=False)
class Opening:
    robot: str
    model: Model  # the robot in the kitchen
    tasks: tuple[Hold, Goal]  # grasp, held; and opening of the door

    def scene(self) -> Scene:
        """Return the scene, in which only the gripper may touch the door, and the kitchen does not count."""
        fingers = _FINGERS[self.robot]
        pairs = (("kitchen/*", "kitchen/*"), (fingers, "kitchen/fridge_door*"), (fingers, fingers))
        return Scene(self.model, rules=[Rule(a, b) for a, b in pairs])

    def controller(self, scene: Scene | None = None) -> Controller:
        return Controller(
            self.model, self.tasks, dt=PERIOD, scene=scene, contacts=CONTACTS, margin=MARGIN, radius=RADIUS
        )

    def find_start(self, controller: Controller, scene: Scene | None = None) -> State:
        """Return a state at the handle, by inverse kinematics, from which the controller opens the door."""
        solver = InverseKinematics(
            self.model, self.tasks[:1], fixed=[DOOR], scene=scene, margin=2 * MARGIN if scene else 0.0
        )
        for seed in range(_SEEDS):
            found = solver.solve(starts=_STARTS, seed=seed)
            if found.solved and _opens(ControllerLoop(controller, found.best)):
                return found.best
        raise NoSolutionError(f"The {self.robot} opens the fridge from none of {_SEEDS} solutions.")


def make_peer_loop(library: str, name: str, workload: ControlWorkload | None = None) -> ControlLoop:
    peer = importlib.import_module(f"{__package__}.peers.{library}")
    loop: ControlLoop = peer.make_loop(name, workload or WORKLOADS[name])
    return loop


def _opens(loop: ControllerLoop) -> bool:
    for _ in range(STEPS):
        loop.step()
        loop.advance()
    return loop.state[loop.controller.model.symbol(DOOR)] >= OPEN


@cache
def make_opening(robot: str) -> Opening:
    grasp = translation(0.04, 0.0, 0.0) @ rpy(np.pi / 2, 0.0, np.pi)
    if robot == "hsr":  # its palm points along z
        grasp = translation(0.08, 0.0, 0.0) @ rpy(np.pi / 2, 0.0, np.pi) @ rotation_y(np.pi / 2)
    model = load(robot)
    with model.edit() as edit:
        edit.include("kitchen", "kitchen")
        edit.add_frame(GRASP, "kitchen/fridge_door_handle", grasp)
    grasped = same_pose(model.fk(GRASP), model.fk(GRIPPERS[robot]))
    held = Hold(grasped, name="grasp", gain=0.5 / PERIOD)  # as of the peers
    return Opening(robot, model, (held, Goal(model.symbol(DOOR), np.pi / 2, name="door", gain=DOOR_GAIN)))


def peer_workload(opening: Opening, start: State, kept: Iterable[str] | None = None) -> ControlWorkload:
    held, positions = [], {symbol.path: value for symbol, value in start.items()}
    if kept is not None:
        names = set(kept)
        for name, joint in opening.model.articulations.items():
            if joint.kind != "fixed" and names.isdisjoint(symbol.path for symbol in joint.coordinates):
                held.append(name)
        positions = {path: value for path, value in positions.items() if path in names}
    return ControlWorkload(lambda: opening.model, positions, tuple(held), period=PERIOD, steps=STEPS)


COMPARED = "pr2"  # robot of the peers
TIMED_STEPS = STEPS  # steps of an opening that are measured
BUILD, READY = f"{COMPARED}: build of the controller", f"{COMPARED}: from there until C runs"
PEERS = ("pink", "mink")
REDUCED = "reduced by hand"


def measure_control(settings: BenchmarkSettings) -> BenchmarkResult:
    one = Benchmark("control", settings)
    plain: list[TimedLoop] = []
    close: list[TimedLoop] = []
    others: list[TimedLoop] = []
    for robot in settings.robots:
        opening = make_opening(robot)
        controller = opening.controller()
        controller.wait()
        start = opening.find_start(controller)
        plain.append(TimedLoop(f"{robot}: kineverse", ControllerLoop(controller, start), PERIOD, TIMED_STEPS))
        if robot == COMPARED:
            others += [loop for peer in filter(one.has, PEERS) for loop in _peers(peer, opening, start)]
        try:
            close.append(_near_the_kitchen(opening))
        except MissingDependencyError as error:
            one.missing.append(f"contact slots are left out: {error}")
    loops = [*plain, *close, *others]
    errors = [loop.mean_error() for loop in (*plain, *others)]
    one.time(_fresh_builds(), settings.processes)
    one.time(loop.contender for loop in loops)
    for alone in (*plain, *close):
        one.add(*alone.solver_alone())
    one.add(*(loop.p99() for loop in loops), *errors, *(loop.slots_in_use(CONTACTS) for loop in close))
    one.bound(0.3, BUILD)
    one.bound(10.0, READY)
    for loop in plain:
        one.comparisons += loop.bounds(mean=50e-6, p99=200e-6, worst=2e-3)
    for loop in close:
        one.comparisons += loop.bounds(median=300e-6, p99=1e-3)
    if (ours := f"{COMPARED}: kineverse") in one.measured:
        one.speed(ours, *(f"{COMPARED}: {peer}" for peer in PEERS), at_least=5.0)
        one.speed(ours, *(f"{COMPARED}: {peer}, {REDUCED}" for peer in PEERS))
    return one.result(
        f"robots with base and arm hold a fridge's handle and open the door, {STEPS} steps of {PERIOD:g} "
        f"s: CPU time from the state to the command; with {CONTACTS} contact slots this includes the "
        "queries of the scene"
    )


def _near_the_kitchen(opening: Opening) -> TimedLoop:
    scene = opening.scene()
    controller = opening.controller(scene)
    controller.wait()
    start = opening.find_start(controller, scene)
    name = f"{opening.robot}: kineverse, {CONTACTS} contact slots"
    return TimedLoop(name, ControllerLoop(controller, start), PERIOD, TIMED_STEPS)


def _peers(library: str, opening: Opening, start: State) -> Iterator[TimedLoop]:
    moving = {symbol.path for task in opening.tasks for symbol in task.error.symbols}
    for name, kept in ((library, None), (f"{library}, {REDUCED}", moving)):
        loop = make_peer_loop(library, OPENING, peer_workload(opening, start, kept))
        yield TimedLoop(f"{opening.robot}: {name}", loop, PERIOD, TIMED_STEPS)


def _fresh_builds() -> list[Contender]:
    """Return the build in a fresh process with an empty cache, and the time until the program is compiled."""
    found: dict[str, float] = {}

    def build() -> float:
        with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as empty:
            found.update(run_program("build_controller", COMPARED, cache=empty))
        return found["build"]

    return [Contender(BUILD, build), Contender(READY, lambda: found["ready"])]
