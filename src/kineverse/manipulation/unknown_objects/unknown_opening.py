"""Opening of a part whose joint nobody described: its handle is pulled, and the joint is learned."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError, UnknownNameError, suggest
from kineverse.grasping import Grasp, find_gripper, sample_grasps
from kineverse.lie import Array, inverse
from kineverse.manipulation.opening import BasePlacement, PlacementSearch
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.planning import Planner
from kineverse.worlds import Judge, Sensors

from .joint_learning import JointLearning, LearnedJoint
from .joint_revision import revise_joint, watch_joint
from .part import JointPath, find_joint, free_part
from .part_belief import PartBelief, measure_way
from .pull import LearnedPull, StraightPull, learn_model

OPEN_WAY, OPEN_TURN = 0.25, math.radians(60.0)
"""Opening that is wanted by default [m], [rad]."""
_LEAST_WAY, _LEAST_TURN = 0.08, math.radians(10.0)
"""Opening from which a part that goes no further counts as open [m], [rad]."""
_LOOKING, _HELD_LOOKING, _MOST_LOOKING = 0.6, 1.0, 3.0
"""Times of looks before the approach and with the hand closed, and the largest until a part is seen [s]."""
_REACH = 0.25
"""Straight way of the handle that a placement should allow [m]."""
_GRASPS, _PLANNING = 128, 2.0
_MOST_GRASPS = 3
_REFIT = 0.5
"""Time between two controllers for a learned joint [s]."""
_FOLLOWS, _STALLED, _PATIENCE = 0.01, 0.004, 1.5
"""Motion of a part that follows the hand, and its least progress [m] in a time [s]."""
_SLIPPED = 0.012
"""Distance of the handle from its place in the hand from which on it has slipped [m]."""
_LED = 0.06
"""Way of the handle before which the hand does not rely on a joint that was learned [m]."""
_FIRM, _SUDDEN = 0.006, 0.8
"""Distance of the handle from its place in a firm hand [m], and time in which it is torn out of that [s]."""
_TORN, _SLID = "It was torn out of a firm hand there.", "The handle slipped in the hand."


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
    """Open a part whose joint is unknown, or not as believed, and write the learned joint into a model.

    The robot sees markers on the part and on what it moves in. It grasps the handle, pulls straight along its
    outward normal and yields to all other motion, while the joint is identified. As soon as its family is
    certain, it is a joint of a model that a controller holds the hand to, and it is fitted anew on the way.
    A handle that slips out of the hand is grasped anew.

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
        Wanted opening: way of the handle of a part that slides [m], angle of one that turns [rad].
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
        if not (math.isfinite(value) and value > 0.0):
            raise InvalidValueError(f"{name}= is a positive number, not {value!r}.")
    for name in (handle, *(n for n in (part, beside) if n is not None)):
        if name not in model.frames:
            raise UnknownNameError(f"There is no frame '{name}'. {suggest(name, model.frames, 'frame')}")
    wanted = way, turn
    return _Run(session, model, handle, part, beside, sensors, wanted, hand, seconds, placements, seed)()


