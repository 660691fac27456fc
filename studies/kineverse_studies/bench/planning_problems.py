"""Planning problems, checks by a scene, and attempts; robots are covered by VAMP's spheres."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from kineverse.formats import load
from kineverse.formats.locate import locate_model
from kineverse.formats.srdf import read_srdf
from kineverse.geometry import RULES, Rule, Scene, rules_as_data
from kineverse.lie import Array, to_rpy
from kineverse.model.body import Body, Box, Cylinder, Geometry, Shape, Sphere
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rpy, translation
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol, position

from .harness import Measurement

if TYPE_CHECKING:
    from kineverse.planning import Planner


@dataclass(frozen=True, slots=True)
class Attempt:
    found: bool  # true if a path was found
    seconds: float  # time of the search, without anything that is done once for a robot [s]
    # time with the judgement of the path by a scene [s]; the same for planners that do not judge
    judged: float
    # configurations of the path, shape (N, n) [m], [rad]; empty without one
    points: Array = field(default_factory=lambda: np.empty((0, 0)))
    why: str = ""  # how the path was found, or why there is none


def attempt_with_kineverse(
    planner: Planner, start: Array, goals: Array, seconds: float, seed: int
) -> Attempt:
    path = planner.plan(start, goals, seconds=seconds, seed=seed)
    return Attempt(path.found, path.search_seconds, path.seconds, path.points, path.why)


def attempt_first_path(planner: Planner, start: Array, goal: Array, seconds: float, seed: int) -> Attempt:
    """Return the attempt of our search alone: its path is neither shortened nor judged, as those of peers."""
    from kineverse.planning.sampling_planners import RrtConnect

    # The goals of the planner: the given one where it is nearest, and full turns away from there.
    nearest = planner.space.equivalents(goal, start, most=1)
    planner.planning_scene.set_bounds(start, nearest)
    variants = planner.space.equivalents(nearest[0], start)
    starts, goals = (np.ascontiguousarray(Q, dtype=np.float32) for Q in (start[None], variants))
    begin = perf_counter()
    found = RrtConnect(planner.checker).solve(starts, goals, seconds, seed)
    spent = perf_counter() - begin
    return Attempt(found.found, spent, spent, found.points.astype(float))


@dataclass(frozen=True)
class AttemptSummary:
    name: str  # planner and problems
    attempts: Sequence[Attempt]

    @property
    def solved(self) -> float:
        """Share of attempts that found a path [%]."""
        return 100.0 * float(np.mean([attempt.found for attempt in self.attempts]))

    def times(self, judged: bool = False) -> Array:
        """Return the times of attempts that found a path [s]; one of ∞ if there are none."""
        times = [a.judged if judged else a.seconds for a in self.attempts if a.found]
        return np.array(times or [np.inf])

    @property
    def median(self) -> float:
        return float(np.median(self.times()))

    @property
    def mean(self) -> float:
        """Mean time of what was solved [s]."""
        return float(np.mean(self.times()))

    def percentile(self, share: float) -> float:
        """Return a percentile of the time of what was solved [s]."""
        return float(np.percentile(self.times(), share))

    def measurements(self, percentile: float = 95.0) -> Iterator[Measurement]:
        """Yield median, mean and percentile of times, the median with the judgement, and the share solved."""
        if any(attempt.found for attempt in self.attempts):
            times, judged = self.times(), self.times(judged=True)
            yield Measurement(f"{self.name}: median", "s", (self.median,))
            yield Measurement(f"{self.name}: mean", "s", (self.mean,))
            yield Measurement(f"{self.name}: p{percentile:g}", "s", (self.percentile(percentile),))
            if not np.array_equal(times, judged):
                yield Measurement(f"{self.name}: median, path judged", "s", (float(np.median(judged)),))
        yield Measurement(f"{self.name}: solved", "%", (self.solved,))


FOLDER = "planning_problems"  # folder of the problems on the model path
ROBOTS = ("panda", "fetch")  # robots with problems


@dataclass(frozen=True, eq=False)
class PublishedProblem:
    name: str  # name of the problem set, and number of the problem in it
    start: Array  # configurations, in the order of :attr:`ProblemSet.symbols` [m], [rad]
    goal: Array
    state: State  # state of the model with the obstacles where they are, and the arm at the start
    objects: Sequence[Sequence[Any]]


@dataclass(frozen=True, eq=False)
class ProblemSet:
    robot: str
    name: str  # robot and name of the set
    model: Model  # robot and obstacles, with the rules of the SRDF
    symbols: tuple[Symbol, ...]  # coordinates of the arm
    problems: tuple[PublishedProblem, ...]


def load_problem_sets(robot: str, most: int | None = None) -> Iterator[ProblemSet]:
    file = locate_model(f"{FOLDER}/{robot}/{robot}_spherized.urdf").path
    content = json.loads(file.with_name("problems.json").read_text(encoding="utf-8"))
    joints = content["joints"]
    for name, problems in content["problems"].items():
        ends = [dict(zip(joints, entry[end], strict=True)) for entry in problems for end in ("start", "goal")]
        model = _load_robot(file, ends)
        _add_obstacles(model, problems[0]["objects"], file.with_name(f"{robot}.srdf"))
        symbols = tuple(model.symbol(joint) for joint in joints)
        found = [
            _read_problem(f"{name} {k}", model, symbols, entry) for k, entry in enumerate(problems[:most])
        ]
        yield ProblemSet(robot, name, model, symbols, tuple(found))


def _add_obstacles(model: Model, objects: Sequence[Sequence[Any]], srdf: Path) -> None:
    """Add obstacles with free poses, and rules: those of the SRDF, and none among obstacles."""
    rules = [Rule(*rule) for rule in read_srdf(srdf, model).rules]
    with model.edit() as edit:
        for name, kind, _, size in objects:
            *where, roll, pitch, yaw = _pose_symbols(name)
            shape = Shape(_make_geometry(kind, size))
            pose = translation(*where) @ rpy(roll, pitch, yaw)
            edit.add_frame(_frame(name), WORLD, pose, Body(collisions=(shape,)))
        rules.append(Rule(_frame("*"), _frame("*"), why="obstacles stand still"))
        edit.write(RULES, rules_as_data(rules))


def _load_robot(file: Path, ends: Sequence[Mapping[str, float]]) -> Model:
    """Return the robot without drawn meshes, its limits widened to hold given starts and goals."""
    tree = ElementTree.parse(file)
    for link in tree.iterfind("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for joint in tree.iterfind("joint"):
        for soft in joint.findall("safety_controller"):
            joint.remove(soft)
        limit, name = joint.find("limit"), joint.get("name", "")
        if limit is not None and name in ends[0]:
            low, high = (float(limit.get(key, 0.0)) for key in ("lower", "upper"))
            limit.set("lower", repr(min(low, *(end[name] for end in ends))))
            limit.set("upper", repr(max(high, *(end[name] for end in ends))))
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        changed = Path(folder, file.name)
        tree.write(changed, encoding="unicode")
        return load(changed, prefix="")


def _frame(obstacle: str) -> str:
    return f"obstacle/{obstacle}"


def _pose_symbols(obstacle: str) -> list[Symbol]:
    return [position(f"{_frame(obstacle)}/{k}") for k in ("x", "y", "z", "roll", "pitch", "yaw")]


def _make_geometry(kind: str, size: Sequence[float]) -> Geometry:
    if kind == "box":
        x, y, z = size
        return Box((x, y, z))
    if kind == "cylinder":
        height, radius = size
        return Cylinder(radius, height)
    return Sphere(size[0])


def _read_problem(
    name: str, model: Model, symbols: Sequence[Symbol], entry: dict[str, Any]
) -> PublishedProblem:
    values: dict[Symbol, float] = dict(zip(symbols, entry["start"], strict=True))
    for obstacle, _, pose, _ in entry["objects"]:
        T = np.array(pose)
        numbers = np.concatenate([T[:3, 3], to_rpy(T[:3, :3])])
        values |= dict(zip(_pose_symbols(obstacle), numbers.tolist(), strict=True))
    start, goal = np.array(entry["start"]), np.array(entry["goal"])
    return PublishedProblem(name, start, goal, model.default_state() | State(values), entry["objects"])


CHECKS_PER_RADIAN = 32.0
"""Configurations that planners check over a motion of length 1 of all coordinates [1/rad], [1/m]."""
FINER = 20.0  # factor by which a returned path is sampled finer than that


class ConfigurationCheck:
    def __init__(self, scene: Scene, symbols: Sequence[Symbol], state: StateLike | None = None) -> None:
        self.scene, self._symbols = scene, tuple(symbols)
        # Faster than the first contact of the scene, which asks about pairs that stand still as well.
        self._query = scene.watch(moving=symbols, radius=0.0)
        inputs = scene.inputs
        whole = scene.model.default_state()
        if state is not None:
            whole = whole.updated(state)
        self._values = np.array([whole[symbol] for symbol in inputs])
        place = {symbol: k for k, symbol in enumerate(inputs)}
        # A coordinate on which no pose depends is no input.
        self._columns = np.array([place[s] for s in symbols if s in place], dtype=int)
        self._kept = np.array([s in place for s in symbols], dtype=bool)

    def __call__(self, q: Sequence[float] | Array) -> bool:
        self._values[self._columns] = np.asarray(q)[self._kept]
        self.scene.update(self._values)
        return len(self._query()) == 0

    def count_contacts(self, points: Array, density: float = FINER * CHECKS_PER_RADIAN) -> int:
        samples, contacts = interpolate_path(points, density), 0
        self(samples[0])
        while (k := self._query.first_within(self._symbols, samples)) is not None:
            samples, contacts = samples[k + 1 :], contacts + 1
        return contacts


def interpolate_path(points: Array, density: float) -> Array:
    """Return configurations (N, n) along a path of straight edges, its points included."""
    parts = [points[:1]]
    for a, b in pairwise(points):
        steps = max(1, int(np.ceil(density * np.linalg.norm(b - a))))
        parts.append(a + (b - a) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(parts)
