"""Behaviours: loops that look, decide, run one skill, say what they do and why, and go on.

They are written against a robot's interface and a belief alone, in a process of a live system or in lock step
with a simulated world. They keep nothing that the world does not show: after a restart, a stop or an edit of
the model they look first, let go of what the hand may hold, and plan anew.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from kineverse._names import matches_pattern
from kineverse.errors import KineverseError, UnknownNameError
from kineverse.grasping import Gripper, Handle, find_handle
from kineverse.manipulation import (
    ArticulatedObject,
    Outcome,
    Session,
    SkillError,
    SkillRun,
    find_articulated_objects,
    open_object,
    push,
)
from kineverse.manipulation.articulated_objects import select_objects
from kineverse.manipulation.opening.approach_planner import Opener
from kineverse.manipulation.opening.hand_motion import HandMotion
from kineverse.manipulation.skill_run import choose_tolerance
from kineverse.model.model_view import ModelView
from kineverse.worlds.furniture_overlaps import OVERLAP

from .streams import ActivityNote, SkillResult

_OPEN = 1.5  # tolerances by which an object is off when it counts as open; it is closed to within one
_UNSEEN, _UNKNOWN = 10.0, 0.05  # time without a marker [s], and deviation, from which on nothing is decided
_PAUSE, _MOST_PAUSE = 5.0, 120.0  # first and longest time until something that failed is tried again [s]
_MOVED = 0.05  # change of an object that failed after which it is tried at once [m], [rad]
_TRIES = 3  # of an object that is opened or closed by name, or on a tour
_REST = 0.1  # time between two looks while nothing is done [s]
_LETTING_GO = 30.0  # longest time to let go of something [s]
_LATE, _SEARCHED = 0.005, 1.0  # lateness of a step that counts, and time beyond which it was a search [s]
_AJAR = 0.2  # share of their way by which fingers that are open may be closed
_SHOWN = 3  # steps between two reports
_MOST_RESULTS = 64

Look = Callable[[Session], object]


class SessionSource(Protocol):
    """Source of sessions of the newest model."""

    def open(self, on_step: Look, on_search: Callable[[str], object]) -> Session:
        """Return a session, in place of the one before; OfflineError while there is no robot."""

    def is_current(self, session: Session) -> bool:
        """Return whether the model of a session is still the newest."""

    def find_problem(self, session: Session) -> str:
        """Return why the robot takes no commands, or is not known well; empty if it does and is."""

    def rest(self, session: Session | None, seconds: float) -> None:
        """Let time pass [s] without moving, and read the sensors."""


@dataclass(frozen=True)
class Task:
    """One skill that is to be done."""

    object: ArticulatedObject
    opening: bool
    why: str
    by_push: bool = False
    far: float = 1.0  # share of the whole way by which it is opened

    @property
    def target(self) -> float:
        """Wanted value of the coordinate [m], [rad]."""
        shut, opened = self.object.shut, self.object.opened
        return shut + self.far * (opened - shut) if self.opening else shut

    def __str__(self) -> str:
        verb = "opens" if self.opening else "pushes" if self.by_push else "closes"
        return f"{verb} '{self.object.coordinate}'"


@dataclass
class _Failure:
    """Last failure at an object."""

    value: float  # of its coordinate then
    until: float  # when it is tried again, by the robot's clock [s]
    tries: int
    reason: str


class Behaviour:
    """Loop of a robot that does one task after the other.

    Parameters
    ----------
    sessions
        Source of sessions.
    patterns
        Names of the objects that it is about, or patterns; all doors, flaps and drawers by default.
    report
        Is called with a note whenever there is news.
    hand
        Frame of the hand; the likeliest gripper by default.
    seconds
        Longest time of a skill [s].
    seed
        Seed of all searches.
    far
        Share of the whole way by which things are opened.
    missing_ok
        Whether names that the model does not have are left out, instead of an error. Those that an edit
        takes away meanwhile always are.

    Attributes
    ----------
    note
        What it does, and why, with the results so far.
    is_done
        Whether nothing is left to do, for ever.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    name = ""
    overlap = OVERLAP  # depth from which on what an object meets on its way is in its way [m]
    heeds_edits = True  # whether an edit of the model ends a skill

    def __init__(
        self,
        sessions: SessionSource,
        *,
        patterns: Iterable[str] | None = None,
        report: Callable[[ActivityNote], object] = lambda _: None,
        hand: str | None = None,
        seconds: float = 90.0,
        seed: int = 0,
        far: float = 1.0,
        missing_ok: bool = False,
    ) -> None:
        self._far, self._missing_ok = far, missing_ok
        self._sessions, self._report, self._hand = sessions, report, hand
        self._patterns = None if patterns is None else tuple(patterns)
        self._seconds, self.seed = seconds, seed
        self.note = ActivityNote(self.name)
        self.is_done = False
        self.session: Session | None = None
        self.scene = Furniture.none()
        self.failures: dict[str, _Failure] = {}
        self._looks, self._acts, self._is_hand_checked = 0, False, False
        self._stepped, self._phase = -np.inf, ""

    # -- the loop --------------------------------------------------------------------------------------------

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Go on until it is over, or nothing is left to do."""
        while not is_over() and not self.is_done:
            self.step()

    def step(self) -> None:
        """Look, decide, and do one thing; or wait a moment."""
        session = self._keep_session()
        if session is None:
            return
        if why := self._find_problem(session):
            self._wait("waits", why)
        elif not self._is_hand_checked:
            self._is_hand_checked = self._let_go(session)
        elif (task := self.choose(session)) is not None:
            self._do(session, task)

    def choose(self, session: Session) -> Task | None:
        """Return what to do next; None after a pause, if there is nothing, or nothing more."""
        raise NotImplementedError

    def finish(self, task: Task, outcome: Outcome) -> None:
        """Take note of the outcome of a task that nothing has interrupted."""

    def _keep_session(self) -> Session | None:
        """Return a session of the newest model, made anew where needed; None after a pause without one."""
        session = self.session
        if session is not None and not session.broken and self._sessions.is_current(session):
            return session
        self.session = None
        try:
            session = self._sessions.open(self._look, self._search)
            self.scene = Furniture.of(session, self._patterns, self._hand, self._missing_ok)
        except UnknownNameError:
            raise  # of what was asked for
        except KineverseError as error:
            self._wait("waits", str(error))
            return None
        self.session, self._is_hand_checked, self._missing_ok = session, False, True
        return session

    def _find_problem(self, session: Session) -> str:
        if why := self._sessions.find_problem(session):
            return why
        try:
            session.refresh()
            session.await_readings()
        except SkillError as error:
            return str(error)
        return ""

    def _wait(self, doing: str, why: str) -> None:
        """Say what is waited for, and let a moment pass."""
        self._say(doing, why)
        self._sessions.rest(self.session, _REST)

    # -- one thing -------------------------------------------------------------------------------------------

    def _do(self, session: Session, task: Task) -> None:
        coordinate, model = task.object.coordinate, session.model
        self._say(str(task), task.why)
        begin, steps = session.time, session.steps
        tries = self.failures[str(coordinate)].tries if str(coordinate) in self.failures else 0
        self._acts = True
        try:
            if task.by_push:
                bodies = None if self.scene.gripper is None else self.scene.gripper.bodies
                outcome = push(
                    session,
                    coordinate,
                    target=task.target,
                    bodies=bodies,
                    seconds=self._seconds,
                    retreat=True,
                )
            else:
                outcome = open_object(
                    session, coordinate, target=task.target, hand=self.scene.gripper,
                    seconds=self._seconds, overlap=self.overlap, seed=self.seed + tries,
                )  # fmt: skip
        except KineverseError as error:
            value, name = float(session.state[coordinate]), session.interface.name
            outcome = Outcome(
                False,
                value,
                str(error),
                name,
                session.time - begin,
                session.steps - steps,
                {"failure": "other"},
            )
        finally:
            self._acts = False
        self._is_hand_checked = bool(outcome)
        why = self._find_interruption(session, model)
        if not outcome and why:
            self._say(str(task), f"It was interrupted: {why}")
            self.note.last = f"{task}: interrupted. {why}"
            return
        name = str(coordinate)
        if outcome:
            self.failures.pop(name, None)
        else:
            pause = min(_PAUSE * 2.0**tries, _MOST_PAUSE)
            self.failures[name] = _Failure(outcome.value, session.time + pause, tries + 1, outcome.reason)
        self.finish(task, outcome)

    def _find_interruption(self, session: Session, model: ModelView) -> str:
        """Return what has ended a skill that is not to blame; empty if nothing has."""
        if not self._sessions.is_current(session):
            return "The model was edited."
        return self._sessions.find_problem(session) or session.fault

    def add_result(self, task: Task, done: bool, reason: str, seconds: float = 0.0) -> None:
        """Tell the result of a task."""
        self._tell(str(task.object.coordinate), task.opening, done, reason, seconds)

    def _tell(self, what: str, opening: bool, done: bool, reason: str, seconds: float = 0.0) -> None:
        skill, note = "open" if opening else "close", self.note
        result = SkillResult(what, skill, done, reason, seconds)
        note.results = [*note.results, result][-_MOST_RESULTS:]
        note.done, note.failed = note.done + done, note.failed + (not done)
        note.last = (
            f"'{result.what}': {'' if done else 'not '}{skill}{'ed' if skill == 'open' else 'd'}. {reason}"
        )
        self._report(note)

    def _let_go(self, session: Session) -> bool:
        """Let go of what the hand may hold, as after a skill that was broken off; return if all is clear."""
        handle, is_away = self.scene.find_held(session), False
        if handle is None:
            if self.scene.is_hand_open(session):
                return True
            # It may hold what the model has no longer.
            handle, is_away = next(iter(self.scene.handles.values())), True
            self._say("opens the hand", "It may hold something.")
        else:
            self._say("lets go", f"The hand is at '{handle.frame}', as after a skill that was broken off.")
        run = SkillRun(session, handle.coordinate, _LETTING_GO)
        motion = self.scene.motion(run, handle, self.seed)

        def let_go() -> str:
            if is_away:
                motion.move_fingers(motion.gripper.opened)
                return "The hand is open."
            motion.let_go()
            return "The hand is away."

        self._acts = True
        try:
            outcome = run.perform(let_go)
        finally:
            self._acts = False
        if not outcome and self._find_interruption(session, session.model):
            return False
        if not is_away:
            self.note.last = f"let go of '{handle.frame}': {outcome.reason}"
        return True

    # -- what is told ----------------------------------------------------------------------------------------

    def _say(self, doing: str, why: str) -> None:
        note = self.note
        note.behaviour, note.doing, note.why = self.name, doing, why
        note.phase, note.way, note.wanted, note.vectors = "", b"", b"", {}
        self._report(note)

    def _search(self, text: str) -> None:
        self._stepped = -np.inf
        self.note.phase = f"searches {text}"
        self._report(self.note)

    def _look(self, session: Session) -> None:
        """Count a step, and report some; end a skill whose model was edited."""
        note, now = self.note, time.monotonic()
        gap = now - self._stepped if session.commands and session.phase == self._phase else 0.0
        note.steps += 1
        note.late += session.dt + _LATE < gap < _SEARCHED
        self._stepped, self._phase = now if session.commands else -np.inf, session.phase
        if note.steps % _SHOWN == 0:
            reference = session.reference
            note.phase = session.phase
            note.way = b"" if reference is None else np.ascontiguousarray(reference.ahead).tobytes()
            note.wanted = b"" if reference is None else np.ascontiguousarray(reference.pose).tobytes()
            note.vectors = {
                name: np.array([origin, vector], dtype=float).tobytes()
                for name, (origin, vector) in session.vectors.items()
            }
            self._report(note)
        if self._acts and self.heeds_edits and not self._sessions.is_current(session):
            raise SkillError("other", "The model was edited, so all is planned anew.")


class Furniture:
    """Objects of a session that a behaviour is about, with their handles."""

    def __init__(
        self, objects: tuple[ArticulatedObject, ...], handles: Mapping[str, Handle], gripper: Gripper | None
    ) -> None:
        self.objects, self.handles, self.gripper = objects, handles, gripper

    @classmethod
    def none(cls) -> Furniture:
        """Return none."""
        return cls((), {}, None)

    @classmethod
    def of(
        cls, session: Session, patterns: Iterable[str] | None, hand: str | None, missing_ok: bool = False
    ) -> Furniture:
        """Return the objects of some patterns, by default all but knobs; UnknownNameError for a wrong one."""
        model, robot = session.model, session.robot
        found = find_articulated_objects(model, None if robot.is_mechanism else robot)
        if patterns is None:
            chosen = tuple(one for one in found if one.kind != "knob")
        else:
            names = [str(one.coordinate) for one in found]
            wanted = [p for p in patterns if not missing_ok or any(matches_pattern(n, [p]) for n in names)]
            chosen = select_objects(found, wanted)
        handles = {}
        for one in found:
            try:
                handles[str(one.coordinate)] = find_handle(model, one.coordinate)
            except KineverseError:
                continue  # it can be pushed
        gripper = None
        if hand is not None or robot.grippers:
            gripper = robot.gripper(hand)
        return cls(chosen, handles, gripper)

    @cached_property
    def names(self) -> Mapping[str, ArticulatedObject]:
        """Objects by the name of their coordinate."""
        return {str(one.coordinate): one for one in self.objects}

    def motion(self, run: SkillRun, handle: Handle, seed: int = 0) -> HandMotion:
        """Return the motion of the hand at a handle."""
        assert self.gripper is not None
        session = run.session
        return HandMotion(run, Opener.of(session.robot, self.gripper, session.state), handle, seed)

    def find_held(self, session: Session) -> Handle | None:
        """Return the handle that the hand is at, or any one if the robot touches something; None if clear."""
        if self.gripper is None or not self.handles:
            return None
        opener = Opener.of(session.robot, self.gripper, session.state)
        for handle in self.handles.values():
            run = SkillRun(session, handle.coordinate, _LETTING_GO)
            if HandMotion(run, opener, handle).is_at_handle:
                return handle
        search = opener.search
        search.scene.update(session.state)
        touching = search.scene.watch(search.robot_bodies, search.others, 0.0)()
        if not len(touching):
            return None
        return next(iter(self.handles.values()))  # whose frame the way back is described in

    def is_hand_open(self, session: Session) -> bool:
        """Return whether the fingers are about as open as they can be, or are of no use."""
        if self.gripper is None or not self.handles:
            return True
        opened, closed, state = self.gripper.opened, self.gripper.closed, session.state
        return all(
            abs(opened[s] - state[s]) <= _AJAR * abs(opened[s] - closed[s]) for s in self.gripper.joints
        )

    def find_unseen(self, session: Session, one: ArticulatedObject) -> str:
        """Return why nothing is decided about an object; empty if it is seen."""
        unseen = session.time_unseen(one.coordinate)
        if np.isinf(unseen):
            return "has not been seen yet"
        if unseen > _UNSEEN:
            return f"has not been seen for {unseen:.0f} s"
        deviation = session.deviation(one.coordinate)
        return f"is known to within {deviation:.2g} only" if deviation > _UNKNOWN else ""

    def distance(self, session: Session, one: ArticulatedObject) -> float:
        """Return the distance of the robot to the handle of an object [m]."""
        handle, base = self.handles.get(str(one.coordinate)), session.robot.base
        if handle is None:
            return np.inf
        point = session.model.fk(handle.frame)(session.state)[:2, 3]
        here = np.zeros(2) if base is None else session.model.fk(base.child)(session.state)[:2, 3]
        return float(np.linalg.norm(point - here))


def tolerance_of(session: Session, one: ArticulatedObject, target: float) -> float:
    """Return the distance from a target within which an object is there [m], [rad]."""
    return choose_tolerance(session.model, one.coordinate, session.state, target)


class Closer(Behaviour):
    """Behaviour that closes whatever is open, for ever."""

    name = "closer"

    def choose(self, session: Session) -> Task | None:
        """Return the next object to close, the nearest of those that have failed the least."""
        best: tuple[tuple[int, float], Task] | None = None
        unseen: list[str] = []
        waiting: list[str] = []
        for name, one in self.scene.names.items():
            if why := self.scene.find_unseen(session, one):
                unseen.append(f"'{name}' {why}")
                continue
            value = float(session.state[one.coordinate])
            off = abs(value - one.shut)
            if off <= _OPEN * tolerance_of(session, one, one.shut) + session.deviation(one.coordinate):
                self.failures.pop(name, None)
                continue
            failure = self.failures.get(name)
            if failure is not None and abs(failure.value - value) < _MOVED and session.time < failure.until:
                rest = failure.until - session.time
                waiting.append(f"'{name}' is open, and tried again in {rest:.0f} s: {failure.reason}")
                continue
            tries = 0 if failure is None else failure.tries
            why = f"It is open by {off:.2f}." if not tries else f"It is still open; this is try {tries + 1}."
            by_push = name not in self.scene.handles or tries % 2 == 1
            rank = tries, self.scene.distance(session, one)
            if best is None or rank < best[0]:
                best = rank, Task(one, False, why, by_push)
        if best is not None:
            return best[1]
        texts = [*waiting, *unseen]
        if not self.scene.objects:
            texts = ["The model has none of the objects that were asked for."]
        more = f" And {len(texts) - 2} more." if len(texts) > 2 else ""
        self._wait("watches", (" ".join(texts[:2]) + more) or "All is shut.")
        return None

    def finish(self, task: Task, outcome: Outcome) -> None:
        """Tell the result."""
        self.add_result(task, outcome.done, outcome.reason, outcome.seconds)


class Agenda(Closer):
    """Behaviour that does some tasks one after the other, and tries each a few times."""

    def __init__(
        self, sessions: SessionSource, skills: Iterable[bool], *, rounds: int = 1, **options: Any
    ) -> None:
        super().__init__(sessions, **options)
        self._skills = tuple(skills) * rounds
        self._left: list[tuple[str, bool]] | None = None
        self._tries, self._unseen_since = 0, -np.inf

    def choose(self, session: Session) -> Task | None:
        """Return the next task of the agenda; afterwards what :meth:`go_on` says."""
        if self._left is None:
            self._left = [(name, opening) for name in self.scene.names for opening in self._skills]
        if not self._left:
            return self.go_on(session)
        name, opening = self._left[0]
        one = self.scene.names.get(name)
        if one is None:
            self._tell(name, opening, False, "The model has it no longer.")
            self._next()
            return None
        why = "It was asked for." if not self._tries else f"This is try {self._tries + 1}."
        task = Task(one, opening, why, far=self._far)
        if why := self.scene.find_unseen(session, one):
            if self._unseen_since < 0.0:
                self._unseen_since = session.time
            if session.time - self._unseen_since > _UNSEEN:
                self._give_up(task, f"'{name}' {why}.")
                return None
            self._wait("waits", f"'{name}' {why}.")
            return None
        self._unseen_since = -np.inf
        if abs(float(session.state[one.coordinate]) - task.target) <= tolerance_of(session, one, task.target):
            self.add_result(task, True, "It is there already.")
            self._next()
            return None
        failure = self.failures.get(name)
        if failure is not None and self._tries and session.time < failure.until:
            self._wait(
                "waits", f"'{name}' is tried again in {failure.until - session.time:.0f} s: {failure.reason}"
            )
            return None
        return task

    def _give_up(self, task: Task, reason: str) -> None:
        self.add_result(task, False, reason)
        self._next()

    def _next(self) -> None:
        assert self._left is not None
        self._left.pop(0)
        self._tries, self._unseen_since = 0, -np.inf

    def finish(self, task: Task, outcome: Outcome) -> None:
        """Go on with the next task, if this one is done or was tried often enough."""
        if not self._left:
            super().finish(task, outcome)
            return
        self._tries += 1
        if outcome or self._tries >= _TRIES:
            self.add_result(task, outcome.done, outcome.reason, outcome.seconds)
            self._next()

    def go_on(self, session: Session) -> Task | None:
        """Say that all is done."""
        self.is_done = True
        done, failed = self.note.done, self.note.failed
        self._say("has ended", f"{done} of {done + failed} done.")
        return None


class OpenByName(Agenda):
    """Behaviour that opens objects by name, and ends."""

    name = "open"

    def __init__(self, sessions: SessionSource, **options: Any) -> None:
        super().__init__(sessions, (True,), **options)


class CloseByName(Agenda):
    """Behaviour that closes objects by name, and ends."""

    name = "close"

    def __init__(self, sessions: SessionSource, **options: Any) -> None:
        super().__init__(sessions, (False,), **options)


class Tour(Agenda):
    """Behaviour that opens and closes each object once, and then closes whatever is open."""

    name = "tour"

    def __init__(self, sessions: SessionSource, **options: Any) -> None:
        super().__init__(sessions, (True, False), **options)

    def go_on(self, session: Session) -> Task | None:
        """Go on as a closer."""
        self.name = Closer.name
        return Closer.choose(self, session)
