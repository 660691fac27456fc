"""Opening of a part with an unknown joint: the hand pulls at its handle, and the joint is learned."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from kineverse._checks import as_count, as_positive, check_flag
from kineverse.control import Command
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.estimation import Fit
from kineverse.grasping import Grasp, Gripper, sample_grasps
from kineverse.grasping.finger_branches import path_to_root
from kineverse.grasping.graspable_features import find_parts
from kineverse.lie import Array, adjoint, exp_se3, inverse
from kineverse.manipulation.belief import TrackedBelief
from kineverse.manipulation.opening import BasePlacement, PlacementSearch
from kineverse.manipulation.opening.approach_planner import Approach, Opener
from kineverse.manipulation.opening.hand_motion import PULLED_OUT, HandMotion
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_run import SkillRun
from kineverse.manipulation.swept_volume import BlockedError
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.worlds import Robot, Sensors
from kineverse.worlds.run_metrics import measure_way

from .joint_learning import JointLearning, axis_deviation, revise_joint, watch_joint
from .part_belief import PartBelief
from .pulling_policy import LearnedPull, StraightPull, learn_model, point_speed
from .unmodelled_joint import JointPath, UnknownPart, find_joint, free_part

OPEN_WAY, OPEN_TURN = 0.25, math.radians(60.0)  # opening that is wanted by default [m], [rad]
_MOST_LOOKING = 3.0  # largest time until a part is seen [s]
_REACH = 0.25  # straight distance of the handle that a placement should allow [m]
_GRASPS = 128
_SEARCHES, _ENOUGH = 3, 0.99  # searches of a first place, share of possible motions that is enough
_MOST_PLACES = 3  # largest number of places of the robot, or of its hand
_FURTHER = 1.1  # share of the rest of an opening that a further placement should lead along the learned joint
_LEAST_RADIUS = 0.15  # distance of a bar from an edge of its part from which on a hinge may be there [m]
_STEP = 0.05  # distance of the handle between two poses of an arm [m]
_CLOSED_WAY, _CLOSED_TURN = 0.03, math.radians(6.0)  # motion back after which a part is not open [m], [rad]
_LEAST_OPENING = 0.08, math.radians(10.0)  # from which a part at its own stop is open [m], [rad]
_LOOKING, _HELD_LOOKING = 0.6, 1.0  # times of looks at a part that stands, and with the hand closed [s]
_MOST_GRASPS = 3
_DIRECTIONS = (
    (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0),
)  # fmt: skip
"""Directions in which a part is pulled one after the other until it follows, in the axes of its handle: along
its outward normal, to both sides across the bar, and to both ends along it."""
_REFIT = 0.5  # time between two controllers for a learned joint [s]
_BETTER = 0.5  # share of the deviation of a joint that a better one has at most
_FOLLOWS, _STALLED, _PATIENCE = 0.01, 0.004, 1.5
"""Motion of a part that follows the hand, and its least progress [m] in a time [s]."""
_LED = 0.06  # distance of the handle before which the hand does not rely on a joint that was learned [m]
_ENDING = 0.5  # time without progress where the arm is expected to end [s]
_AHEAD, _AHEAD_STEPS = 0.03, 4  # distance that an arm must be able to go on [m], and number of poses


def open_unknown(
    session: Session,
    handle: str,
    *,
    model: Model,
    part: str | None = None,
    beside: str | None = None,
    sensors: Sensors | None = None,
    way: float = OPEN_WAY,
    turn: float = OPEN_TURN,
    hand: Gripper | str | None = None,
    seconds: float = 60.0,
    placements: int = 1000,
    seed: int = 0,
    in_thread: bool = False,
) -> Outcome:
    """Open a part whose joint is unknown or wrong, and write the learned joint into a model.

    The robot sees markers on the part and on what it moves in. It grasps the handle, pulls straight along its
    outward normal and yields to all other motion, while the joint is identified. As soon as its family is
    certain, it is a joint of a model that a controller holds the hand to, and it is fitted again on the way.
    A handle that slips out of the hand is grasped again.

    If the model has a joint for the part already, that is tested meanwhile. It stays if it explains what was
    seen. Else the learned joint replaces it.

    Parameters
    ----------
    session
        The robot. Its belief is another one meanwhile, of the poses of markers alone.
    handle
        Frame of the handle's body in the model.
    model
        What is known: the robot, what is around, and the bodies of the part, however they are attached. It is
        edited at the end, if the joint was learned and the model had another one or none.
    part
        Frame of the part; by default that of the joint above the handle, or the handle's if there is none.
    beside
        Frame with a marker in which the part moves; by default the nearest frame above the part that is seen
        and stands still, or the world as the robot's odometry has it.
    sensors
        Stated noise of the observations; by default that of the session's belief if it is a
        :class:`.TrackedBelief`, else the noise is estimated.
    way, turn
        Wanted opening: distance of the handle of a part that slides [m], angle of one that turns [rad].
    hand
        Frame of the hand, or the gripper; found by default.
    seconds
        Largest time by the robot's clock [s].
    placements
        Largest number of sampled bases.
    seed
        Seed of all searches.
    in_thread
        Whether joints are fitted in a thread of their own, and a new controller is made for much better ones
        alone: for a robot whose time runs on meanwhile.

    Returns
    -------
    Outcome
        Its value is the believed opening [m], [rad]. ``measures``: ``way`` [m] and ``turn`` [rad] of the
        opening; ``family``, with ``decided_way`` [m], ``decided_turn`` [rad] and ``decided_seconds`` of the
        pull after which it was certain; ``axis`` and ``point`` in ``parent``; ``pull_seconds`` from the first
        grasp on, and ``opened_seconds`` until the part moved no further; ``grasps``; ``believed``, the
        verdict on the joint of the model; and ``failure`` if it was not done.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For frames that do not exist, a robot without a gripper, a handle that is none, or a wanted opening
        that is not positive.

    See Also
    --------
    kineverse.manipulation.unknown_objects.forget_joint
    """
    check_flag("in_thread", in_thread)
    for name, value in (("way", way), ("turn", turn), ("seconds", seconds)):
        as_positive(value, f"{name}=")
    for name in (handle, *(n for n in (part, beside) if n is not None)):
        if name not in model.frames:
            raise UnknownNameError(f"There is no frame '{name}'. {suggest(name, model.frames, 'frame')}")
    robot = Robot.of(model, session.robot)
    for given, what in ((handle, "a handle"), (beside, "what a part moves in")):
        if given is not None and robot.owns(given):
            others = [f for f in model.frames if not robot.owns(f)]
            raise InvalidValueError(
                f"'{given}' is a frame of the robot '{robot.name}', not {what}. "
                f"{suggest(given, others, 'frame')}"
            )
    gripper = hand if isinstance(hand, Gripper) else robot.gripper(hand)
    _, *above = path_to_root(model, handle)
    part = part or next((f for f in (handle, *above) if find_joint(model, f)), handle)
    if part not in (handle, *above):
        raise InvalidValueError(
            f"The handle '{handle}' is not below the part '{part}', but {', '.join(above)}."
        )
    if sensors is None:
        sensors = session.belief.sensors if isinstance(session.belief, TrackedBelief) else None
    with suppress(SkillError):  # which the run says
        session.refresh()  # a robot's time runs on between two skills
    before = model.default_state()
    before = before.updated({s: v for s, v in session.state.items() if s in before})
    unknown = free_part(model, part, handle, before)
    rigid = [f for f in model.frames if part in path_to_root(model, f)]
    markers = [f for f in rigid if not unknown.model.fk(f, part).symbols]
    still = [f for f in path_to_root(model, part)[1:] if not model.fk(f).symbols]
    belief = PartBelief(
        unknown, robot, before, gripper.hand, markers, still if beside is None else [beside], sensors
    )
    run = UnknownOpeningRun(
        session, model, gripper, belief, (way, turn), seconds,
        as_count("placements", placements, 1), as_count("seed", seed, 0),
        in_thread,
    )  # fmt: skip
    return run.finish_learning(run.perform(run.open))


class ArmEndError(SkillError):
    """End of the arm's reach, or an obstacle, before the part is open."""


