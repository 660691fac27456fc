"""Settings of a robot that is reached by topics: a TOML file, checked against the robot's model."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from kineverse.errors import (
    DuplicateNameError,
    FormatError,
    InvalidValueError,
    UnknownNameError,
    list_some,
    suggest,
)
from kineverse.formats.files import read_file
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.frame_dependence import FrameDependence
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

from .names import TF, NameMap, check_topics
from .robot_link import Wiring

TIMEOUT = 0.08
"""Age of commands and readings at which a robot stops [s]: with the way of a message it is below 100 ms."""

_BASES = ("base_footprint", "base_link")  # frames whose speed a Twist says, by custom
_NO_TOPIC = re.compile(r"[^A-Za-z0-9_/]|(?<=/)(?=\d)")  # what a name of a topic lacks, in one of a frame


class BaseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the mobile base is moved and read."""

    command: str = "cmd_vel"  # topic of Twist: the speed of the frame in its own axes
    frame: str | None = None  # frame in ROS; None for base_footprint or base_link where the model has one
    fixed: str = "odom"  # frame in ROS that stands for the one in which the model's base moves
    joints: tuple[str, ...] = ()  # names of its coordinates in joint states; none to read TF


class RobotSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a robot as they are written; what is missing follows from the model."""

    joint_states: str = "joint_states"
    joints: dict[str, str] = {}  # names in ROS by names in the model, or by prefixes that end in /
    frames: dict[str, str] = {}
    base: BaseSettings = BaseSettings()
    controllers: dict[str, tuple[str, ...]] | None = None  # joints by velocity controller
    trajectory: str = "joint_trajectory_controller/joint_trajectory"
    observed: dict[str, str] | None = None  # topics of poses by frame of the model, or tf: and a frame in TF
    timeout: float = TIMEOUT
    use_sim_time: bool = False  # whether stamps are those of a simulator, /clock


def read_settings(path: str | os.PathLike[str]) -> RobotSettings:
    """Return the settings in a TOML file."""
    name = os.fspath(path)
    try:
        return msgspec.convert(tomllib.loads(read_file(Path(path)).decode()), RobotSettings)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FormatError(f"{name}: not TOML: {str(error)[:200]}.") from None
    except msgspec.ValidationError as error:
        what = str(error).replace("`", "'").replace("'$.", "'")
        raise FormatError(
            f"{name}: {what}. The keys are {', '.join(RobotSettings.__struct_fields__)}, and those of [base] "
            f"are {', '.join(BaseSettings.__struct_fields__)}."
        ) from None


@dataclass(frozen=True, eq=False)
class RobotConnection:
    """A robot's model in terms of topics.

    Attributes
    ----------
    wiring
        What the robot node needs.
    base_speeds
        Speeds of the model that move the mobile base.
    base_frame
        Frame whose speed a Twist says.
    frame_in_base
        Pose (4, 4) of that frame in the one that the mobile base moves.
    controllers
        Speeds of each controller, in its order.
    joints
        Names of joints and coordinates in ROS.
    """

    wiring: Wiring
    base_speeds: tuple[Symbol, ...]
    base_frame: str
    frame_in_base: Array
    controllers: tuple[tuple[Symbol, ...], ...]
    joints: NameMap


def connect_names(robot: Robot, settings: RobotSettings, marked: Iterable[str]) -> RobotConnection:
    """Return how a robot of a model is reached; frames with markers count where settings name none.

    Every free speed of the robot is of its base or of one controller. Otherwise, and for names that are
    nowhere, that is an error.
    """
    if not 0.0 < settings.timeout <= 0.1:
        raise InvalidValueError(
            f"timeout = {settings.timeout:g}: a robot stops within 0.1 s, so that is a time up to 0.1 [s]."
        )
    model, base = robot.model, robot.base
    prefix = {f"{robot.name}/": ""} if robot.name else {}
    coordinates = [str(s) for s in robot.coordinates]
    articulations = [name for name in model.articulations if robot.owns(name) or robot.moves(Symbol(name))]
    names = tuple(dict.fromkeys([*coordinates, *articulations]))
    placing = () if base is None else tuple(map(str, base.coordinates))
    own = settings.base
    if own.joints:
        if len(own.joints) != len(placing):
            raise InvalidValueError(
                f"[base] joints has {len(own.joints)} names; the base of '{robot.name}' has the coordinates "
                f"{', '.join(placing) or 'none'}."
            )
        placed = dict(zip(placing, own.joints, strict=True))
    else:
        placed = {}
        if base is not None and not base.is_planar:
            raise InvalidValueError(
                f"TF says where a base is that moves by x, y and a heading; '{base.child}' moves by "
                f"{', '.join(placing)}: name them in joint states by [base] joints."
            )
    used = {name: other for name, other in prefix.items() if any(one.startswith(name) for one in names)}
    rules = used | settings.joints | placed
    joints = NameMap(names, rules)
    frame, frame_in_base = _find_base_frame(robot, own)
    frames = NameMap(
        [*model.frames, *([] if WORLD in model.frames else [WORLD])],
        {key: other for key, other in prefix.items() if any(f.startswith(key) for f in model.frames)}
        | ({} if base is None else {base.parent: own.fixed})
        | settings.frames,
    )
    base_speeds = () if base is None else _find_speeds(robot, base.child, base.parent)
    controllers = _find_controllers(robot, settings.controllers, joints, base_speeds)
    poses, transforms = _find_observed(robot, settings.observed, marked)
    read = tuple(name for name in coordinates if own.joints or name not in placing)
    in_tf = base is not None and not own.joints
    objects = FrameDependence(model, [s for s in model.degrees_of_freedom if not robot.moves(s)])
    wiring = Wiring(
        settings.joint_states,
        names,
        rules,
        read,
        (own.fixed, frames.to_ros(frame)) if in_tf else None,
        own.command if base_speeds else None,
        tuple((f"{name}/commands", len(speeds)) for name, speeds in controllers.items()),
        settings.trajectory,
        {frames.to_ros(name): name for name in (*model.frames, WORLD) if not objects.moves(name)},
        poses,
        transforms,
        settings.timeout,
        settings.use_sim_time,
    )
    topics = [own.command, *(topic for topic, _ in wiring.controllers), *poses.values()]
    check_topics([settings.joint_states, settings.trajectory, *topics])
    return RobotConnection(wiring, base_speeds, frame, frame_in_base, tuple(controllers.values()), joints)


def _find_speeds(robot: Robot, child: str, parent: str) -> tuple[Symbol, ...]:
    """Return the free speeds that move a frame in another one."""
    model, found = robot.model, set[Symbol]()
    for s in model.fk(child, relative_to=parent).symbols:
        found |= {*model.rates[s]} if s in model.rates else {s.derivative()}
    return tuple(v for v in robot.speeds if v in found)


def _find_base_frame(robot: Robot, settings: BaseSettings) -> tuple[str, Array]:
    """Return the frame of a base whose speed is commanded, and its pose (4, 4) in the base."""
    base, model, prefix = robot.base, robot.model, f"{robot.name}/" if robot.name else ""
    if base is None:
        return WORLD, np.eye(4)
    still = (*base.coordinates,)
    wanted = settings.frame
    for name in _BASES if wanted is None else (wanted,):
        frame = f"{prefix}{name}"
        if frame not in model.frames:
            continue
        pose = model.fk(frame, relative_to=base.child)
        if not pose.symbols and {*still} & {*model.symbols_of(frame)}:
            return frame, np.asarray(pose({}))
    if wanted is None or f"{prefix}{wanted}" == base.child:
        return base.child, np.eye(4)
    raise UnknownNameError(
        f"[base] frame = '{wanted}': '{robot.name}' has no frame of that name that stands still on its base. "
        f"{suggest(wanted, [name.removeprefix(prefix) for name in robot.frames], 'frame')}"
    )


def _find_controllers(
    robot: Robot,
    given: Mapping[str, tuple[str, ...]] | None,
    joints: NameMap,
    base_speeds: Iterable[Symbol],
) -> dict[str, tuple[Symbol, ...]]:
    """Return the speeds of velocity controllers by name; without settings there is one for all of them."""
    moved = {str(v.position): v for v in robot.speeds if v not in {*base_speeds}}
    if given is None:
        return {"velocity_controller": tuple(moved.values())} if moved else {}
    found: dict[str, tuple[Symbol, ...]] = {}
    owner: dict[str, str] = {}
    for controller, names in given.items():
        speeds = []
        for name in names:
            joint = joints.to_model(name)
            if joint is None or joint not in moved:
                known = [joints.to_ros(one) for one in moved]
                raise UnknownNameError(
                    f"[controllers] {controller} has '{name}', and no joint of '{robot.name}' that moves by "
                    f"itself has that name. {suggest(name, known, 'joint')}"
                )
            if joint in owner:
                raise DuplicateNameError(
                    f"[controllers]: '{name}' is in '{owner[joint]}' and in '{controller}'. Leave it in one."
                )
            owner[joint] = controller
            speeds.append(moved[joint])
        found[controller] = tuple(speeds)
    if lacking := [joints.to_ros(name) for name in moved if name not in owner]:
        raise InvalidValueError(
            f"[controllers]: no controller moves {list_some(lacking, 4)}. List it in one."
        )
    return found


def _find_observed(
    robot: Robot, given: Mapping[str, str] | None, marked: Iterable[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return topics of poses by frame of the model, and frames of the model by observed frame in TF."""
    if given is None:
        given = {name: _NO_TOPIC.sub("_", f"poses/{name}") for name in marked}
    frames = robot.model.frames
    for name in given:
        if name not in frames:
            raise UnknownNameError(
                f"[observed]: there is no frame '{name}'. {suggest(name, frames, 'frame')}"
            )
    poses, transforms = dict[str, str](), dict[str, str]()
    sources: dict[str, str] = {}
    for name, source in given.items():
        if (other := sources.setdefault(source, name)) != name:
            raise DuplicateNameError(f"[observed]: '{source}' stands for '{other}' and for '{name}'.")
        if source.startswith(TF) and source != TF:
            transforms[source.removeprefix(TF)] = name
        else:
            poses[name] = source
    return poses, transforms
