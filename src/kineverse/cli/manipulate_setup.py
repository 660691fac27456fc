"""Scenes of ``kineverse open``, ``close`` and ``push``: the model with the robot, the start, the target."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .arguments import load_model, parse_assignments, parse_value, print_notes
from .output import print_line
from .plan_arguments import find_base, parse_robot, place_robot

if TYPE_CHECKING:
    import kineverse as kv
    from kineverse.grasping import Gripper

OPENING = 0.4
"""Distance from shut at which closing and pushing begin [m], [rad]."""
_NEXT_STEP = (
    "Name a hand with two opposed fingers by --hand FRAME, or move the object with any body of the robot: "
    "kineverse push ... --hand BODY --to VALUE.",
    "Name the body of the robot that is to push by --hand BODY.",
)
"""Advice without a gripper: for grasps, and for pushes."""
_MOST_NOTES = 3
_DEEPEST = 2e-4
_RING, _RINGS, _DIRECTIONS = 0.25, 16, 12
"""Distance of rings of places [m], their number, and that of places on each."""


@dataclass(frozen=True)
class ManipulationScene:
    """Robot and furniture before a skill."""

    model: kv.Model  # model of both
    robot: str  # prefix of the robot
    coordinate: kv.Symbol  # coordinate of the object
    unit: str  # its unit, rad, m, or nothing
    start: kv.State  # state of everything
    target: float  # wanted value [m], [rad]
    gripper: Gripper | None  # gripper that is used; None if the robot has none
    why: str  # why there is no gripper
    pusher: tuple[str, ...]  # bodies that may push
    stays: bool  # whether the start of the robot was given, so that it is not placed elsewhere
    fixed: str  # why the object cannot move at the start; empty if it can
    tolerance: float  # distance from the target within which the object is there [m], [rad]


def make_scene(arguments: argparse.Namespace, skill: str) -> ManipulationScene:
    """Load the model, put the robot into it, and return everything before a skill begins."""
    from kineverse.geometry.exclusions import remove_unusable_shapes
    from kineverse.manipulation.articulated_objects import find_shut_value
    from kineverse.manipulation.robot_sources import SHIPPED
    from kineverse.manipulation.skill_arguments import choose_tolerance, explain_fixed
    from kineverse.view.sliders import infer_units

    begin, end = (None if v is None else parse_value(v) for v in (arguments.start, arguments.to))
    source, place = parse_robot(arguments.robot)
    model = load_model(arguments, arguments.model)
    prefix, named = _choose_prefix(arguments, source, model)
    before, frames = {*model.articulations}, {*model.frames}
    model.include(source, prefix, root=arguments.root, strict=arguments.strict, loops=arguments.loops)
    if arguments.base == "omni":
        _add_base(model, named)
    joints = [name for name in model.articulations if name not in before]
    standing = place_robot(model, joints, [f for f in model.frames if f not in frames], place)
    lost = remove_unusable_shapes(model)
    more = [f"and {len(lost) - _MOST_NOTES} more"] if len(lost) > _MOST_NOTES else []
    print_notes([f"without this shape: {line}" for line in lost[:_MOST_NOTES]] + more)

    coordinate = _find_coordinate(model, arguments.what, named)
    default = model.default_state()
    values = {str(s): default[s] for s in model.symbols if s in default}
    others = _parse_other_positions(arguments.assignments, model, coordinate, standing)
    default = default.updated(others)
    unit = infer_units(model, values, [str(coordinate)]).get(str(coordinate)) or ""
    for option, text in (("--from", arguments.start), ("--to", arguments.to)):
        _check_unit(option, text, coordinate, unit)
    shut = find_shut_value(model, coordinate)
    lower, upper = model.limits(coordinate)
    if begin is None:
        begin = default[coordinate] if skill == "open" else _open_from(shut, lower, upper)
    if end is None:
        end = shut if skill != "open" else max(lower, upper, key=lambda limit: abs(limit - shut))
    if not math.isfinite(end):
        raise InvalidValueError(f"'{coordinate}' has no limit at which it is open; say how far: --to VALUE.")
    fixed = explain_fixed(model, coordinate, default.updated({coordinate: begin}))
    _check_limits(model, "--from", coordinate, begin)
    if not fixed:  # that it is fixed is the result
        _check_limits(model, "--to", coordinate, end)
    state = SHIPPED[source].start_state(model) if source in SHIPPED else default
    state = state.updated(standing).updated(others).updated({coordinate: begin})
    if skill != "push":  # pushes search a place for the whole push
        free = () if place is not None else find_base(model, joints)
        state = _stand_free(model, named, state, free)
    gripper, why, pusher = _find_pusher(model, named, arguments.hand, skill)
    return ManipulationScene(
        model,
        named,
        coordinate,
        unit,
        state,
        end,
        gripper,
        why,
        pusher,
        place is not None,
        fixed,
        choose_tolerance(model, coordinate, state, end),
    )


def _parse_other_positions(
    texts: list[str], model: kv.Model, coordinate: kv.Symbol, standing: Mapping[kv.Symbol, float]
) -> dict[kv.Symbol, float]:
    """Return the values of ``--set``, of anything but the coordinate that is to change."""
    given = {model.symbol(name): value for name, value in parse_assignments(texts).items()}
    if coordinate in given:
        raise InvalidValueError(f"--set {coordinate}: --from VALUE says where it is at the start.")
    for symbol, value in given.items():
        if symbol in standing:
            raise InvalidValueError(f"--set {symbol}: --robot ROBOT@X,Y,ANGLE says where the robot stands.")
        _check_limits(model, "--set", symbol, value)
    return given


def _check_limits(model: kv.Model, option: str, coordinate: kv.Symbol, value: float) -> None:
    """Raise InvalidValueError for the value of an option that is out of limits."""
    lower, upper = model.limits(coordinate)
    if not lower - 1e-9 <= value <= upper + 1e-9:
        raise InvalidValueError(
            f"{option} {value:.4g}: '{coordinate}' is between {lower:.4g} and {upper:.4g}."
        )


def is_shut(scene: ManipulationScene) -> bool:
    """Return whether the target of a scene is where its object is shut."""
    from kineverse.manipulation.articulated_objects import find_shut_value

    shut = find_shut_value(scene.model, scene.coordinate)
    return abs(scene.target - shut) <= scene.tolerance


def _open_from(shut: float, lower: float, upper: float) -> float:
    """Return the value at a distance of :data:`OPENING` from shut, or the limit."""
    if upper - shut >= shut - lower:
        return min(shut + OPENING, upper)
    return max(shut - OPENING, lower)


def _check_unit(option: str, text: str | None, coordinate: kv.Symbol, unit: str) -> None:
    """Check that a value has a unit of lengths or of angles as its coordinate has; it may have none."""
    written = (text or "").strip()
    stated = "m" if written.endswith("m") else "rad" if written.endswith(("deg", "°", "rad")) else unit
    if unit and stated != unit:
        raise InvalidValueError(
            f"{option} {written}: '{coordinate}' is in {unit}; write "
            f"{'30deg or 0.5' if unit == 'rad' else '12cm or 0.12'}, for instance."
        )


def _choose_prefix(arguments: argparse.Namespace, source: str, model: kv.Model) -> tuple[str | None, str]:
    """Return the prefix to include a robot with, None for its own, and the one that its names then have."""
    from kineverse.model.frame import WORLD

    alone = load_model(arguments, source)
    names = [name for name in (*alone.frames, *map(str, alone.degrees_of_freedom)) if name != WORLD]
    heads = {name.partition("/")[0] if "/" in name else "" for name in names}
    if not alone.degrees_of_freedom and arguments.base is None:
        raise InvalidValueError(f"--robot {source}: nothing of it moves, so it is no robot.")
    if len(heads) == 1 and "" not in heads:
        prefix, own = None, heads.pop()
    else:
        prefix = own = re.sub(r"[^\w-]+", "_", Path(source).name.partition(".")[0]) or "robot"
    taken = next(
        (n for n in (*model.frames, *map(str, model.degrees_of_freedom)) if n.startswith(f"{own}/")), None
    )
    if taken is not None:
        raise InvalidValueError(
            f"{arguments.model} has '{taken}', which would be of the robot '{own}' of --robot {source}. "
            "Give the furniture alone as MODEL, or a robot with another name."
        )
    return prefix, own


def _add_base(model: kv.Model, robot: str) -> None:
    """Put a robot on an omnidirectional base."""
    import numpy as np

    from kineverse.articulations import OmniBase
    from kineverse.model.frame import WORLD

    own = {name: placed for name, placed in model.frames.items() if name.startswith(f"{robot}/")}
    roots = [name for name, placed in own.items() if placed.parent == WORLD]
    if any(model.speeds_of(root) for root in roots):
        raise InvalidValueError(f"--base: the robot '{robot}' has a base that moves already.")
    name = f"{robot}/base" if f"{robot}/base" not in own else f"{robot}/omni_base"
    carrier = f"{name}_carrier"
    with model.edit() as edit:
        edit.apply(OmniBase(name=name, parent=WORLD, child=carrier))
        for root in roots:
            edit.attach(root, carrier, np.asarray(model.fk(root)({})))


def _stand_free(model: kv.Model, robot: str, state: kv.State, base: Sequence[kv.Symbol]) -> kv.State:
    """Return the state with the base of a robot where it touches nothing, the nearest of some places."""
    from kineverse.manipulation.base_sampling import find_free_state

    found, problem = find_free_state(model, robot, _list_places(state, base), -_DEEPEST)
    if found is not None:
        if problem:
            where = ", ".join(f"{found[s]:.2f}" for s in base[:2])
            print_line(f"start: {problem} touch, so the robot begins at {where}")
        return found
    raise InvalidValueError(
        f"The robot '{robot}' begins in contact: {problem}. Give it another place: --robot ROBOT@X,Y,ANGLE."
    )


def _list_places(state: kv.State, base: Sequence[kv.Symbol]) -> Iterator[kv.State]:
    """Yield a state, and those with the base on rings around its place."""
    yield state
    if len(base) < 2:
        return
    x, y = base[:2]
    for ring, turn in product(range(1, _RINGS + 1), range(_DIRECTIONS)):
        angle, radius = math.tau * turn / _DIRECTIONS, _RING * ring
        yield state.updated({x: state[x] + radius * math.cos(angle), y: state[y] + radius * math.sin(angle)})


def _find_coordinate(model: kv.Model, name: str, robot: str) -> kv.Symbol:
    """Return the coordinate of a name, which is one of an object."""
    objects = [str(s) for s in model.degrees_of_freedom if not str(s).startswith(f"{robot}/")]
    if name.startswith(f"{robot}/"):
        raise InvalidValueError(
            f"--what {name} is of the robot itself; it names what the robot moves. "
            f"{suggest(name, objects, 'coordinate')}"
        )
    if name not in objects:
        raise UnknownNameError(
            f"--what {name}: the model has no such coordinate that is free to move. "
            f"{suggest(name, objects, 'coordinate')}"
        )
    return model.symbol(name)


def _find_pusher(
    model: kv.Model, robot: str, hand: str | None, skill: str
) -> tuple[Gripper | None, str, tuple[str, ...]]:
    """Return the gripper, or why there is none, and the bodies that push."""
    from kineverse.grasping import find_gripper

    if hand is not None and skill == "push":
        model.fk(hand)  # raises for an unknown frame: any body can push
    try:
        gripper = find_gripper(model, robot, hand)
    except UnknownNameError as error:
        if hand is None:
            return None, f"{error} {_NEXT_STEP[skill == 'push']}", ()
        if skill == "push" and hand in model.bodies and hand.startswith(f"{robot}/"):
            print_line(f"pusher: {hand}")
            return None, "", (hand,)
        raise
    print_line(f"gripper: {gripper}")
    return gripper, "", gripper.bodies
