"""Opening of a part with an unknown joint: the hand pulls at its handle, and the joint is learned."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from kineverse.compilation import compile
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError, UnknownNameError, suggest
from kineverse.grasping import Grasp, find_gripper, sample_grasps
from kineverse.grasping.finger_branches import path_to_root
from kineverse.lie import Array, inverse
from kineverse.manipulation.opening import BasePlacement
from kineverse.manipulation.opening.approach_planner import Approach, Opener
from kineverse.manipulation.opening.hand_motion import HandMotion, find_retreat
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_arguments import check_positive
from kineverse.model.frame import is_of_robot
from kineverse.model.model import Model
from kineverse.worlds import Judge, Sensors

from .joint_hypotheses import guess_hinges, least_share, revise_joint, watch_joint
from .joint_learning import JointLearning, LearnedJoint
from .part_belief import PartBelief, measure_way
from .pull_controllers import point_speed
from .pulling_policy import LEAST_OPENING, LOOKING, ArmEndError, PartPulling
from .unmodelled_joint import JointPath, UnknownPart, find_joint, free_part

OPEN_WAY, OPEN_TURN = 0.25, math.radians(60.0)  # opening that is wanted by default [m], [rad]
_MOST_LOOKING = 3.0  # largest time until a part is seen [s]
_REACH = 0.25  # straight distance of the handle that a placement should allow [m]
_GRASPS = 128
_SEARCHES, _ENOUGH = 3, 0.99  # searches of a first place, share of possible motions that is enough
_MOST_PLACES = 3  # largest number of places of the robot, or of its hand
_FURTHER = 1.1  # share of the rest of an opening that a further placement should lead along the learned joint
_CLOSED_WAY, _CLOSED_TURN = 0.03, math.radians(6.0)  # motion back after which a part is not open [m], [rad]


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
    hand: str | None = None,
    seconds: float = 60.0,
    placements: int = 1000,
    seed: int = 0,
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
        Robot in a world; of the world only observations are used. Its belief is another one meanwhile.
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
        Stated noise of the observations; exact by default.
    way, turn
        Wanted opening: distance of the handle of a part that slides [m], angle of one that turns [rad].
    hand
        Frame of the hand, found by default.
    seconds
        Largest time in the world [s].
    placements
        Largest number of sampled bases.
    seed
        Seed of all searches.

    Returns
    -------
    Outcome
        Its value is the true opening [m], [rad]. ``measures``: those of :class:`.Judge`; true ``way`` [m] and
        ``turn`` [rad]; ``family``, with ``decided_way`` [m], ``decided_turn`` [rad] and ``decided_seconds``
        of the pull after which it was certain; ``axis`` and ``point`` in ``parent``; ``pull_seconds`` from
        the first grasp on, and ``opened_seconds`` until the part moved no further; ``grasps``; ``believed``,
        the verdict on the joint of the model; and ``failure`` if it was not done.

    Raises
    ------
    UnknownNameError, InvalidValueError
        For frames that do not exist, a robot without a gripper, a handle that is none, or a wanted opening
        that is not positive.
    """
    for name, value in (("way", way), ("turn", turn), ("seconds", seconds)):
        check_positive(name, value)
    for name in (handle, *(n for n in (part, beside) if n is not None)):
        if name not in model.frames:
            raise UnknownNameError(f"There is no frame '{name}'. {suggest(name, model.frames, 'frame')}")
    robot = session.world.robot
    for given, what in ((handle, "a handle"), (beside, "what a part moves in")):
        if given is not None and is_of_robot(given, robot):
            others = [f for f in model.frames if not is_of_robot(f, robot)]
            raise InvalidValueError(
                f"'{given}' is a frame of the robot '{robot}', not {what}. {suggest(given, others, 'frame')}"
            )
    wanted = way, turn
    return _Run(session, model, handle, part, beside, sensors, wanted, hand, seconds, placements, seed)()


