"""Opening of what nobody described: a handle is pulled, the joint is learned, and the part follows it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import InfeasibleError, InvalidValueError, KineverseError, NotFiniteError, UnknownNameError, suggest
from kineverse.grasping import Grasp, find_gripper, sample_grasps
from kineverse.lie import Array, inverse
from kineverse.model.model import Model
from kineverse.planning import Planner
from kineverse.worlds import Judge, Sensors

from .hand_motion import HandMotion
from .joint_learning import JointLearning
from .outcome import Outcome, SkillError
from .part_looks import PartBelief, measure_way
from .placement import BasePlacement, PlacementSearch
from .session import Session
from .unknown_part import find_joint, free_part, write_joint
from .unknown_pull import LearnedPull, StraightPull, learn_model, place_beside

OPEN_WAY, OPEN_TURN = 0.25, math.radians(60.0)
"""Opening that is wanted by default [m], [rad]."""
_LOOKING, _HELD_LOOKING = 0.6, 0.7
"""Times of looks before the approach, and with the hand closed [s]."""
_MOST_LOOKING = 3.0
_REACHES = (0.25, 0.15, 0.08)
"""Straight ways of the handle that a placement has to allow [m], one after the other."""
_GRASPS, _PLANNING = 128, 2.0
_REFIT = 0.5
"""Time between two fits of a learned joint [s]."""
_STUCK_WAY, _STUCK_TURN, _PATIENCE = 0.008, math.radians(1.5), 1.5
"""Motion of a part that follows the hand [m], [rad], in a time [s]."""
_SLIPPED = 0.03
"""Distance of the hand from its place on the handle from which on the handle has slipped [m]."""


def open_unknown(
    session: Session,
    handle: str,
    *,
    model: Model,
    part: str | None = None,
    beside: str | None = None,
    marker: str | None = None,
    sensors: Sensors | None = None,
    way: float = OPEN_WAY,
    turn: float = OPEN_TURN,
    hand: str | None = None,
    seconds: float = 60.0,
    placements: int = 1000,
    seed: int = 0,
) -> Outcome:
    """Open a part whose joint is unknown by its handle, and write the learned joint into a model.
    """
    run = _Run(session, handle, model, part, beside, marker, sensors, (way, turn), hand, seconds, placements, seed)
    return run.perform()


class _Run:
    def __init__(self, session, handle, model, part, beside, marker, sensors, wanted, hand, seconds, placements, seed):
        self.session, self.model = session, model
        world = session.world
        self.sensors = sensors or Sensors()
        self.wanted, self.seconds, self.samples, self.seed = wanted, seconds, placements, seed
        self.gripper = find_gripper(model, world.robot, hand)
        if handle not in model.frames:
            raise UnknownNameError(f"There is no frame '{handle}'. {suggest(handle, model.frames, 'frame')}")
        seen = set(world.observe().poses)
        self.frame = part or handle
        self.beside = beside
        self.unknown = free_part(model, self.frame, handle, session.state)
        marker = marker or handle
        self.belief = PartBelief(
            self.unknown, world, session.state, self.gripper.hand, marker, self.beside, self.sensors
        )
        self.begin, self.first_step = world.time, session.steps
        self.learning = JointLearning()
        self.measures: dict[str, Any] = {}

    def perform(self) -> Outcome:
        session, world = self.session, self.session.world
        before = session.belief
        truth = compile(world.model.fk(self.belief.marker, self.beside or "world"))
        def part_truth():
            return truth(world.state.vector(truth.inputs)) @ self.belief._marker_T_part
        session.belief = self.belief
        session.state = self.belief.update(world)
        reason = kind = ""
        self.truth0 = part_truth()
        try:
            reason = self._open()
        except SkillError as failure:
            reason, kind = str(failure), failure.kind
        except (InfeasibleError, NotFiniteError) as error:
            reason, kind = f"The controller has no command: {error}", "other"
        session.stop()
        way, turn = measure_way(self.truth0, part_truth(), self.grip_point)
        session.belief = before
        session.state = before.update(world)
        m = {**self.judge.measures, **self.measures, "way": way, "turn": turn}
        return Outcome(not kind, turn, reason, world.name, world.time - self.begin, session.steps - self.first_step, m)

    @property
    def grip_point(self) -> Array:
        return (self.unknown.model.fk(self.unknown.handle.frame, self.frame)({}) @ self.unknown.handle.pose)[:3, 3]

    def _open(self) -> str:
        session, unknown = self.session, self.unknown
        self.search = PlacementSearch(unknown.model, self.gripper, session.state)
        self.planner = Planner(unknown.model, self.search.moving, rules=self.search.scene.rules)
        self.judge = Judge(session.world.model, session.world.robot, self.gripper, handle=unknown.handle.frame)
        self.motion = HandMotion(
            session, self.gripper, unknown.handle, self.search, self.planner, self.judge, self.begin + self.seconds
        )
        self._look()
        with session.timed("place"):
            grasps = sample_grasps(unknown.model, self.gripper, unknown.handle, _GRASPS, self.seed)
        placement = self._place(grasps)
        self._approach(placement)
        if not self.motion.close(placement.grasp):
            raise SkillError("other", "The fingers closed beside the handle.")
        grasped = session.world.time
        try:
            reason = self._pull(placement.grasp)
        finally:
            self.measures["pull_seconds"] = session.world.time - grasped
            self.belief.release()
        self.motion.release(placement.grasp)
        return reason

    def _wait(self, seconds: float) -> None:
        end = self.session.world.time + seconds
        while self.session.world.time < end - 1e-9:
            self.motion.act({})

    def _look(self) -> None:
        self.session.phase = "look"
        self._wait(_LOOKING)
        while not self.belief.is_seen:
            if self.session.world.time - self.begin > _MOST_LOOKING:
                raise SkillError("other", "not seen")
            self._wait(0.1)

    def _place(self, grasps) -> BasePlacement:
        session = self.session
        session.phase = "place"
        why = ""
        with session.timed("place"):
            for reach in _REACHES:
                found = self.search.find(session.state, grasps, reach, samples=self.samples, seed=self.seed)
                if found:
                    return found
                why = why or found.why
        raise SkillError("reach", why)

    def _approach(self, placement: BasePlacement) -> None:
        session, search, motion = self.session, self.search, self.motion
        session.phase = "approach"
        wanted = dict(zip(placement.coordinates, placement.approach.tolist(), strict=True))
        if search.standing:
            stands = {s: wanted[s] for s in search.standing}
            self.belief.reset()
            session.restart(session.world.state.updated(stands))
            self._look()
        motion.move_fingers(self.gripper.opened)
        with session.timed("plan"):
            self.planner.place(session.state)
            start = session.state.vector(self.planner.symbols)
            end = np.array([wanted[s] for s in self.planner.symbols])
            path = self.planner.plan(start, end, seconds=_PLANNING, seed=self.seed)
            if not path.found:
                raise SkillError("collision", f"There is no way to the handle: {path.why}")
            trajectory = path.trajectory()
        motion.follow(trajectory)
        motion.count_turns(placement.line[0])
        rows = placement.line[:, : len(search.moving)] + motion.turns
        motion.follow_line(placement.grasp.approach, placement.grasp.pose, rows)

    def _pull(self, grasp: Grasp) -> str:
        session, belief, motion = self.session, self.belief, self.motion
        session.phase = "pull"
        belief.hold()
        self._wait(_HELD_LOOKING)
        world = session.world
        frame_T_handle = self.unknown.model.fk(self.unknown.handle.frame, self.frame)({})
        bar = belief.pose @ frame_T_handle
        bar_T_hand = inverse(bar) @ belief.hand_pose
        first, point = belief.relative_pose, self.grip_point
        pull: Any = StraightPull(motion, belief, bar_T_hand)
        fitted, best, since = -1.0, 0.0, world.time
        for look in belief.looks:
            self.learning.add(look.pose, look.covariance)
        belief.looks.clear()
        learned = None
        while True:
            motion.check_time()
            for look in belief.looks:
                self.learning.add(look.pose, look.covariance)
            belief.looks.clear()
            way, turn = measure_way(first, belief.relative_pose, point)
            with session.timed("learn"):
                new = self.learning.update(way, turn, world.time)
            if new and (fitted < 0 or world.time - fitted >= _REFIT):
                found = self.learning.learned
                if fitted < 0:
                    self.measures |= {"family": found.family, "decided_way": found.way, "decided_turn": found.turn,
                      "decided_seconds": found.time}
                fitted = world.time
                with session.timed("learn"):
                    learned = learn_model(self.model, belief, found.fit)
                    kind = found.fit.motion.kinds[0]
                    pull = LearnedPull(motion, belief, learned, bar_T_hand, first, self.wanted[kind])
            with session.timed("open"):
                command = pull.step()
            motion.act(command.speeds)
            self.last = (way, turn, command)
            if turn >= self.wanted[1] or (way >= self.wanted[0] and (learned is None or kind == 0)):
                return f"opened {way:.3f} {turn:.3f}"
            if way > best + 0.005:
                best, since = way, world.time
            elif world.time - since > _PATIENCE:
                raise SkillError("other", f"does not go on {way:.3f} {turn:.3f} {command.active[:3]} {self.learning.explain()}")
            if belief.is_lost:
                raise SkillError("other", "lost")
