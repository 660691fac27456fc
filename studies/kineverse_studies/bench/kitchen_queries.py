"""Planning queries in kitchens: arms of mobile robots, and random poses of their hands at handles."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kineverse.articulations import OmniBase
from kineverse.compilation import compile
from kineverse.control import Goal, InverseKinematics, Keep, Target
from kineverse.errors import UnknownNameError
from kineverse.formats.locate import locate_model
from kineverse.geometry import RULES, Rule, Scene, rules_as_data
from kineverse.lie import Array
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import Symbol

from .planning_problems import ConfigurationCheck

ROBOT, KITCHEN, BASE = "robot", "kitchen", "robot/base"  # prefixes of both, and the base of the robot


@dataclass(frozen=True)
class KitchenRobotArm:
    file: str  # name or path of the model
    tool: str  # frame of the hand
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)  # direction of approach in that frame
    length: float = 0.0  # distance of the fingertips from that frame [m]
    without: tuple[str, ...] = ()  # bodies that cannot be used, as their meshes are missing


ARMS: Mapping[str, KitchenRobotArm] = {
    "pr2": KitchenRobotArm("pr2_description/robots/pr2.urdf", "r_gripper_tool_frame"),
    "hsr": KitchenRobotArm(
        "hsrb_description/robots/hsrb.urdf",
        "hand_palm_link",
        (0.0, 0.0, 1.0),
        0.08,
        ("head_l_stereo_camera_link", "head_r_stereo_camera_link"),
    ),
    "fetch": KitchenRobotArm("fetch_description/robots/fetch.urdf", "gripper_link"),
    "pr2 (shipped)": KitchenRobotArm("pr2", "r_gripper_tool_frame"),
    "hsr (shipped)": KitchenRobotArm("hsr", "hand_palm_link", (0.0, 0.0, 1.0), 0.08),
    "fetch (shipped)": KitchenRobotArm("fetch", "gripper_link"),
}
"""Robots by name: those of the model path, and those that ship."""
KITCHENS: Mapping[str, str] = {
    "iai_kitchen": "iai_kitchen/urdf_obj/kitchen.urdf",
    "kitchen (shipped)": "kitchen",
}
"""Kitchens by name."""
FRIDGE_OPEN: Mapping[str, float] = {f"{KITCHEN}/fridge_door": 1.4}
"""Position of the door of the shipped fridge for the queries there [rad]."""
FRIDGE_BASE = np.array([0.45, -1.5, 0.0])  # place of the base there: x, y [m] and angle [rad]
BESIDE_FRIDGE = np.array([[0.9, -1.2, 0.5], [1.1, -0.9, 1.3]])
INSIDE_FRIDGE = np.array([[1.3, -1.8, 0.8], [1.5, -1.4, 1.5]])
"""Corners of the boxes of points that the hand points at: starts and goals [m]."""
OFFSET = 0.06, 0.12  # range of the distance of the fingertips from the handle [m]
CLEARANCE = 0.005  # least distance of the robot from the kitchen at starts and goals [m]
_CONE = 0.5  # least cosine of the angle between the direction of approach and that to the handle
_SAMPLES, _HEIGHT, _NEAR = 20_000, 0.03, 0.2
"""Number of random configurations from which poses of the hand are taken, and how far in height, and in all
directions, they may be off the handle [m]. Those of the goal are then brought to it by inverse kinematics."""
_STATES = 200  # number of random states at which pairs of the robot touch that always do
_STARTS = 4  # number of starts of inverse kinematics


@dataclass(frozen=True, eq=False)
class PlanningQuery:
    start: Array  # configurations of the arm, shape (n,) [m], [rad]
    goal: Array
    state: State  # state of the model, with the arm at the start


@dataclass(frozen=True, eq=False)
class KitchenArm:
    name: str
    model: Model
    arm: KitchenRobotArm
    handles: tuple[str, ...]

    @property
    def tool(self) -> str:
        return f"{ROBOT}/{self.arm.tool}"

    @cached_property
    def base(self) -> tuple[Symbol, ...]:
        return tuple(self.model.symbol(f"{BASE}/{name}") for name in ("x", "y", "angle"))

    @cached_property
    def symbols(self) -> tuple[Symbol, ...]:
        """Coordinates that move the hand while the base stands: those of the arm and a torso."""
        return tuple(symbol for symbol in self.model.fk(self.tool).symbols if symbol not in self.base)

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper limits of the coordinates, shape (n,); ±π for continuous joints."""
        limits = np.array([self.model.limits(symbol) for symbol in self.symbols])
        bounded = np.isfinite(limits).all(axis=1)
        lower, upper = np.where(bounded, limits.T, [[-np.pi], [np.pi]])
        return lower, upper

    def random_states(self, count: int, seed: int = 0) -> Iterator[State]:
        """Yield states with the arm anywhere within its limits, and all else at its default."""
        random, home = np.random.default_rng(seed), self.model.default_state()
        for _ in range(count):
            q = random.uniform(*self.limits)
            yield home | State(dict(zip(self.symbols, q.tolist(), strict=True)))

    def queries(self, count: int, seed: int = 0) -> Iterator[PlanningQuery]:
        """Yield queries between handles; the first ones of a larger count are those of a smaller one."""
        search = _QuerySearch(self)
        random = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        for _ in range(count):
            yield search.find(random)

    def fridge_queries(self, count: int, seed: int = 0) -> Iterator[PlanningQuery]:
        search = _QuerySearch(self, FRIDGE_OPEN)
        random = np.random.default_rng(seed)
        while count > 0:
            start = search.reach(_points_in(BESIDE_FRIDGE, random), FRIDGE_BASE, random)
            goal = search.reach(_points_in(INSIDE_FRIDGE, random), FRIDGE_BASE, random)
            if start is not None and goal is not None:
                yield search.query(start, goal, FRIDGE_BASE)
                count -= 1


