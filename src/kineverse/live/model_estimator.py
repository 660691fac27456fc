"""Estimator of a model: it watches markers, learns joints that nobody described, and doubts known ones.

Nothing but the model and the poses of markers is given: the noise is measured. What it finds are proposals,
each one operation; who owns the model decides what becomes of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from kineverse._names import matches_pattern
from kineverse.articulations import Fixed, Prismatic, Revolute
from kineverse.errors import KineverseError
from kineverse.estimation import Fit, JointVerdict, PlausibilityMonitor, pose_covariance
from kineverse.estimation.plausibility.report import TestableJoint, find_testable_joints
from kineverse.grasping.finger_branches import path_to_root
from kineverse.lie import Array, exp_so3, inverse, pose_difference, transform, translation, unit_vector
from kineverse.manipulation.unknown_objects.joint_learning import JointLearning, axis_deviation
from kineverse.manipulation.unknown_objects.unmodelled_joint import JointPath, align_fit
from kineverse.model.basic_operations import Attach, Override
from kineverse.model.body import Pose
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse.worlds.run_metrics import measure_way

from .marker_tracks import REST, MarkerTracks
from .streams import LearnerNote, ProposalRow, WatchedPart

_PERIOD = 0.3  # time between two fits of a joint [s]
_HELD_BACK = 0.5  # time for which a pose waits until it is certain that what carries its part stood still [s]
_STILL = 0.01  # motion of a part that is back where it was [m]
_CARRIED = 1.0  # time between a motion of what carries a part and poses of it that count [s]
_NEAR, _TURNED = (
    0.12,
    0.35,
)  # distance of a pose from the median of the last ones that makes an outlier [m], [rad]
_ARM = 0.3  # distance at which a rotation counts as a motion, since a marker may be on the axis [m]
_FEWEST = 8  # poses of a part before which nothing is said of its joint
_MOST_POSES = 250  # of a part; beyond, every second one is left out, and so on
_BETTER = 0.5  # share of the deviation of a written joint that a better one has at most
_EXACT = 2e-3  # deviation of a joint that needs no better one [m]
_EDITS = 1.0  # shortest time between two edits of a joint [s]
_MOVED, _OFF = 0.02, math.radians(1.5)  # motion of furniture that is proposed [m], [rad]
_STANDS = 20.0  # poses of furniture at rest from which on it stands somewhere
_WATCHED, _TESTED = (
    3.0,
    2,
)  # time after a motion in which a joint is tested, and joints that are in a picture [s]
_REPORTS = 1.5  # time between two reports on an implausible joint [s]
_CORRELATED = 0.1  # time for which errors of a camera last [s]
_KEPT = 150  # poses of a report
_CAUTIOUS = 1.25  # a measured noise is taken as that much larger, as the test takes it as exact
_REFUSED = 10.0  # time until an operation that the model refused is tried again [s]
_AWAY = 1.0  # time without a pose from which on a part is hidden [s]


@dataclass(frozen=True, eq=False)
class Proposal:
    """Operation that would make the model explain what was seen."""

    tag: str
    operation: Operation
    before: Operation | None  # operation that has the tag now
    what: str  # what it does, in words
    frame: str  # frame that it places
    since: float  # time since which it is proposed [s]
    fit: Fit | None = None  # identified joint, if it is that of an unknown part
    verdict: JointVerdict | None = None  # on the known joint that it replaces

    def write(self, edit: Edit, model: Model) -> bool:
        """Write the operation in an edit of the model; return False if another one has its tag by now."""
        if _served(model, self.tag) != self.before:
            return False
        if self.before is None:
            edit.apply(self.operation, self.tag)
        else:
            edit.replace(self.tag, self.operation)
        return True


def _added_tag(frame: str) -> str:
    """Return the tag of a joint that is put on top of whatever has placed a frame."""
    return f"learned {frame}"


def _served(model: Model, tag: str) -> Operation | None:
    return model.history.operation(tag) if tag in model.history.entries else None


@dataclass(eq=False)
class _Part:
    """Part whose joint is unknown."""

    frame: str
    parent: str
    tag: str
    name: str  # of its articulation
    zero: Array  # pose (4, 4) in the parent that the model had
    is_named: bool
    learning: JointLearning = field(default_factory=JointLearning)
    looks: deque[tuple[float, Array]] = field(default_factory=deque)
    offered: int = 0  # poses that came to the learning
    fitted: float = -math.inf
    start: Array | None = None
    way: float = 0.0
    turn: float = 0.0
    written: Fit | None = None
    wrote: float = -math.inf

    @property
    def distance(self) -> float:
        """Motion of the part [m], its turn about an axis that may be anywhere included."""
        return max(self.way, _ARM * self.turn)

    @property
    def is_of_interest(self) -> bool:
        """True if something can be said of the part, or it was asked for."""
        has_moved = self.learning.poses >= _FEWEST and self.distance > _MOVED
        return self.is_named or self.written is not None or has_moved


@dataclass(eq=False)
class _KnownJoint:
    """Joint of the model that is tested."""

    joint: TestableJoint
    served: Operation
    monitor: PlausibilityMonitor
    reported: float = -math.inf
    why: str = ""


class ModelEstimator:
    """Estimator of the joints of a model by poses of markers.

    Parts that the model fixes to something else with a marker, or lets float, are watched: their joints are
    learned once they move. Joints that it has are tested while their parts move, and now and then. Furniture
    is watched for standing elsewhere.

    Parameters
    ----------
    model
        The model; its edits are followed at the next pictures.
    parts
        Frames, or patterns of them, of the parts whose joints are unknown. By default all that are fixed to
        something with a marker, or float.
    settling
        Time for which what replaces a known joint, or moves furniture, is proposed before it is due [s].
    asks
        Whether nothing that replaces a known operation is due before it is accepted.

    Attributes
    ----------
    proposals
        What would be written, by tag.

    Examples
    --------
    >>> truth = kv.load("shelf_door")
    >>> model = kv.live.make_unknown_scene(truth, "shelf_door/door").model
    >>> estimator = kv.live.ModelEstimator(model, ["shelf_door/door"])
    >>> door, body = truth.fk("shelf_door/door"), truth.fk("shelf_door/body")
    >>> for k in range(100):
    ...     angle = 0.01 * max(0, k - 20)
    ...     poses = {"shelf_door/door": door({"shelf_door/door": angle}), "shelf_door/body": body()}
    ...     estimator.add(poses, k / 10)
    ...     if k % 10 == 9:
    ...         estimator.think()
    >>> [(part.frame, part.state, part.family) for part in estimator.note().watched]
    [('shelf_door/door', 'moves', 'revolute')]
    """

    def __init__(
        self, model: Model, parts: Iterable[str] = (), *, settling: float = 3.0, asks: bool = False
    ) -> None:
        self.model = model
        self.tracks = MarkerTracks()
        self.proposals: dict[str, Proposal] = {}
        self.alarms: dict[str, str] = {}
        self._patterns, self._settling, self._asks = tuple(parts), settling, asks
        self._version, self._frames = -1, 0
        self._parts: dict[str, _Part] = {}
        self._known: dict[str, _KnownJoint] = {}
        self._furniture: dict[str, Array] = {}  # served poses of what stands in the world
        self._turn = 0
        self._now = -math.inf
        self._written: dict[
            str, tuple[Operation | None, Operation | None]
        ] = {}  # before, and as it is served
        self._repairs: dict[str, JointVerdict] = {}  # verdicts whose replacements were written
        self._taken_back: set[str] = set()
        self._accepted: set[str] = set()
        self._refused: dict[str, float] = {}
        self.edits, self.last, self.seen_at = 0, "", -math.inf

    @property
    def blind(self) -> float:
        """Time for which pictures have shown nothing of the model [s]; NaN before the first one."""
        return self._now - self.seen_at

    # -- what is seen ----------------------------------------------------------------------------------------

    def add(self, poses: Mapping[str, Array], stamp: float) -> None:
        """Add the poses world_T_frame (4, 4) of one picture, which was taken at a time [s]."""
        if stamp <= self._now:
            return
        self._now = stamp
        known = {name: pose for name, pose in poses.items() if name in self.model.frames}
        if not known:
            return
        self.seen_at = stamp
        self.tracks.add(known, stamp)
        if self.model.version != self._version or len(self.tracks.names) != self._frames:
            self._find_parts()
        for part in self._parts.values():
            if part.frame in known:
                self._look(part, stamp)
        self._test(known, stamp)

    def _look(self, part: _Part, stamp: float) -> None:
        """Keep a pose of a part relative to what carries it, if it moves."""
        tracks, is_carried = self.tracks, part.parent != WORLD
        if not (tracks.is_known(part.frame) and (tracks.is_known(part.parent) or not is_carried)):
            return
        if tracks.rests(part.frame):
            if part.start is None and (tracks.rests(part.parent) or not is_carried):
                part.start = self._relate(part.parent) @ tracks.smoothed(part.frame)
            return
        # A carrier that is hidden, or moves, says nothing of what it carries.
        is_hidden = is_carried and stamp - tracks.seen(part.parent) > _HELD_BACK
        if part.start is None or is_hidden or stamp - tracks.stepped(part.parent) < _CARRIED:
            return
        carrier, median = self._relate(part.parent), tracks.median(part.frame)
        latest = tracks.latest(part.frame)
        part.way, part.turn = measure_way(part.start, carrier @ median, np.zeros(3))
        off = pose_difference(latest, median)
        if np.linalg.norm(off[:3]) <= _NEAR and np.linalg.norm(off[3:]) <= _TURNED:
            part.looks.append((stamp, carrier @ latest))

    def _relate(self, carrier: str) -> Array:
        """Return the pose carrier_T_world (4, 4)."""
        return np.eye(4) if carrier == WORLD else inverse(self.tracks.smoothed(carrier))

    def think(self) -> None:
        """Fit joints, and renew the proposals: this takes much longer than a picture."""
        for part in self._parts.values():
            self._learn(part)
        for known in self._known.values():
            self._doubt(known)
        self._find_moved_furniture()

    # -- unknown joints --------------------------------------------------------------------------------------

    def _learn(self, part: _Part) -> None:
        tracks, now = self.tracks, self._now
        stepped, carrier = tracks.stepped(part.frame), tracks.stepped(part.parent)
        while part.looks and part.looks[0][0] <= now - _HELD_BACK:
            stamp, pose = part.looks.popleft()
            # Poses of a part at rest teach nothing; a carrier that moves makes those of its parts wrong.
            if abs(stamp - stepped) <= REST and abs(stamp - carrier) > _CARRIED:
                part.offered += 1
                if part.offered % (1 << (part.learning.poses // _MOST_POSES)) == 0:
                    part.learning.add(pose)
        if (
            part.start is not None
            and part.way > 0.0
            and tracks.rests(part.frame)
            and now - carrier > _CARRIED
        ):
            pose = self._relate(part.parent) @ tracks.smoothed(part.frame)
            part.way, part.turn = measure_way(part.start, pose, np.zeros(3))
            if part.learning.learned is None and part.distance < _STILL:
                # It was carried along, and what carries it was seen to move a little later.
                part.learning, part.offered = JointLearning(), 0
        if part.learning.poses < _FEWEST or now - part.fitted < _PERIOD:
            return
        part.fitted = now
        if not part.learning.update(part.distance, part.turn, now) or part.start is None:
            return
        learned = part.learning.learned
        assert learned is not None
        fit, written = learned.fit, part.written
        if written is not None and fit.family == written.family:
            if axis_deviation(fit) > _BETTER * axis_deviation(written) or axis_deviation(written) < _EXACT:
                return
        ahead = np.asarray(fit.motion.linearise(fit.joint_values[-1:]).pose[0])
        fit = align_fit(fit, part.zero, ahead)
        operation = fit.operation(part.name, part.parent, part.frame, limits=False)
        words = f"'{part.frame}' is {fit.family} on '{part.parent}', {fit.probability:.0%}"
        words += f", known to {1e3 * axis_deviation(fit):.0f} mm"
        before = _served(self.model, part.tag)
        if part.tag == _added_tag(part.frame):
            operation = Override(operation)
        self._propose(Proposal(part.tag, operation, before, words, part.frame, now, fit))

    def _propose(self, proposal: Proposal) -> None:
        earlier = self.proposals.get(proposal.tag)
        since = proposal.since if earlier is None else earlier.since
        self.proposals[proposal.tag] = replace(proposal, since=since)

    # -- known joints ----------------------------------------------------------------------------------------

    def _test(self, poses: Mapping[str, Array], stamp: float) -> None:
        """Test some of the joints by a picture: those whose parts moved in earlier ones, and one in turn.

        What is chosen does not depend on the picture, so the test keeps its rate of false alarms.
        """
        tags = list(self._known)
        if not tags:
            return
        self._turn += 1
        moved = [t for t in tags if stamp - self.tracks.stepped(self._known[t].joint.child) < _WATCHED]
        first = self._turn % len(moved) if moved else 0
        for tag in {*(moved[first:] + moved[:first])[:_TESTED], tags[self._turn % len(tags)]}:
            known = self._known[tag]
            frames = [f for f in (known.joint.parent, known.joint.child) if f != WORLD]
            if all(f in poses and self.tracks.is_known(f) for f in frames):
                seen = {f: (poses[f], self._covariance(f)) for f in frames}
                if known.monitor.update(seen, at=stamp):
                    known.why = f"'{known.joint.child}' does not move as the model says"
                    known.reported = stamp

    def _covariance(self, frame: str) -> Array:
        position, orientation = self.tracks.noise(frame)
        return pose_covariance(_CAUTIOUS * position, _CAUTIOUS * orientation)

    def _doubt(self, known: _KnownJoint) -> None:
        """Propose a joint in place of an implausible one."""
        tag, now = known.joint.tag, self._now
        if not known.why:
            return
        self.alarms[tag] = known.why
        if now - known.reported < _REPORTS or self.tracks.seen(known.joint.child) < known.reported:
            return
        known.reported = now
        try:
            verdict = known.monitor.report()[tag]
        except KineverseError as error:
            known.why = str(error)
            return
        if verdict.replacement is None or verdict.result is None:
            known.why = f"'{known.joint.child}' does not move as the model says: {verdict.reason}"
            return
        words = f"'{known.joint.child}' is {verdict.result} on '{known.joint.parent}'"
        known.why = f"'{known.joint.child}' does not move as the model says"
        operation = verdict.replacement
        records = self.model.articulations.values()
        kind = next((record.kind for record in records if record.child == known.joint.frame), "")
        if getattr(operation, "kind", kind) != kind:
            operation = self._begin_at_zero(known, operation)
        verdict = replace(verdict, replacement=operation)
        self._propose(Proposal(tag, operation, known.served, words, known.joint.child, now, verdict=verdict))

    def _begin_at_zero(self, known: _KnownJoint, operation: Operation) -> Operation:
        """Return a joint of another kind that is 0 where the model's is, positive ahead, and without limits.

        What was seen of it are not its limits.
        """
        joint, tag = known.joint, known.joint.tag
        if not isinstance(operation, (Prismatic, Revolute)) or not isinstance(operation.origin, Pose):
            return operation
        pose, defaults = self.model.fk(joint.child, joint.parent), self.model.default_state()
        zero = np.asarray(pose({s: defaults[s] for s in pose.symbols}))
        copy = self.model.copy()
        with copy.edit() as edit:
            edit.replace(tag, operation)
        path, _ = JointPath.of_model(copy, joint.child, joint.parent, zero)
        axis = unit_vector(np.asarray(operation.axis, dtype=float))
        along, turns = path.value * axis, isinstance(operation, Revolute)
        move = transform(exp_so3(along), np.zeros(3)) if turns else translation(along)
        origin = Pose.from_matrix(operation.origin.matrix @ move)
        if path.project(self._relate(joint.parent) @ self.tracks.smoothed(joint.child)) < path.start:
            axis = -axis
        return replace(operation, origin=origin, axis=tuple(axis.tolist()), lower=None, upper=None)

    # -- furniture -------------------------------------------------------------------------------------------

    def _find_moved_furniture(self) -> None:
        """Propose new origins of what stands elsewhere than the model has it.

        If most of it does, the robot is not where it takes itself to be, and nothing is proposed.
        """
        tracks = self.tracks
        now, furniture = self._now, self._furniture
        there = [f for f in furniture if tracks.is_known(f) and now - tracks.seen(f) < _AWAY]
        seen = [f for f in there if tracks.rests(f) and tracks.weight(f) >= _STANDS]
        moved = {}
        for frame in seen:
            away, turned = measure_way(furniture[frame], tracks.smoothed(frame), np.zeros(3))
            if away > _MOVED or turned > _OFF:
                moved[frame] = away, turned
        lost = len(moved) > 1 and 2 * len(moved) > len(seen)
        for frame in self._furniture:
            tag = self._writer(frame)
            if frame not in moved:
                if frame in seen and tag in self.alarms:
                    del self.alarms[tag]
                    self.proposals.pop(tag, None)
                continue
            away, turned = moved[frame]
            words = f"'{frame}' stands {100 * away:.0f} cm and {math.degrees(turned):.0f}° from where it was"
            self.alarms[tag] = f"{words}, as does other furniture; is the robot elsewhere?" if lost else words
            if lost:
                self.proposals.pop(tag, None)
            elif (earlier := self.proposals.get(tag)) is None or self._now - earlier.since < self._settling:
                self._propose(self._place(frame, words))

    def _place(self, frame: str, words: str) -> Proposal:
        model, tag, parent = self.model, self._writer(frame), self.model.frames[frame].parent
        pose = Pose.from_matrix(inverse(np.asarray(model.fk(parent)({}))) @ self.tracks.smoothed(frame))
        for name, record in model.articulations.items():
            own = ("articulations", name) in model.history.entry(tag).writes
            if own and record.child == frame and record.kind == "fixed":
                operation: Operation = Fixed(
                    name=name, parent=record.parent, child=frame, origin=pose, dynamics=record.dynamics
                )
                break
        else:
            tag, operation = f"seen {frame}", Attach(frame, Frame(parent, (pose,)))
        return Proposal(tag, operation, _served(model, tag), words, frame, self._now)

    # -- the model -------------------------------------------------------------------------------------------

    def _writer(self, frame: str) -> str:
        return self.model.history.writers(f"frames/{frame}")[-1]

    def _find_parts(self) -> None:
        """Find what is to be watched in the present model, and see what became of what was written."""
        model = self.model
        self._version, self._frames = model.version, len(self.tracks.names)
        for tag, (before, after) in list(self._written.items()):
            now = _served(model, tag)
            if now != after:
                del self._written[tag]
                if now == before:
                    self._taken_back.add(tag)
        self.proposals = {t: p for t, p in self.proposals.items() if _served(model, t) == p.before}
        names = [name for name in self.tracks.names if name in model.frames]
        parts: dict[str, _Part] = {}
        self._furniture = {}
        for name in names:
            above = path_to_root(model, name)[1:]
            parent = next((f for f in above if f in self.tracks.names), WORLD)
            part = self._find_part(name, parent)
            if part is not None:
                parts[name] = part
            elif parent == WORLD and not (pose := model.fk(name)).symbols:
                self._furniture[name] = np.asarray(pose({}))
        self._parts = parts
        unknown = {part.tag for part in parts.values()}
        known: dict[str, _KnownJoint] = {}
        for joint in find_testable_joints(model, names, WORLD).joints:
            if not joint.moves or joint.tag in unknown or joint.child in parts:
                continue
            there = self._known.get(joint.tag)
            served = model.history.operation(joint.tag)
            if there is not None and there.joint == joint and there.served == served:
                known[joint.tag] = there
                continue
            relative_to = WORLD if joint.parent == WORLD else None
            frames = [f for f in (joint.parent, joint.child) if f != WORLD]
            monitor = PlausibilityMonitor(
                model,
                frames,
                relative_to=relative_to,
                decorrelation_time=_CORRELATED,
                repaired=self._repairs.values(),
                keep=_KEPT,
            )
            known[joint.tag] = _KnownJoint(joint, served, monitor)
        self._known = known
        doubted = {t for t, one in known.items() if one.why} | {self._writer(f) for f in self._furniture}
        self.alarms = {t: why for t, why in self.alarms.items() if t in doubted}

    def _find_part(self, frame: str, parent: str) -> _Part | None:
        """Return a part whose joint is unknown; None if it has one, or nothing carries it."""
        model, before = self.model, self._parts.get(frame)
        if before is not None and before.tag in self._written:
            return before
        if self._patterns and not matches_pattern(frame, self._patterns):
            return None
        pose = model.fk(frame, parent)
        records = {n: a for n, a in model.articulations.items() if a.child == frame}
        floats = any(len(a.coordinates) >= 6 for a in records.values())
        if not floats and (pose.symbols or (parent == WORLD and not self._patterns)):
            return None
        name, tag = next(iter(records), f"{frame}/joint"), self._writer(frame)
        if ("articulations", name) not in model.history.entry(tag).writes:
            tag = _added_tag(frame)
        if before is not None and (before.parent, before.tag) == (parent, tag):
            before.written = None
            return before
        defaults = model.default_state()
        zero = np.asarray(pose({s: defaults[s] for s in pose.symbols}))
        return _Part(frame, parent, tag, name, zero, bool(self._patterns))

    # -- what becomes of it ----------------------------------------------------------------------------------

    def find_due(self) -> list[Proposal]:
        """Return the proposals that are to be written now."""
        return [p for p in self.proposals.values() if not self._explain_wait(p)]

    def _explain_wait(self, proposal: Proposal) -> str:
        """Return why a proposal waits; empty if it is due."""
        tag = proposal.tag
        if tag in self._accepted:
            return ""
        if tag in self._taken_back:
            return "it was taken back, and has to be accepted"
        if (left := self._refused.get(tag, -math.inf) + _REFUSED - self._now) > 0.0:
            return f"it was refused, and is tried again in {math.ceil(left)} s"
        part = next((part for part in self._parts.values() if part.tag == tag), None)
        if part is not None:
            return "" if self._now - part.wrote >= _EDITS else "another edit was just made"
        if self._asks:
            return "it has to be accepted"
        left = self._settling - (self._now - proposal.since)
        return f"{math.ceil(left)} s more" if left > 0.0 else ""

    def accept(self, tag: str) -> None:
        """Make a proposal due.

        Raises
        ------
        KineverseError
            If nothing of that tag is proposed.
        """
        if tag not in self.proposals:
            raise KineverseError(f"Nothing is proposed for '{tag}' any more.")
        self._accepted.add(tag)

    def confirm(self, proposal: Proposal) -> None:
        """Take note that a proposal was written into the model."""
        tag = proposal.tag
        before, _ = self._written.get(tag, (proposal.before, None))
        self._written[tag] = before, _served(self.model, tag)
        self._taken_back.discard(tag)
        self._accepted.discard(tag)
        self.proposals.pop(tag, None)
        self.alarms.pop(tag, None)
        self._known.pop(tag, None)
        if proposal.verdict is not None:
            self._repairs[tag] = proposal.verdict
        self.edits, self.last = self.edits + 1, proposal.what
        for part in self._parts.values():
            if part.tag == tag:
                part.written, part.wrote = proposal.fit, self._now

    def refuse(self, proposal: Proposal, why: str) -> None:
        """Take note that a proposal was not written, and drop it: what is seen later may propose it again."""
        if self.proposals.get(proposal.tag) is proposal:
            del self.proposals[proposal.tag]
        self._accepted.discard(proposal.tag)
        self._refused[proposal.tag] = self._now
        self.last = f"{proposal.what}: {why}"

    def note(self, problem: str = "", waits: str = "") -> LearnerNote:
        """Return what is thought now; ``waits`` is why due proposals wait."""
        rows = [ProposalRow(p.tag, p.what, self._explain_wait(p) or waits) for p in self.proposals.values()]
        watched = [self._describe(part) for part in self._parts.values() if part.is_of_interest]
        return LearnerNote(watched, dict(self.alarms), rows, self.edits, self.last, problem)

    def _describe(self, part: _Part) -> WatchedPart:
        learning, tracks = part.learning, self.tracks
        fit = learning.likely if learning.learned is None else learning.learned.fit
        state = "waits"
        carrier = part.frame if part.parent == WORLD else part.parent
        if self._now - min(tracks.seen(part.frame), tracks.seen(carrier)) > _AWAY:
            state = "hidden"
        elif self._now - tracks.stepped(part.frame) <= REST:
            state = "moves"
        elif part.written is not None:
            state = "written"
        elif learning.learned is not None:
            state = "sure"
        family, probability = ("", math.nan) if fit is None else (fit.family, fit.probability)
        return WatchedPart(
            part.frame, part.parent, state, family, probability, part.way, part.turn, learning.poses
        )
