"""A PR2 that stands in a kitchen and moves its arms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.articulations import OmniBase
from kineverse.errors import UnknownNameError
from kineverse.formats.sources import locate_model
from kineverse.geometry import Rule, Scene
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .agreement import Array
from .robot import PR2

KITCHENS = {"iai_kitchen/urdf_obj/kitchen.urdf": (0.3, 1.5), "kitchen": (0.2, 0.8)}
"""The kitchen with meshes from the model path, else the one that ships; and where the robot stands in it [m]:
before the counters, so that much is near and hardly anything is hit."""

_STEP, _RANGE = 0.003, 0.3


@dataclass(frozen=True)
class KitchenRobot:
    """A robot in a kitchen.

    Attributes
    ----------
    name
        What they are.
    model
        Both, below the prefixes ``robot`` and ``kitchen``.
    values
        (steps, n) values of ``scene().inputs`` [m], [rad]: a walk of all joints of the robot.
    """

    name: str
    model: Model
    values: Array

    def scene(self) -> Scene:
        """Return a scene in which robot and kitchen are looked at, but neither with itself."""
        return _scene(self.model)

    def whole_scene(self) -> Scene:
        """Return a scene without rules, so that what overlaps in the robot itself is looked at as well."""
        return Scene(self.model)


def kitchen_robot(steps: int) -> KitchenRobot:
    """Return the first PR2 and the first kitchen that are found here, with their meshes as hulls."""
    robot, kitchen = _first(PR2), _first(tuple(KITCHENS))
    model = Model()
    with model.edit() as edit:
        edit.include(kitchen, "kitchen")
        edit.include(robot, "robot")
        edit.apply(OmniBase(name="base", parent=WORLD, child="base"))
        root = next(name for name, frame in model.frames.items() if _is_root(name, frame.parent))
        edit.attach(root, "base", np.eye(4))
    scene = _scene(model)
    x, y = KITCHENS[kitchen]
    home = {**model.default_state(), model.symbol("base/x"): x, model.symbol("base/y"): y}
    start = np.array([home[symbol] for symbol in scene.inputs])
    moving = np.array([symbol.path.startswith("robot/") for symbol in scene.inputs])
    random = np.random.default_rng(0)
    walk = np.cumsum(random.normal(size=(steps, len(start))) * _STEP, axis=0)
    name = f"{_name(robot)} in {_name(kitchen)}"
    return KitchenRobot(name, model, start + moving * np.clip(walk, -_RANGE, _RANGE))


def _scene(model: Model) -> Scene:
    apart = (
        Rule(f"{name}/*", f"{name}/*", why="only the robot in the kitchen") for name in ("robot", "kitchen")
    )
    return Scene(model, rules=apart)


def _is_root(name: str, parent: str) -> bool:
    return parent == WORLD and name.startswith("robot/")


def _first(names: tuple[str, ...]) -> str:
    for name in names[:-1]:
        try:
            locate_model(name)
        except UnknownNameError:
            continue
        return name
    return names[-1]


def _name(name: str) -> str:
    return f"{name} (shipped)" if "/" not in name else name.rpartition("/")[2]