class _Run:
    """One opening: its phases, and its results."""

    def __init__(
        self,
        session: Session,
        model: Model,
        handle: str,
        part: str | None,
        beside: str | None,
        sensors: Sensors | None,
        wanted: tuple[float, float],
        hand: str | None,
        seconds: float,
        placements: int,
        seed: int,
    ) -> None:
        self.session, self.model, self.world = session, model, session.world
        self.wanted, self.seconds, self.samples, self.seed = wanted, seconds, placements, seed
        self.gripper = find_gripper(model, self.world.robot, hand)
        _, *above = path_to_root(model, handle)
        self.part = part or next((f for f in (handle, *above) if find_joint(model, f)), handle)
        if self.part not in (handle, *above):
            raise InvalidValueError(
                f"The handle '{handle}' is not below the part '{self.part}', but {', '.join(above)}."
            )
        before = model.default_state()
        before = before.updated({s: v for s, v in session.state.items() if s in before})
        self.unknown = unknown = free_part(model, self.part, handle, before)
        rigid = [f for f in model.frames if self.part in path_to_root(model, f)]
        markers = [f for f in rigid if not unknown.model.fk(f, self.part).symbols]
        still = [f for f in path_to_root(model, self.part)[1:] if not model.fk(f).symbols]
        references = still if beside is None else [beside]
        stated = sensors or Sensors()
        self.belief = PartBelief(unknown, self.world, before, self.gripper.hand, markers, references, stated)
        self.learning = JointLearning()
        self.measures: dict[str, Any] = {"grasps": 0}
        self.first_step, self.begin = session.steps, self.world.time
        names = [f for f in markers if f in self.world.model.frames]
        joint = find_joint(self.world.model, self.part) if self.part in self.world.model.frames else None
        self._moved = joint.coordinates[0] if joint is not None and joint.coordinates else None
        self._truth = compile(self.world.model.fk((names or [handle])[0]))

    def __call__(self) -> Outcome:
        session, world = self.session, self.world
        believed = session.belief
        session.belief = self.belief
        session.state = self.belief.update(world)
        first = self._true_pose()
        kind = ""
        try:
            reason = self._open()
        except SkillError as failure:
            reason, kind = str(failure), failure.kind
        except (InfeasibleError, NotFiniteError) as error:
            reason, kind = f"The controller has no command: {error}", "other"
        finally:
            session.belief = believed
        session.stop()
        way, turn = measure_way(first, self._true_pose(), self.unknown.point)
        self.measures |= {"way": way, "turn": turn}
        learned = self.learning.learned
        turns = bool(learned.fit.motion.kinds[0]) if learned is not None else turn > 0.5 * LEAST_OPENING[1]
        if not kind and (way < self.claimed[0] - _CLOSED_WAY or turn < self.claimed[1] - _CLOSED_TURN):
            kind = "other"
            reason += f" It is not open in truth: by {100 * way:.0f} cm and {math.degrees(turn):.0f}°."
        if learned is not None:
            reason = f"{reason} {self._report_joint(learned)}"
        claimed = not kind
        if (overlap := self.judge.overlap) is not None:
            kind, reason = kind or "collision", f"{reason} {overlap}"
        if kind:
            self.measures["failure"] = kind
        return Outcome(
            not kind, turn if turns else way, reason, world.name, world.time - self.begin,
            session.steps - self.first_step, {**self.judge.measures, **self.measures}, claimed,
        )  # fmt: skip

    def _true_pose(self) -> Array:
        pose: Array = self._truth(self.world.state.vector(self._truth.inputs))
        return pose

    # -- phases --------------------------------------------------------------------------------------------

    def _open(self) -> str:
        """Open the part, and return how far, or raise SkillError."""
        session, unknown = self.session, self.unknown
        robot = self.world.robot
        self.judge = Judge(
            self.world.model, robot, self.gripper, unknown.handle.frame, coordinate=self._moved
        )
        self.judge.update(self.world.state)
        self._prepare(unknown)
        self._look()
        if self.belief.monitor is None:
            self.belief.monitor = watch_joint(self.model, self.belief)
        self.pulling = PartPulling(session, self.belief, self.learning, self.model, self.wanted)
        failure: SkillError | None = None
        try:
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
        finally:
            self.measures |= self.pulling.measures

    def _prepare(self, unknown: UnknownPart) -> None:
        session = self.session
        with session.timed("place"):
            self.opener = Opener(unknown.model, self.gripper, session.state)
        until = self.begin + self.seconds
        self.motion = HandMotion(session, self.opener, unknown.handle, self.judge, until)
        self.unknown = unknown

    def _place_first(self) -> BasePlacement:
        """Return a placement for a straight pull, from which the arm follows possible hinges, too."""
        session, unknown = self.session, self.unknown
        with session.timed("place"):
            twists = guess_hinges(unknown, self.opener.search, session.state)
        found: list[tuple[float, BasePlacement]] = []

        def accept(placement: BasePlacement) -> bool:
            share = least_share(
                unknown, self.opener.search, placement, session.state, twists, _REACH, self.wanted[1]
            )
            found.append((share, placement))
            return share > _ENOUGH and self._plan(placement)

        why = ""
        for k in range(_SEARCHES if twists else 1):
            result = self._search(_REACH, accept, self.seed + k)
            if result:
                return result
            why = why or result.why
            if not found:
                raise SkillError(result.failure, why)
        for _, placement in sorted(found, key=lambda pair: -pair[0]):
            if self._plan(placement):
                return placement
        raise SkillError("collision", f"{why}{self.approach.barrier}")

    def _place_further(self) -> BasePlacement:
        learned = self.learning.learned
        assert learned is not None
        path = JointPath.of_fit(learned.fit, self.pulling.start)
        path.project(self.belief.relative_pose)
        self._prepare(self.unknown.pulled_along(path.twist()))
        kind = learned.fit.motion.kinds[0]
        scale = point_speed(path.twist(), self.unknown.point)
        rest = self.wanted[kind] - self.pulling.opening[kind]
        result = self._search(_FURTHER * scale * rest, self._plan, self.seed)
        if not result:
            raise SkillError(result.failure, f"{result.why}{self.approach.barrier}")
        return result

    def _pull(self, placement: BasePlacement) -> str:
        """Take the handle, pull, let go, and return how far the part is open."""
        grasp, motion = placement.grasp, self.motion
        assert grasp is not None
        self._come(placement)
        try:
            reason = self.pulling.perform(motion, grasp)
            self.claimed = self.pulling.opening
        finally:
            self.belief.release()
            if self.world.time <= motion.until:
                self._retract(grasp)
        return reason

    def _retract(self, grasp: Grasp) -> None:
        """Open the fingers, take the hand back, and look at the part.

        Where the part is after an unknown motion, the retreat of the placement has not been checked.
        """
        motion, belief = self.motion, self.belief
        self.session.phase = "release"
        motion.move_fingers(self.gripper.opened)
        self.session.phase = "retract"
        handle = belief.pose @ self.unknown.frame_T_handle
        retreat = find_retreat(motion, grasp, handle, belief.hand_pose)
        motion.follow_line(inverse(handle) @ belief.hand_pose, inverse(handle) @ retreat.end, retreat.arms)
        motion.stand(LOOKING)

    def _look(self) -> None:
        self.session.phase = "look"
        begin = self.world.time
        self.motion.stand(LOOKING)
        while not self.belief.is_seen:
            if self.world.time - begin > _MOST_LOOKING:
                raise SkillError(
                    "other",
                    f"No marker of '{self.part}' was seen within {_MOST_LOOKING:g} s; it may be hidden.",
                )
            self.motion.stand(self.session.dt)

    def _search(self, distance: float, accept: Callable[[BasePlacement], bool], seed: int) -> BasePlacement:
        """Search a placement from which the handle can be pulled by a distance [m], or as far as possible."""
        session, self.approach = self.session, Approach()
        session.phase = "place"
        with session.timed("place"):
            model, handle = self.unknown.model, self.unknown.handle
            grasps = sample_grasps(model, self.gripper, handle, _GRASPS, seed, state=session.state)
            return self.opener.search.find(
                session.state, grasps, distance, accept=accept, samples=self.samples, seed=seed
            )

    def _plan(self, placement: BasePlacement) -> bool:
        self.approach = self.opener.approaches.plan_to(self.session.state, placement, self.seed)
        return bool(self.approach)

    def _come(self, placement: BasePlacement) -> None:
        session, approach, motion = self.session, self.approach, self.motion
        if approach.places is not None:
            motion.drive(approach)
            self._look()
        elif approach.base:
            gone = self.world.time - self.begin
            self.belief.reset()
            session.restart(self.world.state.updated(approach.base))
            self.pulling.rebase(gone + self.begin)
            self.begin = -gone
            motion.until = self.seconds - gone
            self.judge.reset()
            self._look()
        session.phase = "approach"
        assert approach.trajectory is not None
        motion.approach(placement, approach.trajectory)

    def _report_joint(self, learned: LearnedJoint) -> str:
        """Write the learned joint into the model if it had another one or none, and say so."""
        self.measures |= {
            "family": learned.family,
            "decided_way": learned.distance,
            "decided_turn": learned.turn,
            "decided_seconds": learned.time,
            "parent": self.belief.beside,
        }
        parameters = learned.fit.parameters
        self.measures |= {key: parameters[key] for key in ("axis", "point") if key in parameters}
        self.measures["believed"], words = revise_joint(self.model, self.belief, learned)
        return words