class _Run:
    """One opening: its phases, and what was found on the way."""

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
        above = _ancestors(model, handle)
        self.part = part or next((f for f in (handle, *above) if find_joint(model, f)), handle)
        if self.part not in (handle, *above):
            raise InvalidValueError(
                f"The handle '{handle}' is not below the part '{self.part}', but {', '.join(above)}."
            )
        before = model.default_state()
        before = before.updated({s: v for s, v in session.state.items() if s in before})
        self.unknown = unknown = free_part(model, self.part, handle, before)
        self.frame_T_handle = np.asarray(unknown.model.fk(handle, self.part)({}))
        self.point = (self.frame_T_handle @ unknown.handle.pose)[:3, 3]
        rigid = [f for f in model.frames if f == self.part or self.part in _ancestors(model, f)]
        markers = [f for f in rigid if not unknown.model.fk(f, self.part).symbols]
        still = [f for f in _ancestors(model, self.part) if not model.fk(f).symbols]
        references = still if beside is None else [beside]
        self.belief = PartBelief(
            unknown,
            self.world,
            before,
            self.gripper.hand,
            markers,
            references,
            sensors or Sensors(),
        )
        self.learning = JointLearning()
        self.measures: dict[str, Any] = {"grasps": 0}
        self.farthest = 0.0
        self.first_step, self.begin = session.steps, self.world.time
        names = [f for f in markers if f in self.world.model.frames]
        self._truth = compile(self.world.model.fk((names or [handle])[0]))

    def __call__(self) -> Outcome:
        """Open the part, and return the outcome."""
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
        way, turn = measure_way(first, self._true_pose(), self.point)
        self.measures |= {"way": way, "turn": turn}
        learned = self.learning.learned
        turns = bool(learned.fit.motion.kinds[0]) if learned is not None else turn > 0.5 * _LEAST_TURN
        if learned is not None:
            reason = f"{reason} {self._report_joint(learned)}"
        if kind:
            self.measures["failure"] = kind
        return Outcome(
            not kind, turn if turns else way, reason, world.name, world.time - self.begin,
            session.steps - self.first_step, {**self.judge.measures, **self.measures},
        )  # fmt: skip

    def _true_pose(self) -> Array:
        pose: Array = self._truth(self.world.state.vector(self._truth.inputs))
        return pose

    # -- phases --------------------------------------------------------------------------------------------

    def _open(self) -> str:
        """Open the part, and return how far, or raise SkillError."""
        session, unknown = self.session, self.unknown
        robot = self.world.robot
        self.judge = Judge(self.world.model, robot, self.gripper, handle=unknown.handle.frame)
        self.judge.update(self.world.state)
        with session.timed("place"):
            self.search = PlacementSearch(unknown.model, self.gripper, session.state)
            self.planner = Planner(unknown.model, self.search.moving, rules=self.search.scene.rules)
        self.motion = HandMotion(
            session, self.gripper, unknown.handle, self.search, self.planner, self.judge,
            self.begin + self.seconds,
        )  # fmt: skip
        self._look()
        if self.belief.monitor is None:
            self.belief.monitor = watch_joint(self.model, self.belief)
        placement = self._place()
        grasp = placement.grasp
        assert grasp is not None
        self._approach(placement)
        self.start, self.pulling = self.belief.relative_pose, self.world.time
        try:
            return self._pull(grasp)
        finally:
            self.measures["pull_seconds"] = self.world.time - self.pulling
            self.belief.release()
            if not self._is_late():
                self.motion.release(placement)

    def _is_late(self) -> bool:
        """Return whether no time is left to let go."""
        return self.world.time > self.motion.until

    def _wait(self, seconds: float) -> None:
        end = self.world.time + seconds
        while self.world.time < end - 1e-9:
            self.motion.act({})

    def _look(self) -> None:
        """Look at the part while the robot stands."""
        self.session.phase = "look"
        begin = self.world.time
        self._wait(_LOOKING)
        while not self.belief.is_seen:
            if self.world.time - begin > _MOST_LOOKING:
                raise SkillError(
                    "other",
                    f"No marker of '{self.part}' was seen within {_MOST_LOOKING:g} s; it may be hidden.",
                )
            self._wait(self.session.dt)

    def _place(self) -> BasePlacement:
        """Return a placement from which the handle can be pulled straight, as far as possible."""
        session, why = self.session, ""
        session.phase = "place"

        def plan(placement: BasePlacement) -> bool:
            nonlocal why
            state, planner = session.state, self.planner
            wanted = dict(zip(placement.coordinates, placement.approach.tolist(), strict=True))
            planner.place(state.updated({s: wanted[s] for s in self.search.standing}))
            end = np.array([wanted[s] for s in planner.symbols])
            path = planner.plan(state.vector(planner.symbols), end, seconds=_PLANNING, seed=self.seed)
            if path.found:
                self.trajectory = path.trajectory()
            why = "" if path.found else f" There is no way to the handle: {path.why}"
            return bool(path.found)

        with session.timed("place"):
            grasps = sample_grasps(self.unknown.model, self.gripper, self.unknown.handle, _GRASPS, self.seed)
            found = self.search.find(
                session.state, grasps, _REACH, accept=plan, samples=self.samples, seed=self.seed
            )
        if not found:
            raise SkillError(found.failure, f"{found.why}{why}")
        return found

    def _approach(self, placement: BasePlacement) -> None:
        """Put a base that only stands to its place, and bring the hand to the handle."""
        session, search, motion = self.session, self.search, self.motion
        if search.standing:
            wanted = dict(zip(placement.coordinates, placement.approach.tolist(), strict=True))
            gone = self.world.time - self.begin
            self.belief.reset()
            session.restart(self.world.state.updated({s: wanted[s] for s in search.standing}))
            self.begin = -gone
            motion.until = self.seconds - gone
            self.judge.reset()
            self._look()
        session.phase = "approach"
        motion.approach(placement, self.trajectory)

    def _pull(self, grasp: Grasp) -> str:
        """Pull until the part is open or goes no further; grasp it anew where the handle slips."""
        way = -math.inf
        for _ in range(_MOST_GRASPS):
            self.measures["grasps"] += 1
            if not self.motion.close(grasp):
                why = "The fingers closed beside the handle."
            else:
                if not self.learning.poses:
                    self.pulling = self.world.time
                why = self._pull_once()
            if not why:
                return self._describe_opening("is open")
            self._let_go()
            if why == _TORN and self._is_far_enough():
                return f"{self._describe_opening('goes no further')} {why}"
            last, way = way, self._opening()[0]
            if way - last < _FOLLOWS:
                break
            pose = inverse(self.belief.pose @ self.frame_T_handle) @ self.belief.hand_pose
            self.motion.follow_line(pose, grasp.pose)
        opened, _ = self._opening()
        if opened < _FOLLOWS:
            raise SkillError(
                "other",
                f"'{self.part}' does not follow the hand: it moved by {1e3 * opened:.0f} mm. {why} It may be "
                "fixed, locked, or need more force than the grip holds.",
            )
        if self._is_far_enough():
            return self._describe_opening("goes no further")
        raise SkillError("other", self._describe_opening("goes no further") + f" {why}")

    def _let_go(self) -> None:
        """Open the fingers, and look where the part is."""
        self.session.phase = "grasp anew"
        self.belief.release()
        self.motion.move_fingers(self.gripper.opened)
        self._wait(_LOOKING)

    def _pull_once(self) -> str:
        """Pull until the part is open, and return why it is not, empty if it is."""
        session, belief, motion, learning = self.session, self.belief, self.motion, self.learning
        session.phase = "pull"
        belief.hold()
        self._wait(_HELD_LOOKING)
        part_T_hand = inverse(belief.pose) @ belief.hand_pose
        bar_T_hand = inverse(self.frame_T_handle) @ part_T_hand
        if not learning.poses:
            self.start = belief.relative_pose
        belief.begin_motion()
        pull: StraightPull | LearnedPull = StraightPull(motion, belief, bar_T_hand)
        fitted, known = -math.inf, learning.learned is not None
        best, since = self._opening()[0], self.world.time
        begun = firm = since
        while True:
            motion.check_time()
            for look in belief.looks:
                learning.add(look.pose, look.covariance)
            belief.looks.clear()
            way, turn = self._opening()
            now = self.world.time
            with session.timed("learn"):
                if learning.update(way, turn, now - self.pulling):
                    known = True
                if known and now - fitted >= _REFIT and way >= _LED and learning.learned is not None:
                    fit, fitted = learning.learned.fit, now
                    pull = LearnedPull(
                        motion, belief, learn_model(self.model, belief, fit), bar_T_hand, self.start,
                        self.wanted[fit.motion.kinds[0]],
                    )  # fmt: skip
                elif learning.likely is not None and isinstance(pull, StraightPull):
                    pull.likely = JointPath.of_fit(learning.likely, self.start)
            with session.timed("open"):
                command = pull.step(way)
            motion.act(command.speeds)
            way, turn = self._opening()
            if self._is_open(way, turn):
                return ""
            slip = belief.slip(part_T_hand, self.point)
            if slip > _SLIPPED:
                session.stop()
                return _TORN if now - firm < _SUDDEN and firm - begun > _SUDDEN else _SLID
            if slip < _FIRM:
                firm = now
            if way > best + _STALLED:
                best, since = way, now
                if way > self.farthest + _FOLLOWS:
                    self.farthest = way
                    self.measures["opened_seconds"] = now - self.pulling
            elif now - since > _PATIENCE:
                return f"In the way: {', '.join(command.active[:3]) or 'nothing that the controller knows'}."

    # -- what was found ------------------------------------------------------------------------------------

    def _opening(self) -> tuple[float, float]:
        """Return the believed way of the handle [m] and angle of the part [rad] since the first grasp."""
        return measure_way(self.start, self.belief.relative_pose, self.point)

    def _is_far_enough(self) -> bool:
        """Return whether a part that goes no further counts as open."""
        way, turn = self._opening()
        return way >= _LEAST_WAY or turn >= _LEAST_TURN

    def _is_open(self, way: float, turn: float) -> bool:
        learned = self.learning.learned
        if learned is not None and learned.fit.motion.kinds[0]:
            return turn >= self.wanted[1]
        return way >= self.wanted[0] or turn >= self.wanted[1]

    def _describe_opening(self, verb: str) -> str:
        way, turn = self._opening()
        return f"'{self.part}' {verb}, by {100 * way:.0f} cm and {math.degrees(turn):.0f}°."

    def _report_joint(self, learned: LearnedJoint) -> str:
        """Write the learned joint into the model if it had another one or none, and say so."""
        self.measures |= {
            "family": learned.family,
            "decided_way": learned.way,
            "decided_turn": learned.turn,
            "decided_seconds": learned.time,
            "parent": self.belief.beside,
        }
        parameters = learned.fit.parameters
        self.measures |= {key: parameters[key] for key in ("axis", "point") if key in parameters}
        self.measures["believed"], words = revise_joint(self.model, self.belief, learned)
        return words


def _ancestors(model: Model, frame: str) -> list[str]:
    """Return the frames above a frame, the nearest first, without the world."""
    found = []
    while (frame := model.frames[frame].parent) != WORLD:
        found.append(frame)
    return found
