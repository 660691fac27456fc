"""Skills of ``kineverse open``, ``close`` and ``push``, called with the options of the command line."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from kineverse.errors import InvalidValueError, UnknownNameError

from .manipulate_setup import ManipulationScene
from .output import join_lines, print_line, show_activity

if TYPE_CHECKING:
    from kineverse.grasping import Gripper, Handle
    from kineverse.manipulation.belief import Belief
    from kineverse.manipulation.outcome import Outcome
    from kineverse.worlds import World
    from kineverse.worlds.recorder import RecordedStep

_PLACEMENT = 60.0
"""Largest time of the search for a place of the base [s]."""
_SHORT = 0.1
"""Share of a wanted opening that may be missing at the stop of a part whose joint is learned."""
_BETWEEN_LINES = 1.0
"""Least time between two lines on the progress of a search [s]."""


def grasp_object(
    arguments: argparse.Namespace,
    scene: ManipulationScene,
    world: World,
    belief: Belief | None,
    look: Callable[[RecordedStep], None],
) -> Outcome:
    """Open or close the object by its handle."""
    found = _find_gripper_and_handle(arguments, scene)
    if isinstance(found, str):
        return skip_skill(scene, world, False, found)
    gripper, _ = found

    from kineverse.manipulation.opening.grasped_opening import open_object
    from kineverse.manipulation.session import Session

    outcome: Outcome = open_object(
        Session(world, belief=belief, on_step=look, on_search=_SearchLines()),
        scene.coordinate,
        target=scene.target,
        hand=gripper.hand,
        handle=arguments.handle,
        seconds=arguments.seconds,
        seed=arguments.seed,
    )
    return outcome


class _SearchLines:
    """Lines on standard error on the progress of a search, at most one in some seconds."""

    def __init__(self) -> None:
        self._last = -math.inf

    def __call__(self, text: str) -> None:
        """Print a line, unless another one was printed just now."""
        if (now := perf_counter()) >= self._last + _BETWEEN_LINES:
            self._last = now
            print_line(f"searching: {text}")


def open_as_unknown(
    arguments: argparse.Namespace,
    scene: ManipulationScene,
    world: World,
    belief: Belief | None,
    look: Callable[[RecordedStep], None],
) -> Outcome:
    """Open the object as if its joint was unknown."""
    found = _find_gripper_and_handle(arguments, scene)
    if isinstance(found, str):
        return skip_skill(scene, world, False, found)
    gripper, handle = found

    from kineverse.manipulation import Session, open_unknown
    from kineverse.manipulation.unknown_objects import forget_joint
    from kineverse.manipulation.unknown_objects.unknown_opening import OPEN_TURN, OPEN_WAY
    from kineverse.worlds import Sensors

    model, coordinate, start = scene.model, scene.coordinate, scene.start
    part = next((a.child for a in model.articulations.values() if coordinate in a.coordinates), None)
    if part is None:
        raise InvalidValueError(f"--unknown: '{coordinate}' is of no joint, so no part belongs to it.")
    far = None if arguments.to is None else abs(scene.target - start[coordinate])
    outcome: Outcome = open_unknown(
        Session(world, on_step=look),
        handle.frame,
        model=forget_joint(model, part, start),
        part=part,
        sensors=None if arguments.noise is None else Sensors.parse(arguments.noise),
        hand=gripper.hand,
        seconds=arguments.seconds,
        seed=arguments.seed,
        way=OPEN_WAY if far is None else far,
        turn=OPEN_TURN if far is None else far,
    )
    there = abs(world.state[coordinate] - scene.start[coordinate])
    if outcome and far is not None and there < (1.0 - _SHORT) * far:
        reason = f"{outcome.reason} That is {there:.3g}, and not {far:.3g}, from where it began."
        measures = {**outcome.measures, "failure": "other"}
        outcome = replace(outcome, done=False, reason=reason, measures=measures)
    return outcome


def push_object(
    arguments: argparse.Namespace,
    scene: ManipulationScene,
    world: World,
    belief: Belief | None,
    look: Callable[[RecordedStep], None],
) -> Outcome:
    """Push the object, from where the robot stands or from a place that is searched."""
    from kineverse.manipulation.pushing.base_placement import find_push_start, roll_out
    from kineverse.manipulation.pushing.push_controller import Pushing
    from kineverse.manipulation.pushing.push_skill import push
    from kineverse.manipulation.session import Session

    if not scene.pusher:
        return skip_skill(scene, world, False, scene.why)
    with show_activity("building the controller"):
        pushing = Pushing(
            scene.model,
            scene.coordinate,
            scene.pusher,
            scene.start,
            target=scene.target,
            robot=scene.robot,
        )
    placed, nowhere = 0, None
    if not scene.stays:
        steps = round(arguments.seconds / 0.02)
        problem = pushing.first_contact(scene.start) or roll_out(pushing, scene.start, steps)[0]
        if problem:
            with show_activity("searching for a place of the robot"):
                found = find_push_start(
                    pushing,
                    scene.start,
                    seconds=_PLACEMENT,
                    steps=steps,
                    seed=arguments.seed,
                    report=_SearchLines(),
                )
            placed, why = found.samples, f"Another place of the robot: {found.why}"
            print(f"not from where the robot stands: {problem}. {why}", file=sys.stderr)
            if found.state is not None:
                world.reset(found.state)
            else:
                nowhere = found

    session = Session(world, belief=belief, on_step=look)
    outcome = push(session, scene.coordinate, seconds=arguments.seconds, pushing=pushing)
    if not outcome and nowhere is not None:
        measures = {**outcome.measures, "failure": nowhere.failure}
        reason = f"{outcome.reason} Another place of the robot: {nowhere.why}"
        outcome = replace(outcome, reason=reason, measures=measures)
    return replace(outcome, measures={**outcome.measures, "placed": placed})


def _find_gripper_and_handle(
    arguments: argparse.Namespace, scene: ManipulationScene
) -> tuple[Gripper, Handle] | str:
    """Return the gripper, and the handle that is named or the best one, which is printed; or why not."""
    from kineverse.geometry import Scene
    from kineverse.grasping import find_handle

    if scene.gripper is None:
        return scene.why
    try:
        handle = find_handle(scene.model, scene.coordinate, arguments.handle)
    except UnknownNameError as error:
        if arguments.handle is not None:
            raise
        if not Scene(scene.model).bodies_moved_by([scene.coordinate]):
            return str(error)  # nothing to push at either
        return f"{error} Without one it can be pushed: kineverse push ... --to VALUE."
    print(handle, file=sys.stderr)
    return scene.gripper, handle


def skip_skill(
    scene: ManipulationScene,
    world: World,
    done: bool,
    reason: str,
    measures: Mapping[str, Any] = MappingProxyType({}),
) -> Outcome:
    """Return the outcome of what was not begun."""
    from kineverse.manipulation.outcome import Outcome

    value = world.state[scene.coordinate]
    return Outcome(done, value, join_lines(reason), world.name, 0.0, 0, measures)