def make_kitchen_arm(robot: str, kitchen: str, except_touching: bool = True) -> KitchenArm:
    arm, room = ARMS[robot], KITCHENS[kitchen]
    model = Model()
    with model.edit() as edit:
        _include_robot(edit, arm)
        rules = [Rule(f"{KITCHEN}/*", f"{KITCHEN}/*", why="the kitchen stands still")]
    own: tuple[Rule, ...] = ()
    if except_touching:  # before there is a kitchen that these pairs could touch
        alone = KitchenArm(robot, model, arm, ())
        scene = Scene(model)
        own = (
            *scene.find_always_colliding(alone.random_states(_STATES)),
            *scene.find_always_colliding([model.default_state()]),
        )
    with model.edit() as edit:
        edit.include(room, KITCHEN)
        edit.write(RULES, rules_as_data((*own, *rules)))
    handles = tuple(f for f in model.frames if f.startswith(KITCHEN) and f.endswith("_handle"))
    return KitchenArm(f"{robot} in {kitchen}", model, arm, handles)


def _include_robot(edit: Edit, arm: KitchenRobotArm) -> None:
    edit.include(arm.file, ROBOT)
    for body in arm.without:
        edit.remove(f"body {ROBOT}/{body}")
    if BASE not in edit.model.frames:
        root = next(name for name, frame in edit.model.frames.items() if frame.parent == WORLD)
        edit.apply(OmniBase(name=BASE, parent=WORLD, child=BASE))
        edit.attach(root, BASE, np.eye(4))


