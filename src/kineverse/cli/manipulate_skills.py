"""Scenes and skills of ``kineverse open``, ``close`` and ``push``, from the options of the command line."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from time import perf_counter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.geometry import Scene
from kineverse.geometry.exclusions import remove_unusable_shapes
from kineverse.grasping import Gripper, Handle, find_handle
from kineverse.manipulation import JudgedOutcome, PlacedRobot, Robot, Session, judge_outcome, place_robot
from kineverse.manipulation.articulated_objects import find_shut_value
from kineverse.manipulation.outcome import Outcome
from kineverse.manipulation.skill_run import choose_tolerance, explain_fixed
from kineverse.model.kinematics import infer_units
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import Symbol
from kineverse.worlds import RobotInterface, RunMetrics, SimulatedWorld

from .arguments import (
    check_assigned_units,
    check_unit,
    load_model,
    parse_assignments,
    parse_value,
    print_notes,
)
from .output import join_lines, print_line, show_activity
from .outside_robot import check_served, is_live
from .plan_arguments import find_robot_name, parse_robot

if TYPE_CHECKING:
    from kineverse.manipulation import Belief
    from kineverse.worlds.robot_interface import SkillStep

OPENING = 0.4  # distance from shut at which closing and pushing begin [m], [rad]
_NEXT_STEP = (
    "Name a hand with two opposed fingers by --hand FRAME, or move the object with any body of the robot: "
    "kineverse push ... --hand BODY --to VALUE.",
    "Name the body of the robot that is to push by --hand BODY.",
)
"""Advice without a gripper: for grasps, and for pushes."""
_MOST_NOTES = 3


@dataclass(frozen=True)
class ManipulationScene:
    """Robot and furniture before a skill."""

    model: Model  # model of both
    robot: Robot
    coordinate: Symbol  # coordinate of the object
    unit: str  # its unit, rad, m, or nothing
    start: State  # state of everything
    target: float  # wanted value [m], [rad]
    gripper: Gripper | None  # gripper that is used; None if the robot has none
    why: str  # why there is no gripper
    pusher: tuple[str, ...]  # bodies that may push
    stays: bool  # whether the start of the robot was given, so that it is not placed elsewhere
    fixed: str  # why the object cannot move at the start; empty if it can
    tolerance: float  # distance from the target within which the object is there [m], [rad]


def make_scene(
    arguments: argparse.Namespace,
    skill: str,
    look: Callable[[Robot, Symbol], State] | None = None,
) -> ManipulationScene:
    """Load the model, put the robot into it, and return everything before a skill begins.

    A robot outside of this process is looked at, with the coordinate of the object: it says how all begins.
    """
    begin, end = (None if v is None else parse_value(v) for v in (arguments.start, arguments.to))
    source, place = parse_robot(arguments.robot)
    model = load_model(arguments, arguments.model)
    if is_live(arguments.world):
        check_served(arguments.model)
        name = find_robot_name(model, source)
        placed = PlacedRobot(name, Robot.of(model, name).planar_base, {}, name)
    else:
        placed = place_robot(
            model,
            source,
            place,
            base=arguments.base,
            root=arguments.root,
            strict=arguments.strict,
            loops=arguments.loops,
        )
    lost = remove_unusable_shapes(model)
    more = [f"and {len(lost) - _MOST_NOTES} more"] if len(lost) > _MOST_NOTES else []
    print_notes([f"without this shape: {line}" for line in lost[:_MOST_NOTES]] + more)

    robot = Robot.of(model, placed.name)
    coordinate = _find_coordinate(model, arguments.what, robot)
    default = model.default_state()
    values = {str(s): default[s] for s in model.symbols if s in default}
    others = _parse_other_positions(arguments.assignments, model, coordinate, placed.place)
    default = default.updated(others)
    unit = infer_units(model, values, [str(coordinate)]).get(str(coordinate)) or ""
    for option, text in (("--from", arguments.start), ("--to", arguments.to)):
        check_unit(option, text, coordinate, unit)
    shut = find_shut_value(model, coordinate)
    lower, upper = model.limits(coordinate)
    if look is not None:
        _check_standing(robot, placed)
        default = look(robot, coordinate)
        begin = default[coordinate]
    if begin is None:
        begin = default[coordinate] if skill == "open" else _open_from(shut, lower, upper)
    if end is None:
        end = shut if skill != "open" else max(lower, upper, key=lambda limit: abs(limit - shut))
    if not math.isfinite(end):
        raise InvalidValueError(f"'{coordinate}' has no limit at which it is open; say how far: --to VALUE.")
    fixed = explain_fixed(model, coordinate, default.updated({coordinate: begin}))
    if fixed and skill != "push":
        from kineverse.manipulation.opening.contact_phases import find_keys  # for start-up time

        if find_keys(model, robot, coordinate):
            fixed = ""  # a hand may unlatch it
    if not fixed:  # that it is fixed is the result
        _check_limits(model, "--to", coordinate, end)
    if look is not None:
        state = default
    else:
        _check_limits(model, "--from", coordinate, begin)
        state = placed.start_state(model).updated(others).updated({coordinate: begin})
        if skill != "push":  # pushes search a place for the whole push
            state = _find_free_start(model, placed, state)
    gripper, why, pusher = _find_pusher(robot, arguments.hand, skill)
    return ManipulationScene(
        model,
        robot,
        coordinate,
        unit,
        state,
        end,
        gripper,
        why,
        pusher,
        place is not None or look is not None,
        fixed,
        choose_tolerance(model, coordinate, state, end),
    )


def _check_standing(robot: Robot, placed: PlacedRobot) -> None:
    """Check that nobody says where a robot stands that says so itself."""
    if robot.base is not None and placed.place:
        raise InvalidValueError("--robot ROBOT@X,Y,ANGLE: a robot with a base says itself where it stands.")


def _parse_other_positions(
    texts: list[str], model: Model, coordinate: Symbol, standing: Mapping[Symbol, float]
) -> dict[Symbol, float]:
    """Return the values of ``--set``, of anything but the coordinate that is to change."""
    given = {model.symbol(name): value for name, value in parse_assignments(texts).items()}
    check_assigned_units(model, texts, "--set")
    if coordinate in given:
        raise InvalidValueError(f"--set {coordinate}: --from VALUE says where it is at the start.")
    for symbol, value in given.items():
        if symbol in standing:
            raise InvalidValueError(f"--set {symbol}: --robot ROBOT@X,Y,ANGLE says where the robot stands.")
        _check_limits(model, "--set", symbol, value)
    return given


def _check_limits(model: Model, option: str, coordinate: Symbol, value: float) -> None:
    lower, upper = model.limits(coordinate)
    if not lower - 1e-9 <= value <= upper + 1e-9:
        raise InvalidValueError(
            f"{option} {value:.4g}: '{coordinate}' is between {lower:.4g} and {upper:.4g}."
        )


def is_shut(scene: ManipulationScene) -> bool:
    """Return whether the target of a scene is where its object is shut."""
    shut = find_shut_value(scene.model, scene.coordinate)
    return abs(scene.target - shut) <= scene.tolerance


def _open_from(shut: float, lower: float, upper: float) -> float:
    """Return the value at a distance of :data:`OPENING` from shut, or the limit."""
    if upper - shut >= shut - lower:
        return min(shut + OPENING, upper)
    return max(shut - OPENING, lower)


def _find_free_start(model: Model, robot: PlacedRobot, state: State) -> State:
    try:
        free, contact = robot.find_free_start(model, state)
    except InvalidValueError as error:
        raise InvalidValueError(f"{str(error).removesuffix('.')}: --robot ROBOT@X,Y,ANGLE.") from None
    if contact:
        where = ", ".join(f"{free[s]:.2f}" for s in robot.base[:2])
        print_line(f"start: {contact} touch, so the robot begins at {where}")
    return free


def _find_coordinate(model: Model, name: str, robot: Robot) -> Symbol:
    known = {str(s): s for s in model.degrees_of_freedom}
    objects = [other for other, s in known.items() if not robot.moves(s)]
    if name not in known:
        raise UnknownNameError(
            f"--what {name}: the model has no such coordinate that is free to move. "
            f"{suggest(name, objects, 'coordinate')}"
        )
    if name not in objects:
        raise InvalidValueError(
            f"--what {name} is a coordinate of the robot; name one of an object. "
            f"{suggest(name, objects, 'coordinate')}"
        )
    return known[name]


def _find_pusher(robot: Robot, hand: str | None, skill: str) -> tuple[Gripper | None, str, tuple[str, ...]]:
    """Return the gripper, or why there is none, and the bodies that push."""
    if hand is not None and skill == "push":
        robot.model.fk(hand)  # raises for an unknown frame: any body can push
    try:
        gripper = robot.gripper(hand)
    except UnknownNameError as error:
        if hand is None:
            return None, f"{error} {_NEXT_STEP[skill == 'push']}", ()
        if skill == "push" and hand in robot.bodies:
            print_line(f"pusher: {hand}")
            return None, "", (hand,)
        raise
    print_line(f"gripper: {gripper}")
    return gripper, "", gripper.bodies


_PLACEMENT = 60.0  # largest time of the search for a place of the base [s]
_SHORT = 0.1  # share of a wanted opening that may be missing at the stop of a part whose joint is learned
LIVE_STEP = 0.01  # time of a step of the robot of a live system [s]
_BETWEEN_LINES = 1.0  # least time between two lines on the progress of a search [s]


class _SearchLines:
    """Lines on standard error on the progress of a search, at most one in some seconds."""

    def __init__(self) -> None:
        self._last = -math.inf

    def __call__(self, text: str) -> None:
        if (now := perf_counter()) >= self._last + _BETWEEN_LINES:
            self._last = now
            print_line(f"searching: {text}")


class SkillTrial:
    """Trial of a skill in a world: it is measured in the true states, and its outcome is judged by them.

    Without a world, what a robot does is measured by nobody, and done is what the skill claims.
    """

    def __init__(
        self,
        arguments: argparse.Namespace,
        scene: ManipulationScene,
        interface: RobotInterface,
        world: SimulatedWorld | None,
        belief: Belief,
        look: Callable[[SkillStep], None],
    ) -> None:
        self._arguments, self._scene, self._interface, self._world = arguments, scene, interface, world
        self._belief, self._look = belief, look

    def skip(
        self, done: bool, reason: str, measures: Mapping[str, Any] = MappingProxyType({})
    ) -> JudgedOutcome:
        """Return the outcome of what was not begun."""
        value, name = self._scene.start[self._scene.coordinate], self._interface.name
        return JudgedOutcome(done, value, join_lines(reason), name, 0.0, 0, measures, done)

    def grasp(self) -> JudgedOutcome:
        """Open or close the object by its handle."""
        found = self._find_gripper_and_handle()
        if isinstance(found, str):
            return self.skip(False, found)
        gripper, handle = found

        from kineverse.manipulation.opening.grasped_opening import open_object  # for start-up time

        coordinate, target = self._scene.coordinate, self._scene.target
        metrics = self._measure(gripper=gripper, handle=handle.frame)
        outcome = open_object(
            self._open_session_at_handle(metrics, gripper, handle),
            coordinate,
            target=target,
            hand=gripper,
            handle=handle,
            seconds=self._arguments.seconds,
            seed=self._arguments.seed,
        )
        return self._judge(outcome, metrics)

    def _measure(self, **options: Any) -> RunMetrics | None:
        return None if self._world is None else RunMetrics(self._world, self._scene.coordinate, **options)

    @staticmethod
    def _judge(outcome: Outcome, metrics: RunMetrics | None) -> JudgedOutcome:
        if metrics is not None:
            return judge_outcome(outcome, metrics)
        return JudgedOutcome(
            **{one.name: getattr(outcome, one.name) for one in fields(outcome)}, claimed=outcome.done
        )

    def open_as_unknown(self) -> JudgedOutcome:
        """Open the object as if its joint was unknown."""
        found = self._find_gripper_and_handle()
        if isinstance(found, str):
            return self.skip(False, found)
        gripper, handle = found

        from kineverse.manipulation import open_unknown  # for start-up time
        from kineverse.manipulation.unknown_objects import forget_joint  # for start-up time
        from kineverse.manipulation.unknown_objects.unknown_opening import (  # for start-up time
            OPEN_TURN,
            OPEN_WAY,
        )
        from kineverse.worlds import Sensors  # for start-up time

        arguments, model, coordinate = self._arguments, self._scene.model, self._scene.coordinate
        start = self._scene.start
        part = next((a.child for a in model.articulations.values() if coordinate in a.coordinates), None)
        if part is None:
            raise InvalidValueError(f"--unknown: no joint moves '{coordinate}', so no part belongs to it.")
        far = None if arguments.to is None else abs(self._scene.target - start[coordinate])
        metrics = self._measure(
            gripper=gripper,
            handle=handle.frame,
            part=part,
            point=(model.fk(handle.frame, part)(start) @ handle.pose)[:3, 3],
        )
        outcome = open_unknown(
            self._open_session_at_handle(metrics, gripper, handle),
            handle.frame,
            model=forget_joint(model, part, start),
            part=part,
            sensors=None if arguments.noise is None else Sensors.parse(arguments.noise),
            hand=gripper,
            seconds=arguments.seconds,
            seed=arguments.seed,
            way=OPEN_WAY if far is None else far,
            turn=OPEN_TURN if far is None else far,
            in_thread=self._world is None,
        )
        judged = self._judge(outcome, metrics)
        there = abs(judged.value - start[coordinate])
        if judged and far is not None and there < (1.0 - _SHORT) * far:
            reason = f"{judged.reason} That is {there:.3g}, and not {far:.3g}, from where it began."
            return replace(
                judged, done=False, reason=reason, measures={**judged.measures, "failure": "other"}
            )
        return judged

    def push(self) -> JudgedOutcome:
        """Push the object, from where the robot stands or from a place that is searched."""
        from kineverse.manipulation.pushing.base_placement import (  # for start-up time
            find_push_start,
            roll_out,
        )
        from kineverse.manipulation.pushing.push_controller import Pushing  # for start-up time
        from kineverse.manipulation.pushing.push_skill import push  # for start-up time

        arguments, scene, world = self._arguments, self._scene, self._world
        coordinate = scene.coordinate
        if not scene.pusher:
            return self.skip(False, scene.why)
        with show_activity("building the controller"):
            pushing = Pushing(
                scene.model, scene.robot, coordinate, scene.pusher, scene.start, target=scene.target
            )
        placed, nowhere = 0, None
        if world is not None and not scene.stays:
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

        metrics = self._measure()
        session = self._open_session(metrics)
        outcome = push(session, coordinate, seconds=arguments.seconds, pushing=pushing)
        judged = self._judge(outcome, metrics)
        measures = {**judged.measures, "placed": placed}
        if judged or nowhere is None:
            return replace(judged, measures=measures)
        reason = f"{judged.reason} Another place of the robot: {nowhere.why}"
        return replace(judged, reason=reason, measures={**measures, "failure": nowhere.failure})

    def _open_session(self, metrics: RunMetrics | None) -> Session:
        def look(session: Session) -> None:
            if metrics is not None:
                metrics(session)
            self._look(session)

        step = {"dt": LIVE_STEP} if is_live(self._arguments.world) else {}
        return Session(self._interface, belief=self._belief, on_step=look, on_search=_SearchLines(), **step)

    def _open_session_at_handle(
        self, metrics: RunMetrics | None, gripper: Gripper, handle: Handle
    ) -> Session:
        """Return a session of a robot that has been put to the handle if its base does not drive there."""
        from kineverse.manipulation import stand_at_handle  # for start-up time

        session, world = self._open_session(metrics), self._world
        if world is None or metrics is None:
            return session
        target, base = self._scene.target, self._scene.robot.base
        put = stand_at_handle(session, world, handle, target, gripper=gripper, seed=self._arguments.seed)
        if put and base is not None:
            metrics.reset()
            where = ", ".join(f"{world.state[s]:.2f}" for s in base.coordinates[:2])
            print_line(f"start: the base does not drive to the handle by itself; it is put to {where}")
        return session

    def _find_gripper_and_handle(self) -> tuple[Gripper, Handle] | str:
        """Return the gripper, and the handle that is named or the best one, which is printed; or why not."""
        scene, named = self._scene, self._arguments.handle
        if scene.gripper is None:
            return scene.why
        try:
            handle = find_handle(scene.model, scene.coordinate, named)
        except UnknownNameError as error:
            if named is not None:
                raise
            if not Scene.of(scene.model).bodies_moved_by([scene.coordinate]):
                return str(error)  # nothing to push at either
            return f"{error} Without one it can be pushed: kineverse push ... --to VALUE."
        print(handle, file=sys.stderr)
        return scene.gripper, handle
