"""Starts, goals, holds and robots of ``kineverse plan``, as they are written on the command line."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import kineverse as kv
from kineverse.control import Hold
from kineverse.errors import FormatError, InvalidValueError, UnknownNameError, suggest
from kineverse.manipulation import place_robot
from kineverse.model.model_view import ModelView
from kineverse.planning.manifold import hold_frames
from kineverse.planning.planning_space import free_coordinates

from .arguments import parse_assignments, parse_pose_numbers, parse_value

_ALL = "xyz rx ry rz"


@dataclass(frozen=True)
class FrameTarget:
    """Wanted pose of a frame: ``A@B``, ``A@B+X,Y,Z`` or ``A@X,Y,Z``, with or without ``:MASK``."""

    frame: str
    target: str  # other frame; the world for numbers
    numbers: tuple[float, ...]  # position, or position and roll, pitch, yaw, in the other frame [m], [rad]
    mask: str  # directions, see Planner.hold

    @property
    def directions(self) -> set[str]:
        """The directions of the mask, one by one."""
        return {r for part in self.mask.split() for r in ([part] if part.startswith("r") else part)}


@dataclass
class Request:
    """Words of an option: values by name, frames with their targets, names of states."""

    values: dict[str, float] = field(default_factory=dict)  # values of coordinates by name [m], [rad]
    targets: list[FrameTarget] = field(default_factory=list)  # poses of frames
    names: list[str] = field(default_factory=list)  # other words, which name states of the SRDF
    assignments: list[str] = field(default_factory=list)  # texts of the values, for their units

    def resolve(self, states: Mapping[str, Mapping[str, float]], option: str) -> None:
        """Replace names by the values of these states; values that are given win."""
        for name in self.names:
            if name not in states:
                hint = suggest(name, states, "state") if states else "Names of states need --srdf."
                raise UnknownNameError(
                    f"{option} {name}: write NAME=VALUE, FRAME@FRAME, FRAME@X,Y,Z or a state of the SRDF. "
                    f"{hint}"
                )
            self.values = {**states[name], **self.values}


def parse_request(words: Iterable[str], option: str, read_files: bool = False) -> Request:
    """Return what the words of an option ask for."""
    found = Request()
    for word in words:
        if "=" in word:
            found.assignments.append(word)
        elif "@" in word:
            found.targets.append(parse_frame_target(word, option))
        elif read_files and word.endswith(".json"):
            found.values |= _read_values(word)
        else:
            found.names.append(word)
    found.values |= parse_assignments(found.assignments, option)
    return found


def parse_frame_target(word: str, option: str) -> FrameTarget:
    """Return the pose of a frame from ``A@B``, ``A@B+X,Y,Z`` or ``A@X,Y,Z``, see :class:`FrameTarget`."""
    frame, _, rest = word.partition("@")
    where, _, mask = rest.partition(":")
    mask = mask.replace(",", " ")
    target, plus, offset = where.partition("+")
    if not plus and "," in where:
        target, offset = "world", where
    parts = offset.split(",") if offset else []
    if not frame or not target or len(parts) not in (0, 3, 6) or (plus and not parts):
        raise InvalidValueError(
            f"{option} {word}: write FRAME@FRAME, FRAME@FRAME+X,Y,Z or FRAME@X,Y,Z, where ROLL,PITCH,YAW may "
            "follow X,Y,Z."
        )
    position_only = len(parts) == 3 and not plus
    numbers = parse_pose_numbers(parts)
    return FrameTarget(frame, target, numbers, mask or ("xyz" if position_only else _ALL))


def add_robot_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--robot`` to a command."""
    parser.add_argument(
        "--robot",
        metavar="ROBOT[@X,Y,ANGLE]",
        help="a robot that is put into the model, by name or file, and its place (X,Y,Z,ANGLE if bolted)",
    )


def include_robot(
    arguments: argparse.Namespace, model: kv.Model, prefix: str | None = ""
) -> tuple[str, dict[kv.Symbol, float]]:
    """Put the robot of ``--robot`` into a model; return its prefix and the place of its base by symbol.

    Its names are those of its description, or below a prefix, as :func:`.place_robot` says.
    """
    source, place = parse_robot(arguments.robot)
    robot = place_robot(
        model,
        source,
        place,
        prefix=prefix,
        root=arguments.root,
        strict=arguments.strict,
        loops=arguments.loops,
    )
    return robot.name, dict(robot.place)


