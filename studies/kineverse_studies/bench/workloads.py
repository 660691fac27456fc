"""Robots of the benchmarks: a PR2 with one frame of interest, and a PR2 in a kitchen."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from kineverse.articulations import OmniBase
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError
from kineverse.formats import load
from kineverse.formats.locate import locate_model
from kineverse.geometry import Rule, Scene
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.symbols import Symbol

from .harness import BenchmarkSettings

PR2 = ("pr2_description/robots/pr2.urdf", "pr2_description/urdf/pr2.urdf", "pr2")
"""A real PR2 from the model path or from example-robot-data, else the one that ships."""
GRIPPER = "r_gripper_tool_frame"
_ONE_COORDINATE = ("fixed", "revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class BenchmarkRobot:
    file: Path  # file that all libraries read
    model: Model  # model of the file in Kineverse, without prefix
    frame: str  # frame of the pose and Jacobian, which are relative to the robot's root

    @cached_property
    def coordinates(self) -> tuple[Symbol, ...]:
        """Coordinates, in the order of the columns of :meth:`configurations`."""
        return self.model.symbols

    @cached_property
    def chain(self) -> tuple[Symbol, ...]:
        return self.model.fk(self.frame).symbols

    @cached_property
    def mimics(self) -> dict[str, tuple[str, float, float]]:
        """Leader, multiplier and offset of mimic joints by name, read from the file."""
        joints = ElementTree.parse(self.file).iterfind("joint")
        return {
            joint.get("name", ""): (
                mimic.get("joint", ""),
                float(mimic.get("multiplier", 1)),
                float(mimic.get("offset", 0)),
            )
            for joint in joints
            if (mimic := joint.find("mimic")) is not None
        }

    def configurations(self, count: int) -> Array:
        """Return configurations [rad], [m] in [-1, 1], shape (count, coordinates), from a fixed seed."""
        return np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self.coordinates)))

    def chain_columns(self, configurations: Array) -> Array:
        columns = [self.coordinates.index(symbol) for symbol in self.chain]
        return np.ascontiguousarray(configurations[:, columns])

    def positions(self, configurations: Array) -> dict[str, Array]:
        columns = zip(self.coordinates, configurations.T, strict=True)
        known = {symbol.path: np.array(column) for symbol, column in columns}

        def position(joint: str) -> Array:
            if joint not in known:
                leader, multiplier, offset = self.mimics[joint]
                known[joint] = multiplier * position(leader) + offset
            return known[joint]

        for joint in self.mimics:
            position(joint)
        return known

    def __str__(self) -> str:
        return (
            f"{self.file.name} ({len(self.model.frames)} links, {len(self.coordinates) + len(self.mimics)} "
            f"moving joints, {self.file})"
        )


def find_benchmark_robot(settings: BenchmarkSettings) -> BenchmarkRobot:
    file = locate_model(settings.robot or _first_found(PR2)).path
    if file.suffix != ".urdf":
        raise InvalidValueError(f"Peers read URDF, and {str(file)!r} is none; give another --robot.")
    model = load(file, prefix="")
    for name, articulation in model.articulations.items():
        if articulation.kind not in _ONE_COORDINATE:
            raise InvalidValueError(
                f"Joint {name!r} is {articulation.kind}; robots to measure have joints with one coordinate."
            )
    robot = BenchmarkRobot(file, model, settings.frame or _default_frame(model))
    _check_chain(robot)
    return robot


def _default_frame(model: Model) -> str:
    if GRIPPER in model.frames:
        return GRIPPER
    frames = [frame for frame in model.frames if _mimic_joint(model, frame) is None]
    return max(frames, key=lambda frame: (len(model.speeds_of(frame)), frame))


def _check_chain(robot: BenchmarkRobot) -> None:
    if robot.frame not in robot.model.frames:
        robot.model.fk(robot.frame)  # raises, with similar names
    follower = _mimic_joint(robot.model, robot.frame)
    if follower is not None:
        raise InvalidValueError(
            f"{robot.frame!r} is moved by {follower!r}, which follows another joint; choose another --frame."
        )
    if not robot.chain:
        raise InvalidValueError(f"Nothing moves {robot.frame!r}; choose another --frame.")


def _mimic_joint(model: Model, frame: str) -> str | None:
    above = {a.child: (name, a) for name, a in model.articulations.items()}
    while frame != WORLD:
        if frame in above:
            name, articulation = above[frame]
            if articulation.kind != "fixed" and not articulation.coordinates:
                return name
        frame = model.frames[frame].parent
    return None


def strip_shapes(file: str | os.PathLike[str]) -> str:
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise KineverseError(f"{file}: {error}") from None
    for element in [e for e in root if e.tag not in ("link", "joint")]:
        root.remove(element)
    for link in root.iterfind("link"):
        for shape in [e for e in link if e.tag in ("visual", "collision")]:
            link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


KITCHENS = {"iai_kitchen/urdf_obj/kitchen.urdf": (0.3, 1.5), "kitchen": (0.2, 0.8)}
"""Kitchen with meshes from the model path, else the shipped one, with the robot's position [m].