class UnknownOpeningRun(SkillRun):
    """Run of an opening of a part with an unknown joint."""

    model: Model

    def __init__(
        self,
        session: Session,
        model: Model,
        gripper: Gripper,
        belief: PartBelief,
        wanted: tuple[float, float],
        seconds: float,
        samples: int,
        seed: int,
        in_thread: bool = False,
    ) -> None:
        super().__init__(session, None, seconds)
        self.model, self.gripper, self.belief, self.unknown = model, gripper, belief, belief.unknown
        self.point, self.frame_T_handle = belief.unknown.point, belief.unknown.frame_T_handle
        self.wanted, self.samples, self.seed = wanted, samples, seed
        self.learning = JointLearning()
        self._in_thread = in_thread
        self._update = self.learning.update_beside if in_thread else self.learning.update
        self.opener: Opener
        self.motion: HandMotion
        self.start: Array | None = None  # pose (4, 4) of the part when it was grasped first
        self._first_pull = self._reached = self.begin  # times of the first pull, and of the last progress [s]
        self._direction, *self._others = _DIRECTIONS
        self.measures["grasps"] = 0

    @property
    def value(self) -> float:
        """Believed opening: the angle [rad] of a part that turns, else the distance of the handle [m]."""
        way, turn = self.opening
        learned = self.learning.learned
        turns = turn > 0.5 * _LEAST_OPENING[1] if learned is None else bool(learned.fit.motion.kinds[0])
        return turn if turns else way

    @property
    def opening(self) -> tuple[float, float]:
        """Believed distance of the handle [m] and angle of the part [rad] since the first grasp."""
        if self.start is None:
            return 0.0, 0.0
        return measure_way(self.start, self.belief.relative_pose, self.point)

    def finish_learning(self, outcome: Outcome) -> Outcome:
        """Write what was learned into the model, also if the part is not open, and add it to the outcome."""
        way, turn = self.opening
        pulled = self.session.time - self._first_pull
        measures = {**outcome.measures, "pull_seconds": pulled, "way": way, "turn": turn}
        if (learned := self.learning.learned) is None:
            return replace(outcome, measures=measures)
        verdict, words = revise_joint(self.model, self.belief, learned)
        measures |= {
            "family": learned.fit.family,
            "decided_way": learned.distance,
            "decided_turn": learned.turn,
            "decided_seconds": learned.time,
            "parent": self.belief.beside,
            "believed": verdict,
        }
        parameters = learned.fit.parameters
        measures |= {key: parameters[key] for key in ("axis", "point") if key in parameters}
        return replace(outcome, reason=f"{outcome.reason} {words}", measures=measures)

    # -- phases --------------------------------------------------------------------------------------------

    def open(self) -> str:
        """Open the part, and return how far, or raise SkillError."""
        with self.session.believing(self.belief):
            self._look()
            self._prepare(self.unknown)
            if self.motion.is_at_handle:
                self._retract()
            if self.belief.monitor is None:
                self.belief.monitor = watch_joint(self.model, self.belief)
            failure: SkillError | None = None
            for _ in range(_MOST_PLACES):
                try:
                    placement = self._place_first() if failure is None else self._place_further()
                except SkillError as error:
                    raise SkillError(failure.kind, f"{failure} {error}") if failure else error from error
                try:
                    return self._pull(placement)
                except ArmEndError as error:
                    failure = error
            assert failure is not None
            raise failure

    def _prepare(self, unknown: UnknownPart) -> None:
        session = self.session
        with session.search():
            robot = Robot.of(unknown.model, self.robot)
            self.opener = Opener(robot, self.gripper, session.state)
        self.motion = HandMotion(self, self.opener, unknown.handle, self.seed)
        self.unknown = unknown

    def _place_first(self) -> BasePlacement:
        """Return a placement for a straight pull, from which the arm follows possible hinges, too."""
        session, unknown = self.session, self.unknown
        twists = guess_hinges(unknown, self.opener.search, session.state)
        found: list[tuple[float, BasePlacement]] = []

        def accept(placement: BasePlacement) -> bool:
            share = least_share(
                unknown, self.opener.search, placement, session.state, twists, _REACH, self.wanted[1]
            )
            found.append((share, placement))
            return share > _ENOUGH and self.motion.plan(placement)

        failure: SkillError | None = None
        for k in range(_SEARCHES if twists else 1):
            result = self._search(_REACH, accept, self.seed + k)
            if result:
                return result
            failure = failure or self.motion.explain(result)
            if not found:
                raise failure
        for _, placement in sorted(found, key=lambda pair: -pair[0]):
            if self.motion.plan(placement):
                return placement
        assert failure is not None
        raise failure

    def _place_further(self) -> BasePlacement:
        learned = self.learning.learned
        assert learned is not None
        assert self.start is not None
        path = JointPath.of_fit(learned.fit, self.start)
        path.project(self.belief.relative_pose)
        self._prepare(self.unknown.pulled_along(path.twist()))
        kind = learned.fit.motion.kinds[0]
        scale = point_speed(path.twist(), self.point)
        rest = self.wanted[kind] - self.opening[kind]
        result = self._search(_FURTHER * scale * rest, self.motion.plan, self.seed)
        if not result:
            raise self.motion.explain(result)
        return result

    def _pull(self, placement: BasePlacement) -> str:
        """Take the handle, pull, let go, and return how far the part is open."""
        grasp = placement.grasp
        assert grasp is not None
        if self.motion.drive():
            self._look()
        self.motion.approach(placement)
        try:
            reason = self._pull_open(grasp)
        except KineverseError:
            with suppress(SkillError):  # the first one says more
                self._let_go(grasp)
            raise
        way, turn = self.opening
        self._let_go(grasp)
        after = self.opening
        if after[0] < way - _CLOSED_WAY or after[1] < turn - _CLOSED_TURN:
            words = f"by {100 * after[0]:.0f} cm and {math.degrees(after[1]):.0f}°"
            raise SkillError("other", f"{reason} It did not stay there: it is open {words}.")
        return reason

    def _let_go(self, grasp: Grasp) -> None:
        """Let go of the part, if there is time and anything is read."""
        session = self.session
        self.belief.release()
        if self.left >= 0.0 and not session.fault:
            self._retract(grasp)

    def _retract(self, grasp: Grasp | None = None) -> None:
        """Open the fingers, take the hand back, and look at the part.

        Where the part is after an unknown motion, the retreat of the placement has not been checked.
        """
        self.motion.let_go(grasp)
        self.stand(_LOOKING)

    def _look(self) -> None:
        """Stand until the part is seen, or raise SkillError if it is not."""
        self.session.phase = "look"
        begin = self.session.time
        self.stand(_LOOKING)
        while not self.belief.is_seen:
            if self.session.time - begin > _MOST_LOOKING:
                raise SkillError(
                    "other",
                    f"No marker of '{self.unknown.frame}' was seen within {_MOST_LOOKING:g} s; it may be "
                    "hidden.",
                )
            self.act({})

    def _search(self, distance: float, accept: Callable[[BasePlacement], bool], seed: int) -> BasePlacement:
        """Search a placement from which the handle can be pulled by a distance [m], or as far as possible."""
        session, self.motion.planned = self.session, Approach()
        session.phase = "place"
        with session.search(f"places of the robot from which '{self.unknown.frame}' can be pulled"):
            model, handle = self.unknown.model, self.unknown.handle
            grasps = sample_grasps(model, self.gripper, handle, _GRASPS, seed, state=session.state)
            return self.opener.search.find(
                session.state, grasps, distance, accept=accept, samples=self.samples, seed=seed,
                stays=bool(self.opener.approaches.explain_standing(session.state)),
            )  # fmt: skip

    # -- pulls ---------------------------------------------------------------------------------------------

    def _pull_open(self, grasp: Grasp) -> str:
        """Pull until the part is open or at its own stop, and return how far that is.

        A handle that slips is grasped again.
        """
        distance = self.opening[0] if self.learning.poses else -math.inf
        for _ in range(_MOST_GRASPS):
            self.measures["grasps"] += 1
            barrier = ""
            if not self.motion.close(grasp):
                why = "The fingers closed next to the handle."
            else:
                if not self.learning.poses:
                    self._first_pull = self.session.time
                why, barrier = self._pull_once()
            if not why:
                return self._describe_opening("is open")
            self._open_fingers()
            last, distance = distance, self.opening[0]
            if barrier and distance >= _FOLLOWS:
                kind = ArmEndError if self.learning.learned is not None else SkillError
                raise kind(barrier, f"{self._describe_opening('was pulled')} {why}")
            if distance - last < _FOLLOWS:
                break
            self.measures["opened_seconds"] = self._reached - self._first_pull
            pose = inverse(self.belief.pose @ self.frame_T_handle) @ self.belief.hand_pose
            self.motion.follow_line(pose, grasp.pose)
        opened, _ = self.opening
        if opened < _FOLLOWS:
            raise SkillError(
                "other",
                f"'{self.unknown.frame}' does not follow the hand, pulled outwards, to both sides, and to "
                f"both ends of its handle: it moved by {1e3 * opened:.0f} mm. {why} It may be fixed, locked, "
                "or need more force than the grip holds.",
            )
        words = f"{self._describe_opening('goes no further')} {why}"
        if opened >= _LEAST_OPENING[0] or self.opening[1] >= _LEAST_OPENING[1]:
            self.measures["opened_seconds"] = self._reached - self._first_pull
            return f"{words} The arm could go on, so this is its stop."
        raise SkillError("other", words)

    def _open_fingers(self) -> None:
        self.session.phase = "let go"
        self.belief.release()
        self.motion.move_fingers(self.gripper.opened)
        self.stand(_LOOKING)

    def _pull_once(self) -> tuple[str, str]:
        """Pull until the part is open.

        Return why it is not, empty if it is, and the kind of failure if the part could go on.
        """
        session, belief, motion, learning = self.session, self.belief, self.motion, self.learning
        session.phase = "pull"
        belief.hold()
        self.stand(_HELD_LOOKING)
        part_T_hand = inverse(belief.pose) @ belief.hand_pose
        bar_T_hand = inverse(self.frame_T_handle) @ part_T_hand
        if self.start is None or not learning.poses:
            self.start = belief.relative_pose
        belief.begin_motion()
        pull: StraightPull | LearnedPull = StraightPull(motion, belief, bar_T_hand, self._direction)
        held: Fit | None = None
        fitted, best = -math.inf, self.opening[0]
        idle = 0.0  # time without progress, but for that in which the robot waits [s]
        while True:
            for look in belief.looks:
                learning.add(*look)
            belief.looks.clear()
            distance, turn = self.opening
            now = self.session.time
            with session.timed("learn"):
                self._update(distance, turn, now - self._first_pull)
                learned = learning.learned
                due = learned is not None and now - fitted >= _REFIT and distance >= _LED
                if learned is not None and due and self._is_worth(learned.fit, held):
                    held, fit, fitted = learned.fit, learned.fit, now
                    pull = LearnedPull(
                        motion, belief, learn_model(self.model, belief, fit), bar_T_hand, self.start,
                        self.wanted[fit.motion.kinds[0]],
                    )  # fmt: skip
                elif learning.likely is not None and isinstance(pull, StraightPull):
                    pull.likely = JointPath.of_fit(learning.likely, self.start)
            if isinstance(pull, LearnedPull) and pull.obstacle is not None and pull.is_blocked:
                self._open_fingers()
                raise BlockedError(pull.obstacle)
            with session.timed("open"):
                command = pull.step(distance)
            self.act(command.speeds, command)
            distance, turn = self.opening
            if self._is_open(distance, turn):
                self.measures["opened_seconds"] = now - self._first_pull
                return "", ""
            if belief.slip(part_T_hand, self.point) > PULLED_OUT:
                session.stop()
                ends = isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)
                why = "The handle slipped in the hand"
                return (f"{why} where the arm ends.", "reach") if ends else (f"{why}.", "")
            idle += session.dt
            if distance > best + _STALLED:
                best, idle = distance, 0.0
                self._reached = now
            elif idle > (_ENDING if isinstance(pull, LearnedPull) and pull.ends else _PATIENCE):
                if isinstance(pull, StraightPull) and distance < _FOLLOWS and self._others:
                    # It may slide to a side.
                    self._direction, idle = self._others.pop(0), 0.0
                    pull = StraightPull(motion, belief, bar_T_hand, self._direction)
                    continue
                return self._explain_stall(pull, command, part_T_hand)

    def _is_worth(self, fit: Fit, held: Fit | None) -> bool:
        """Return whether a joint is worth a new controller: where time runs on, only if it is much better."""
        return not self._in_thread or held is None or axis_deviation(fit) < _BETTER * axis_deviation(held)

    def _explain_stall(
        self, pull: StraightPull | LearnedPull, command: Command, part_T_hand: Array
    ) -> tuple[str, str]:
        """Return what is in the way, and its kind if that is not the part itself."""
        words = f"In the way: {', '.join(command.active[:3]) or 'nothing that the controller knows'}."
        if any(name.startswith("contact of") for name in command.active[:3]):
            return words, "collision"
        limits = [c for name, c in self.model.constraints.items() if name in command.active and not c.order]
        limited = any(map(self.robot.moves, [s for c in limits for s in c.expression.symbols]))
        if limited or (isinstance(pull, LearnedPull) and not self._can_go_on(pull, part_T_hand)):
            return f"The arm ends there. {words}", "reach"
        return words, ""

    def _can_go_on(self, pull: LearnedPull, part_T_hand: Array) -> bool:
        """Return whether the arm reaches the next poses of the handle along a learned joint."""
        path, search, state = pull.path, self.motion.search, self.session.state
        step = path.direction * _AHEAD / point_speed(path.twist(), self.point) / _AHEAD_STEPS
        values = path.value + step * np.arange(_AHEAD_STEPS + 1)
        hands = [self.belief.reference_pose @ path.pose(v) @ part_T_hand for v in values.tolist()]
        arm, base = state.vector(search.moving)[None], state.vector(search.standing)[None]
        _, reached = search.paths.follow(arm, base, np.array(hands)[None])
        return int(reached[0]) == len(hands)

    def _is_open(self, distance: float, turn: float) -> bool:
        learned = self.learning.learned
        if learned is not None and learned.fit.motion.kinds[0]:
            return turn >= self.wanted[1]
        return distance >= self.wanted[0] or turn >= self.wanted[1]

    def _describe_opening(self, verb: str) -> str:
        distance, turn = self.opening
        return f"'{self.unknown.frame}' {verb}, by {100 * distance:.0f} cm and {math.degrees(turn):.0f}°."


