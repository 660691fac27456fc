"""Published planning problems: an arm among boxes and cylinders (MotionBenchMaker, as VAMP ships them).

Robots are those of VAMP, covered by its spheres, with its SRDFs, so that everybody checks the same geometry.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from kineverse.formats import load
from kineverse.formats.locate import locate_model
from kineverse.formats.srdf import read_srdf
from kineverse.geometry import RULES, Rule, rules_as_data
from kineverse.lie import Array, to_rpy
from kineverse.model.body import Body, Box, Cylinder, Geometry, Shape, Sphere
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.spatial import rpy, translation
from kineverse.state import State
from kineverse.symbols import Symbol, position

FOLDER = "planning_problems"
"""Folder of the problems on the model path."""

ROBOTS = ("panda", "fetch")
"""Robots with problems."""


@dataclass(frozen=True, eq=False)
class PublishedProblem:
    """Start and goal of an arm among obstacles."""

    name: str  # name of the problem set, and number of the problem in it
    start: Array  # configurations, in the order of :attr:`ProblemSet.symbols` [m], [rad]
    goal: Array
    state: State  # state of the model with the obstacles where they are, and the arm at the start
    objects: Sequence[Sequence[Any]]


@dataclass(frozen=True, eq=False)
class ProblemSet:
    """Problems that differ by the poses of the same obstacles.

    The poses are coordinates of one model: to place the obstacles of a problem takes no edit.
    """

    robot: str
    name: str  # robot and name of the set
    model: Model  # robot and obstacles, with the rules of the SRDF
    symbols: tuple[Symbol, ...]  # coordinates of the arm
    problems: tuple[PublishedProblem, ...]


def load_problem_sets(robot: str, most: int | None = None) -> Iterator[ProblemSet]:
    """Yield the problem sets of a robot of :data:`ROBOTS`."""
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
    """Return the robot with the limits of its joints, widened to hold given starts and goals.

    Some are beyond the limits by digits of π. VAMP checks no start or goal against limits, and knows no soft
    ones. Meshes that are only drawn are not among the files.
    """
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