def parse_robot(text: str) -> tuple[str, tuple[float, ...] | None]:
    """Return the source of a robot and its place from ``ROBOT@X,Y,ANGLE`` or ``ROBOT@X,Y,Z,ANGLE``."""
    source, at, place = text.rpartition("@")
    if not at:
        return text, None
    parts = place.split(",")
    if len(parts) not in (3, 4):
        raise InvalidValueError(
            f"--robot {text}: a place is X,Y,ANGLE, such as fetch@1,0.5,90deg, or X,Y,Z,ANGLE for a robot "
            "that is bolted to something."
        )
    return source, tuple(parse_value(part) for part in parts)


def find_robot_name(model: ModelView, wanted: str | None) -> str:
    """Return the prefix of a robot's names in a served model; without a name, of the only one in it."""
    from kineverse.manipulation.robot_sources import SHIPPED  # for start-up time
    from kineverse.worlds import Robot  # for start-up time

    heads = dict.fromkeys(s.path.partition("/")[0] for s in model.degrees_of_freedom if "/" in s.path)
    if wanted in heads:
        return wanted
    robots = [head for head in heads if head in SHIPPED or Robot.of(model, head).grippers]
    if wanted is not None:
        raise UnknownNameError(
            f"--robot {wanted}: the served model has none. {suggest(wanted, robots, 'robot')}"
        )
    if len(robots) != 1:
        found = "several robots: " + ", ".join(robots) if robots else "no robot"
        raise UnknownNameError(
            f"The served model has {found}. "
            + (
                "Name one: --robot ROBOT."
                if robots
                else "'kineverse serve MODEL --robot ROBOT' puts one into it."
            )
        )
    return robots[0]


def make_hold(model: kv.Model, given: FrameTarget) -> Hold:
    """Return the hold that a target stands for."""
    offset = None
    if given.numbers:
        offset = kv.translation(*given.numbers[:3]) @ kv.rpy(*(given.numbers[3:] or (0.0, 0.0, 0.0)))
    hold = hold_frames(model, given.frame, given.target, given.mask, offset)
    if given.target == "world":
        # Nothing is held there, so that nothing may be touched.
        return Hold(hold.expression, 0.0, name=hold.name)
    return hold


def make_grip(
    model: kv.Model, given: FrameTarget, start: Iterable[FrameTarget], state: kv.State | None
) -> Hold | None:
    """Return a hold along a path, as the start says; else of frames as they are at a state.

    Without a state it is None where the start says nothing.
    """
    same = find_same_grip(given, start)
    if same is not None:
        return make_hold(model, replace(same, mask=given.mask))
    if given.numbers:
        raise InvalidValueError(
            f"--along {given.frame}@{given.target}: frames are held as they are at the start, so numbers are "
            "given there, with --from."
        )
    offset = model.fk(given.frame, given.target)
    return None if state is None else hold_frames(model, given.frame, given.target, given.mask, offset(state))


def find_same_grip(given: FrameTarget, start: Iterable[FrameTarget]) -> FrameTarget | None:
    """Return what the start says of the frames of a hold, in all of its directions; None if it does not."""
    same = [t for t in start if (t.frame, t.target) == (given.frame, given.target)]
    return next(
        (t for t in same if given.directions <= t.directions and given.numbers in ((), t.numbers)),
        None,
    )


def choose_coordinates(
    model: kv.Model,
    names: Iterable[str],
    targets: Iterable[FrameTarget],
    holds: Iterable[FrameTarget],
    still: Iterable[kv.Symbol],
) -> list[kv.Symbol | str]:
    """Return the coordinates to move where none are asked for.

    These are the named ones, and the free ones that frames depend on, but for some that stay still.
    """
    frames = {t.frame for t in targets} | {frame for t in holds for frame in (t.frame, t.target)}
    needed = {s for frame in frames for s in model.symbols_of(frame)}
    found = [s for s in free_coordinates(model) if s in needed and s not in {*still}]
    # The planner says why it cannot move a named one.
    return [*found, *(name for name in names if model.symbol(name) not in found)]


def _read_values(path: str) -> dict[str, float]:
    """Return values by name from a JSON object, or from its part ``positions``."""
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise FormatError(f"{path}: not JSON: {str(error)[:200]}.") from None
    values = document.get("positions", document) if isinstance(document, dict) else None
    if not isinstance(values, dict) or not all(
        type(v) in (int, float) and math.isfinite(v) for v in values.values()
    ):
        raise FormatError(f'{path}: not an object of numbers by name, such as {{"door": 0.3}}.')
    return {name: float(value) for name, value in values.items()}
