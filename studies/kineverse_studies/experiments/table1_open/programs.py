"""Programs that open a grasped object: the papers' leader and follower, and one program over both.

In the papers, a leader moves the object to its upper limits, and a follower moves the hand after the handle
(2022 paper, IV-C1). Both are quadratic programs. Here they are run as published: the object goes where the
leader says, whether the hand keeps up or not, and the grasp error is measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import thread_time

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Controller, Goal, Hold, InverseKinematics, same_orientation, same_pose
from kineverse.errors import NoSolutionError
from kineverse.expressions import array
from kineverse.expressions.expression import Expression
from kineverse.geometry import Rule, Scene
from kineverse.manipulation.robot_sources import RobotSource
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rotation_z, rpy, translation
from kineverse.state import State
from kineverse.symbols import Symbol

PLACE = translation(1.0, 0.0, 0.7) @ rotation_z(0.57)
"""Pose of the object in the world; its front looks at the robot, along its -x."""
OBJECT, GRASP = "object", "grasp"
_STARTS, _SEEDS = 32, 8
_MARGIN = 0.005
_AREA = {"x": (-0.4, 0.5), "y": (-0.8, 0.4), "angle": (-0.8, 0.8)}


@dataclass(frozen=True)
class GraspedObject:
    name: str
    source: str
    coordinate: str  # coordinate that is opened, without the prefix
    handle: str  # frame of the handle, without the prefix
    grasp: Expression  # pose handle_T_hand: x of the hand points out of it, its fingers close along y


_BAR_GRASP = translation(0.04, 0.0, 0.0) @ rpy(math.pi / 2, 0.0, math.pi)
# x of the folding door's handle points inward, and its plate is across z.
_PLATE_GRASP = translation(-0.04, 0.0, 0.0) @ rpy(math.pi / 2, 0.0, 0.0)
OBJECTS: Mapping[str, GraspedObject] = {
    one.name: one
    for one in (
        GraspedObject("folding door", "articulations/folding_door", "door", "door/handle", _PLATE_GRASP),
        GraspedObject("hinged door", "shelf_door", "door", "door_handle", _BAR_GRASP),
        GraspedObject("drawer", "shelf_drawers", "upper_drawer", "upper_drawer_handle", _BAR_GRASP),
    )
}
"""Objects by name."""


@dataclass(frozen=True, eq=False)
class OpeningSetup:
    robot: RobotSource
    thing: GraspedObject  # the robot, and the object
    model: Model
    what: Symbol  # coordinate of the object
    hand: Expression
    grasp: Expression

    @property
    def upper(self) -> float:
        """Largest value of the coordinate."""
        return float(self.model.limits(self.what)[1])

    def scene(self) -> Scene:
        gripper = self.robot.gripper(self.model)
        rules = [Rule(body, f"{OBJECT}/*") for body in gripper.bodies]
        return Scene(self.model, rules=[*rules, Rule(f"{OBJECT}/*", f"{OBJECT}/*")])

    def find_start(self, seed: int = 0) -> State:
        """Return a state with the hand at the grasp; the search begins nearby for seeds other than 0."""
        held = Hold(same_pose(self.grasp, self.hand), name="grasp")
        gripper = self.robot.gripper(self.model)
        scene = self.scene()
        opened = {str(s): value for s, value in gripper.opened.items()}
        values = self.robot.start_state(self.model).updated(opened)
        if seed:
            values = values.updated(self._draw_configuration(np.random.default_rng(seed)))
        solver = InverseKinematics(self.model, [held], fixed=[self.what], scene=scene, margin=_MARGIN)
        for more in range(_SEEDS):
            found = solver.solve(values, starts=_STARTS, seed=_SEEDS * seed + more)
            if found.solved:
                return found.best
        raise NoSolutionError(
            f"{self.robot.name} has no configuration at the handle of the {self.thing.name}."
        )

    def _draw_configuration(self, rng: np.random.Generator) -> dict[str, float]:
        """Return random positions of the arm within its limits, and of the base in front of the object."""
        base = {f"{self.robot.prefix}/base/{key}": area for key, area in _AREA.items()}
        drawn = {}
        for symbol in self.hand.symbols:
            name = str(symbol)
            lower, upper = base.get(name, self.model.limits(symbol))
            drawn[name] = float(rng.uniform(max(lower, -math.pi), min(upper, math.pi)))
        return drawn


def make_opening_setup(robot: RobotSource, thing: GraspedObject) -> OpeningSetup:
    model = robot.load()
    with model.edit() as edit:
        edit.include(thing.source, OBJECT)
        roots = [
            f for f, placed in model.frames.items() if f.startswith(f"{OBJECT}/") and placed.parent == WORLD
        ]
        for root in roots:
            edit.attach(root, WORLD, PLACE)
        edit.add_frame(GRASP, f"{OBJECT}/{thing.handle}", thing.grasp)
    gripper = robot.gripper(model)
    what = model.symbol(f"{OBJECT}/{thing.coordinate}")
    hand = model.fk(gripper.hand) @ gripper.grasp_pose
    return OpeningSetup(robot, thing, model, what, hand, model.fk(GRASP))


DT = 0.02
MOST_STEPS = 500
INNER_STEPS = 20
TOLERANCE = 1e-3
POSITION_WEIGHT, ROTATION_WEIGHT = 10.0, 1.0
DONE = 0.99  # share of the upper limit from which an object counts as open; reached after 4.6 s
LOST = 0.01  # grasp error from which the handle counts as lost [m]


@dataclass(slots=True)
class ProgramRun:
    done: bool = False
    value: float = 0.0
    steps: int = 0
    # times of the solver's calls of each control step, and CPU times of the steps [s]
    solve: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    position_error: float = 0.0  # largest grasp errors [m], [rad]
    rotation_error: float = 0.0
    violation: float = 0.0  # largest violation of a limit on positions [m], [rad]
    programs: int = 0  # number of quadratic programs solved


class LeaderFollower:
    name = "leader and follower"

    def __init__(self, setup: OpeningSetup) -> None:
        self._setup, self._model = setup, setup.model
        self._leader = Controller(
            setup.model,
            [Goal(setup.what, setup.upper, gain=1.0, name="open")],
            dt=DT,
            smooth=1e-4,
            posture=0.0,
        )
        error = setup.hand[:3, 3] - setup.grasp[:3, 3]
        turned = same_orientation(setup.grasp, setup.hand)
        self._follower = Controller(
            setup.model,
            [
                Goal(error, gain=1.0 / DT, weight=POSITION_WEIGHT, name="position"),
                Goal(turned, gain=1.0 / DT, weight=ROTATION_WEIGHT, name="rotation"),
            ],
            dt=DT,
            fixed=[setup.what],
            smooth=1e-4,
            posture=0.0,
        )
        self._limits = SpeedScale(setup.model, self._follower.speeds)

    @property
    def controllers(self) -> tuple[Controller, ...]:
        return self._leader, self._follower

    def step(self, state: State) -> tuple[State, float, int]:
        lead = self._leader.step(state)
        solve, count = lead.times.solve, 1
        led = self._model.integrate(state, lead.speeds, DT)
        total = dict.fromkeys(self._follower.speeds, 0.0)
        moved = led
        for _ in range(INNER_STEPS):
            self._follower.reset()
            command = self._follower.step(moved)
            solve, count = solve + command.times.solve, count + 1
            if max(command.residuals.values()) < TOLERANCE:
                break
            moved = self._model.integrate(moved, command.speeds, DT)
            for speed, value in command.speeds.items():
                total[speed] += value
        scale = self._limits(led, total)
        return self._model.integrate(led, {s: scale * v for s, v in total.items()}, DT), solve, count


class OneProgram:
    """One quadratic program over robot and object, the grasp a hold."""

    name = "one program"

    def __init__(self, setup: OpeningSetup) -> None:
        self._model = setup.model
        self._controller = Controller(
            setup.model,
            [
                Hold(same_pose(setup.grasp, setup.hand), gain=0.5 / DT, name="grasp"),
                Goal(setup.what, setup.upper, gain=1.0, name="open"),
            ],
            dt=DT,
        )

    @property
    def controllers(self) -> tuple[Controller, ...]:
        return (self._controller,)

    def step(self, state: State) -> tuple[State, float, int]:
        command = self._controller.step(state)
        return self._model.integrate(state, command.speeds, DT), command.times.solve, 1


def open_by_program(program: LeaderFollower | OneProgram, setup: OpeningSetup, state: State) -> ProgramRun:
    run = ProgramRun()
    for controller in program.controllers:
        controller.reset()
    errors = compile(same_pose(setup.grasp, setup.hand))
    limited = setup.model.degrees_of_freedom
    lower, upper = np.array([setup.model.limits(q) for q in limited]).T
    for _ in range(MOST_STEPS):
        start = thread_time()
        state, solve, count = program.step(state)
        run.cpu.append(thread_time() - start)
        run.solve.append(solve)
        run.programs += count
        run.steps += 1
        error = np.asarray(errors(state), dtype=float).ravel()
        run.position_error = max(run.position_error, float(np.linalg.norm(error[:3])))
        run.rotation_error = max(run.rotation_error, float(np.linalg.norm(error[3:])))
        values = state.vector(limited)
        run.violation = max(run.violation, float(np.maximum(lower - values, values - upper).max()))
        run.value = float(state[setup.what])
        if run.value >= DONE * setup.upper:
            run.done = run.position_error <= LOST
            break
    return run


class SpeedScale:
    """Factor that brings speeds within the limits of a model: all by the same, so that the path stays."""

    def __init__(self, model: Model, speeds: tuple[Symbol, ...]) -> None:
        known = frozenset(speeds)
        found = [c for c in model.constraints.values() if known & frozenset(c.expression.symbols)]
        self._symbols = sorted(
            {s for c in found for part in (c.lower, c.expression, c.upper) for s in _symbols(part)}, key=str
        )
        self._function = compile(array([[c.lower, c.expression, c.upper] for c in found]), self._symbols)

    def __call__(self, state: State, speeds: dict[Symbol, float]) -> float:
        values = [speeds.get(s, 0.0) if s.order else float(state[s]) for s in self._symbols]
        lower, value, upper = np.asarray(self._function(values), dtype=float).T
        bound = np.where(value > 0, upper, lower)
        ratios = np.where(value != 0, bound / np.where(value != 0, value, 1.0), np.inf)
        return float(min(1.0, ratios.min(initial=1.0)))


def _symbols(part: object) -> tuple[Symbol, ...]:
    return tuple(getattr(part, "symbols", ()))