The robot stands close to the counters, so that many bodies are near and few are in contact."""
_WALK_STEP, _WALK_RANGE = 0.003, 0.3


@dataclass(frozen=True)
class KitchenRobot:
    name: str
    model: Model  # model of both, with the prefixes ``robot`` and ``kitchen``
    # values of ``scene().inputs``, (steps, n) [m], [rad]: a random walk of all joints of the robot
    values: Array

    @property
    def gripper(self) -> str:
        return f"robot/{GRIPPER}"

    def scene(self) -> Scene:
        return _make_scene(self.model)

    def whole_scene(self) -> Scene:
        """Return a scene without rules, which also checks pairs within the robot and within the kitchen."""
        return Scene(self.model)


def make_kitchen_robot(steps: int) -> KitchenRobot:
    robot, kitchen = _first_found(PR2), _first_found(tuple(KITCHENS))
    model = _on_omni_base(robot, kitchen)
    scene = _make_scene(model)
    x, y = KITCHENS[kitchen]
    home = {**model.default_state(), model.symbol("base/x"): x, model.symbol("base/y"): y}
    start = np.array([home[symbol] for symbol in scene.inputs])
    moving = np.array([symbol.path.startswith("robot/") for symbol in scene.inputs])
    random = np.random.default_rng(0)
    walk = np.cumsum(random.normal(size=(steps, len(start))) * _WALK_STEP, axis=0)
    name = f"{_model_name(robot)} in {_model_name(kitchen)}"
    return KitchenRobot(name, model, start + moving * np.clip(walk, -_WALK_RANGE, _WALK_RANGE))


def make_kitchen_model() -> tuple[str, Model]:
    """Return the first PR2 that is found, on an omnidirectional base in the shipped kitchen, and a name."""
    robot, kitchen = _first_found(PR2), "kitchen"
    return f"{_model_name(robot)} in {_model_name(kitchen)}", _on_omni_base(robot, kitchen)


def _on_omni_base(robot: str, kitchen: str) -> Model:
    model = Model()
    with model.edit() as edit:
        edit.include(kitchen, "kitchen")
        edit.include(robot, "robot")
        edit.apply(OmniBase(name="base", parent=WORLD, child="base"))
        loose = (name for name, frame in model.frames.items() if frame.parent == WORLD)
        edit.attach(next(name for name in loose if name.startswith("robot/")), "base", np.eye(4))
    return model


def _make_scene(model: Model) -> Scene:
    why = "only the robot in the kitchen"
    return Scene(model, rules=[Rule(f"{name}/*", f"{name}/*", why=why) for name in ("robot", "kitchen")])


def _first_found(names: tuple[str, ...]) -> str:
    for name in names[:-1]:
        try:
            locate_model(name)
        except UnknownNameError:
            continue
        return name
    return names[-1]


def _model_name(name: str) -> str:
    return f"{name} (shipped)" if "/" not in name else name.rpartition("/")[2]