class _QuerySearch:
    def __init__(self, arm: KitchenArm, state: Mapping[str, float] = {}) -> None:
        self._arm = arm
        model = arm.model
        hand = model.fk(arm.tool)
        approach = hand[:3, :3] @ np.array(arm.arm.axis)
        self._point, self._direction = Target("point", np.zeros(3)), Target("direction", np.eye(3)[0])
        tasks = (
            Goal(hand[:3, 3] - self._point.expression, name="position"),
            Keep(_CONE, approach @ self._direction.expression, np.inf, name="approach"),
        )
        self._solver = InverseKinematics(model, tasks, fixed=arm.base)
        self._known = {*self._solver.inputs, *arm.base, *arm.symbols}
        self._home = home = model.default_state().updated(state)
        scene = Scene(model)
        self._free = ConfigurationCheck(scene, (*arm.base, *arm.symbols), home)
        self._near = scene.watch(f"{ROBOT}/*", f"{KITCHEN}/*", radius=CLEARANCE)
        self._handles = np.array([model.fk(frame)(home)[:3, 3] for frame in arm.handles])
        self._samples = np.random.default_rng(0).uniform(*arm.limits, (_SAMPLES, len(arm.symbols)))
        pose = compile(model.fk(arm.tool, BASE), arm.symbols).batch(self._samples)
        # A hand close to the body would have the base in the furniture.
        stretched = np.argsort(np.linalg.norm(pose[:, :2, 3], axis=1))[len(pose) // 2 :]
        self._samples, pose = self._samples[stretched], pose[stretched]
        self._points, self._axes = pose[:, :3, 3], pose[:, :3, :3] @ np.array(arm.arm.axis)

    def find(self, random: np.random.Generator) -> PlanningQuery:
        while True:
            here, *others = self._handles[random.permutation(len(self._handles))]
            found = self._place(here, random)
            if found is None:
                continue
            start, base = found
            goal = self.reach(others, base, random)
            if goal is not None:
                return self.query(start, goal, base)

    def _check(self, base: Array, q: Array) -> bool:
        return self._free(np.concatenate([base, q])) and len(self._near()) == 0

    def query(self, start: Array, goal: Array, base: Array) -> PlanningQuery:
        coordinates = (*self._arm.base, *self._arm.symbols)
        here = dict(zip(coordinates, (*base.tolist(), *start.tolist()), strict=True))
        return PlanningQuery(start, goal, self._home | State(here))

    def _place(self, handle: Array, random: np.random.Generator) -> tuple[Array, Array] | None:
        offset = self._arm.arm.length + random.uniform(*OFFSET)
        touched = self._points + offset * self._axes
        at_height = np.flatnonzero(np.abs(touched[:, 2] - handle[2]) < _HEIGHT)
        if not len(at_height):
            return None
        chosen = random.choice(at_height)
        angle = random.uniform(-np.pi, np.pi)
        c, s = np.cos(angle), np.sin(angle)
        base = np.array([*handle[:2] - np.array([[c, -s], [s, c]]) @ touched[chosen, :2], angle])
        start = self._samples[chosen]
        return (start, base) if self._check(base, start) else None

    def reach(self, points: Iterable[Array], base: Array, random: np.random.Generator) -> Array | None:
        """Return a configuration with the hand beside the first point that can be reached; None for none."""
        c, s = np.cos(base[2]), np.sin(base[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        offset = self._arm.arm.length + random.uniform(*OFFSET)
        touched = self._points + offset * self._axes
        for handle in points:
            there = turn.T @ (handle - [*base[:2], 0.0])
            near = np.flatnonzero(np.linalg.norm(touched - there, axis=1) < _NEAR)
            for chosen in random.permutation(near)[:_STARTS]:
                direction = turn @ self._axes[chosen]
                point = handle - offset * direction
                q = self._solve(self._samples[chosen], point, direction, base)
                if q is not None and self._check(base, q):
                    return q
        return None

    def _solve(self, first: Array, point: Array, direction: Array, base: Array) -> Array | None:
        arm, values = self._arm, self._point.values(point) | self._direction.values(direction)
        values |= dict(zip((*arm.base, *arm.symbols), (*base.tolist(), *first.tolist()), strict=True))
        # An arm in a plane knows no component of the direction across it.
        known = {symbol: value for symbol, value in values.items() if symbol in self._known}
        result = self._solver.solve(known, starts=1)
        return np.clip(result.best.vector(arm.symbols), *arm.limits) if result.solved else None


def _points_in(box: Array, random: np.random.Generator) -> Array:
    """Return random points in a box, (4, 3) [m]."""
    return np.asarray(random.uniform(box[0], box[1], (4, 3)))


def find_missing(robot: str, kitchen: str) -> str | None:
    """Return a line on a robot or kitchen that is not among the models; None if both are."""
    for name, file in ((robot, ARMS[robot].file), (kitchen, KITCHENS[kitchen])):
        try:
            locate_model(file)
        except UnknownNameError:
            return f"{name} is not among the models: {file}"
    return None
