"""Placement of a robot next to furniture: the prefix of its names, its base, its place, its start."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from kineverse._checks import finite_number
from kineverse.articulations import OmniBase
from kineverse.errors import InvalidValueError
from kineverse.formats import load
from kineverse.geometry import Rule, Scene
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD, is_of_robot
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.model.registry import LoopTreatment
from kineverse.spatial import rotation_z, translation
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

from .robot_sources import SHIPPED, mount

_DEEPEST = 2e-4  # depth below which bodies only touch at the start [m]
_RING, _RINGS, _DIRECTIONS = 0.25, 16, 12  # distance of rings of places [m], their number, and places on each


@dataclass(frozen=True)
class PlacedRobot:
    """Robot that was put into a model.

    Attributes
    ----------
    name
        Prefix of its names; empty if they have none in common.
    base
        Coordinates x, y and angle of its mobile base; none without one.
    place
        Values of these at the place where it was put; none if it was put nowhere in particular.
    source
        Name or path of its description.

    See Also
    --------
    kineverse.manipulation.place_robot
    """

    name: str
    base: tuple[Symbol, ...]
    place: Mapping[Symbol, float]
    source: str

    def start_state(self, model: ModelView) -> State:
        """Return the default state with the robot at its place; shipped robots have their arms tucked in."""
        known = SHIPPED.get(self.source)
        state = model.default_state() if known is None else known.start_state(model)
        return state.updated(self.place)

    def find_free_start(self, model: ModelView, state: State) -> tuple[State, str]:
        """Move the base to the nearest place where the robot touches nothing.

        Parameters
        ----------
        model
            Model with the robot and the furniture.
        state
            State of everything; a robot that was put to a place, or has no base, stays there.

        Returns
        -------
        The state at the start, and the bodies that touch at the given state, empty if it is free.

        Raises
        ------
        InvalidValueError
            If the robot touches something at each place.
        """
        base = () if self.place else self.base
        free, contact = find_free_state(model, self.name, _list_places(state, base), -_DEEPEST)
        if free is None:
            raise InvalidValueError(
                f"The robot '{self.name}' begins in contact: {contact}. Give it another place."
            )
        return free, contact


def place_robot(
    model: Model,
    robot: str | os.PathLike[str],
    at: Sequence[float] | None = None,
    *,
    base: Literal["omni"] | None = None,
    prefix: str | None = None,
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
    loops: LoopTreatment = "solve",
) -> PlacedRobot:
    """Put a robot into a model, next to its furniture.

    Parameters
    ----------
    robot
        Name of a shipped robot, or path of its description.
    at
        Place: x, y [m] and the angle about z [rad] of its mobile base, or x, y, z and the angle of a robot
        that is bolted to something; None where its description has it.
    base
        ``"omni"`` to put it on a base that moves in all directions.
    prefix
        Prefix of its names; None for its own, or for the name of the file where they have none in common;
        empty for the names of the description.
    root, strict, loops
        See :func:`kineverse.load`.

    Raises
    ------
    InvalidValueError
        If nothing of it moves, if the model has names below its prefix, if it has a base already, or cannot
        be moved to such a place. The model is unchanged then.
    KineverseError
        If the description cannot be read.

    Examples
    --------
    >>> scene = kv.load("shelf_door")
    >>> robot = kv.manipulation.place_robot(scene, "hsr", at=(-1.0, 0.0, 0.0))
    >>> robot.name, robot.base
    ('hsr', (hsr/base/x, hsr/base/y, hsr/base/angle))
    >>> robot.start_state(scene)["hsr/base/x"]
    -1.0
    """
    source = os.fspath(robot)
    if prefix != "":
        prefix, name = _choose_prefix(model, source, prefix, base, root, strict, loops)
    frames = {*model.frames}
    with model.edit() as edit:
        edit.include(source, prefix or None, root=root, strict=strict, loops=loops)
        added = [frame for frame in model.frames if frame not in frames]
        if prefix == "":
            name = next((frame.partition("/")[0] for frame in added if "/" in frame), "")
        if base is not None:
            _add_base(edit, name)
        coordinates = Robot(model, name, [f for f in model.frames if f not in frames]).planar_base
        place = {} if at is None else _put(edit, coordinates, added, at)
    return PlacedRobot(name, coordinates, place, source)


def _choose_prefix(
    model: ModelView,
    source: str,
    prefix: str | None,
    base: str | None,
    root: str | os.PathLike[str] | None,
    strict: bool,
    loops: LoopTreatment,
) -> tuple[str | None, str]:
    """Return the prefix to include a robot with, None for its own, and the one that its names then have."""
    alone = load(source, prefix, root=root, strict=strict, loops=loops)
    names = [name for name in (*alone.frames, *map(str, alone.degrees_of_freedom)) if name != WORLD]
    heads = {name.partition("/")[0] if "/" in name else "" for name in names}
    if not alone.degrees_of_freedom and base is None:
        raise InvalidValueError(f"Nothing of {source} moves, so it is no robot.")
    own = heads.pop() if len(heads) == 1 else ""
    if not own:
        prefix = own = re.sub(r"[^\w-]+", "_", Path(source).name.partition(".")[0]) or "robot"
    known = (*model.frames, *map(str, model.degrees_of_freedom))
    taken = next((name for name in known if name.startswith(f"{own}/")), None)
    if taken is not None:
        raise InvalidValueError(
            f"The model has '{taken}', and the names of {source} begin with '{own}/', too. "
            "Give the furniture alone as the model, or a robot with another name."
        )
    return prefix, own


def _add_base(edit: Edit, robot: str) -> None:
    model = edit.model
    inside = {name: placed for name, placed in model.frames.items() if is_of_robot(name, robot)}
    roots = [name for name, placed in inside.items() if placed.parent == WORLD]
    if any(model.speeds_of(name) for name in roots):
        raise InvalidValueError(f"The robot '{robot}' has a base that moves already.")
    name = f"{robot}/base" if f"{robot}/base" not in inside else f"{robot}/omni_base"
    mount(edit, OmniBase(name=name, parent=WORLD, child=f"{name}_carrier"), roots)


def _put(
    edit: Edit, base: Sequence[Symbol], frames: Sequence[str], at: Sequence[float]
) -> dict[Symbol, float]:
    """Put a robot to a place: return the values of its mobile base, or move its roots if it has none."""
    numbers = [finite_number(number) for number in at]
    if len(numbers) not in (3, 4) or None in numbers:
        raise InvalidValueError(f"A place is x, y and an angle, or x, y, z and an angle, not {tuple(at)!r}.")
    x, y, z, angle = (*at[:2], at[2] if len(at) == 4 else 0.0, at[-1])
    if base:
        if z:
            raise InvalidValueError(
                f"The robot's base stands on the floor, so it has no height {z:g}: give X,Y,ANGLE."
            )
        return dict(zip(base, map(float, (x, y, angle)), strict=True))
    model = edit.model
    roots = [name for name in frames if model.frames[name].parent == WORLD]
    moving = [name for name in roots if model.speeds_of(name)]
    if moving:
        raise InvalidValueError(
            f"'{moving[0]}' moves in the world by coordinates of its own, and not by x, y and angle: set "
            "those instead of a place."
        )
    moved = translation(x, y, z) @ rotation_z(angle)
    for name, pose in {name: np.asarray((moved @ model.fk(name))({})) for name in roots}.items():
        edit.attach(name, WORLD, pose)
    return {}


def _list_places(state: State, base: Sequence[Symbol]) -> Iterator[State]:
    """Yield a state, and those with the base on rings around its place."""
    yield state
    if len(base) < 2:
        return
    x, y = base[:2]
    for ring, turn in product(range(1, _RINGS + 1), range(_DIRECTIONS)):
        angle, radius = math.tau * turn / _DIRECTIONS, _RING * ring
        yield state.updated({x: state[x] + radius * math.cos(angle), y: state[y] + radius * math.sin(angle)})


def find_free_state(
    model: ModelView,
    robot: Robot | str,
    states: Iterable[State],
    margin: float = 0.0,
    rules: Iterable[Rule] = (),
) -> tuple[State | None, str]:
    """Return the first of some states in which a robot touches nothing, and its contact in the first."""
    scene, robot = Scene.of(model), Robot.of(model, robot)
    robot_bodies = [body for body in scene.bodies if robot.owns(body)]
    others = [body for body in scene.bodies if not robot.owns(body)]
    near = (
        scene.watch(robot_bodies, others, radius=max(margin, 0.0), rules=rules)
        if robot_bodies and others
        else None
    )
    contact = None
    for state in states:
        if near is None:
            return state, ""
        scene.update(state)
        pair = next(iter(near()), None)
        touches = pair is not None and pair.distance < margin
        if contact is None:
            contact = f"{pair.a} and {pair.b}" if touches and pair is not None else ""
        if not touches:
            return state, contact
    return None, contact or ""