def guess_hinges(unknown: UnknownPart, search: PlacementSearch, state: State) -> list[Array]:
    """Return the twists (6,) of hinges along the bar at the far edges of a part, in its axes.

    A door has its handle far from its hinge, and along it. A bar in the middle of a narrow front, as of a
    drawer, has none.
    """
    model, handle = unknown.model, unknown.handle
    search.scene.update(state)
    world_T_bar = model.fk(handle.frame)(state) @ handle.pose
    rigid = {b for b in search.others if not model.fk(b, unknown.frame).symbols}
    parts = [part for part in find_parts(search.scene) if part.body in rigid]
    x, y = world_T_bar[:3, 0], world_T_bar[:3, 1]
    extents = np.array([part.extent(np.array([-x, y, -y])) for part in parts]).max(axis=0)
    back, left, right = extents - np.array([-x, y, -y]) @ world_T_bar[:3, 3]
    twists = []
    for side, radius in ((1.0, left), (-1.0, right)):
        if radius > _LEAST_RADIUS:
            axis = np.array([0.0, 0.0, side])
            pivot = np.array([-back, side * radius, 0.0])
            twist = np.concatenate([-np.cross(axis, pivot), axis])
            twists.append(adjoint(unknown.frame_T_handle @ handle.pose) @ twist)
    return twists


def least_share(
    unknown: UnknownPart,
    search: PlacementSearch,
    placement: BasePlacement,
    state: State,
    twists: list[Array],
    distance: float,
    turn: float,
) -> float:
    """Return the least share of possible motions along which the arm of a placement holds the handle."""
    assert placement.grasp is not None
    world_T_part = np.asarray(unknown.model.fk(unknown.frame)(state))
    part_T_hand = unknown.frame_T_handle @ placement.grasp.pose
    count = len(search.moving)
    arm, base = placement.path[:1, :count], placement.path[:1, count:]
    shares = [(placement.values[-1] - placement.values[0]) / distance]
    for twist in twists:
        radius = float(np.linalg.norm(twist[:3] + np.cross(twist[3:], unknown.point)))
        angles = np.linspace(0.0, turn, max(2, round(radius * turn / _STEP) + 1))
        hands = np.array([world_T_part @ exp_se3(q * twist) @ part_T_hand for q in angles])
        _, reached = search.paths.follow(arm, base, hands[None])
        shares.append(max(0.0, float(reached[0]) - 1.0) / (len(angles) - 1))
    return float(min(shares))
