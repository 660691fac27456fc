"""Opening of what nobody has described: a hand pulls, a learner writes the joint, and it is closed by name.

The behaviour keeps what it learns for itself, for the pull alone. What everybody knows is the served model:
it closes the part once a learner has written a joint for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.grasping import find_handle
from kineverse.grasping.finger_branches import path_to_root
from kineverse.manipulation import ArticulatedObject, Outcome, Session, open_unknown
from kineverse.manipulation.articulated_objects import find_shut_value
from kineverse.manipulation.unknown_objects import forget_joint
from kineverse.manipulation.unknown_objects.unmodelled_joint import free_part
from kineverse.model.model import Model, Snapshot
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol, position

from .behaviours import Behaviour, Furniture, SessionSource, Task, tolerance_of

_LEARNING = 20.0  # longest time until a joint that was pulled is in the model [s]
_TRIES = 3  # of a part
_SHUT = 0.02  # largest distance from where a part was at first at which it counts as shut [m], [rad]


class UnknownScene(NamedTuple):
    """Model that does not have the joint of a part."""

    model: Model  # to be served; the one it was made of is the truth
    part: str  # frame of the part
    handle: str  # frame of the body of its handle


def make_unknown_scene(truth: Model, what: str, state: State | None = None) -> UnknownScene:
    """Return a model in which nobody has described what a coordinate moves: its part is fixed where it is.

    Parameters
    ----------
    truth
        Model that has the joint.
    what
        Name of its coordinate, such as ``kitchen/fridge_door``.
    state
        Where everything is; by default the default state.

    Raises
    ------
    UnknownNameError, InvalidValueError
        If there is no such coordinate, or no joint of its own moves a part, or the part has no handle.

    Examples
    --------
    >>> scene = kv.live.make_unknown_scene(kv.load("shelf_door"), "shelf_door/door")
    >>> scene.model.degrees_of_freedom
    ()
    """
    coordinate = truth.symbol(what)
    part = next((a.child for a in truth.articulations.values() if coordinate in a.coordinates), None)
    if part is None:
        movable = [str(s) for a in truth.articulations.values() for s in a.coordinates]
        raise InvalidValueError(
            f"No joint of its own moves '{what}', so none can be unknown. {suggest(what, movable, 'object')}"
        )
    handle = find_handle(truth, coordinate).frame
    return UnknownScene(forget_joint(truth, part, state or truth.default_state()), part, handle)


class OpenUnknown(Behaviour):
    """Behaviour that opens parts without a joint, waits for the learner, closes them by name, and ends.

    See Also
    --------
    kineverse.live.make_unknown_scene
    """

    name = "unknown"
    overlap = 0.01  # a joint that was learned is off by millimetres
    in_thread = True  # joints are fitted while the robot moves on
    heeds_edits = False  # the learner edits the model in the middle of a pull

    def __init__(
        self, sessions: SessionSource, *, patterns: Iterable[str] | None = None, **options: object
    ) -> None:
        super().__init__(sessions, **options)  # type: ignore[arg-type]
        self._left = list(patterns or ())
        if not self._left:
            raise InvalidValueError("What is unknown has no name of its own: name the frame of a part.")
        self._pulled: dict[str, float] = {}  # times at which parts were opened [s]
        self._tries: dict[str, int] = {}

    def choose(self, session: Session) -> Task | None:
        """Open the next part, or return the closing of one whose joint was learned."""
        if not self._left:
            self.is_done = True
            self._say("has ended", f"{self.note.done} of {self.note.done + self.note.failed} done.")
            return None
        part, model = self._left[0], session.model
        if part not in model.frames:
            raise UnknownNameError(f"There is no part '{part}'. {suggest(part, model.frames, 'frame')}")
        coordinate = find_coordinate(model, part)
        if coordinate is None:
            if part not in self._pulled:
                self._open(session, part)
            elif session.time - self._pulled[part] < _LEARNING:
                self._wait("waits", f"Its learner has not written the joint of '{part}' yet.")
            else:
                why = "it was opened, but no learner has written its joint into the model."
                self._end(part, False, f"'{part}' cannot be closed by name: {why}")
            return None
        shut = find_shut_value(model, coordinate)
        one = ArticulatedObject(coordinate, "door", shut, float(session.state[coordinate]))
        if why := self.scene.find_unseen(session, one):
            self._wait("waits", f"'{coordinate}' {why}.")
            return None
        if abs(one.opened - shut) <= max(_SHUT, tolerance_of(session, one, shut)):
            self._left.pop(0)
            return None
        return Task(one, False, "Its joint is in the model now.")

    def _keep_session(self) -> Session | None:
        """Return a session whose scene has the handles of parts that were learned."""
        before, session = self.session, super()._keep_session()
        if session is None or session is before:
            return session
        handles = dict(self.scene.handles)
        for part in self._left:
            coordinate = find_coordinate(session.model, part) if part in session.model.frames else None
            if coordinate is not None:
                with suppress(KineverseError):  # without a handle, it was not opened either
                    handles[str(coordinate)] = find_handle(session.model, coordinate)
        self.scene = Furniture(self.scene.objects, handles, self.scene.gripper)
        return session

    def finish(self, task: Task, outcome: Outcome) -> None:
        """Tell the result of a closing; one that has failed is tried again."""
        part = self._left[0]
        self._tries[part] = self._tries.get(part, 0) + 1
        if outcome or self._tries[part] >= _TRIES:
            self.add_result(task, outcome.done, outcome.reason, outcome.seconds)
            self._left.pop(0)

    def _open(self, session: Session, part: str) -> None:
        """Open a part by pulling at its handle, and learning how it moves."""
        given = session.model
        model = given.model() if isinstance(given, Snapshot) else given
        assert isinstance(model, Model)
        try:
            handle = find_bar(model, part, session.state)
        except KineverseError as error:
            self._end(part, False, str(error))
            return
        self._say(f"opens '{part}'", "Nobody has described how it moves; the hand pulls and follows.")
        outcome = open_unknown(
            session, handle, model=model, part=part, hand=self.scene.gripper, seconds=self._seconds,
            seed=self.seed + self._tries.get(part, 0), in_thread=self.in_thread,
        )  # fmt: skip
        self._tries[part] = tries = self._tries.get(part, 0) + 1
        self._is_hand_checked = bool(outcome)
        if outcome:
            self._pulled[part], self._tries[part] = session.time, 0
            self.add_result(_opening(part), True, outcome.reason, outcome.seconds)
        elif tries >= _TRIES:
            self._end(part, False, outcome.reason)
        else:
            self.note.last = f"'{part}' was not opened: {outcome.reason}"

    def _end(self, part: str, done: bool, reason: str) -> None:
        self.add_result(_opening(part), done, reason)
        self._left.pop(0)


def _opening(part: str) -> Task:
    return Task(ArticulatedObject(position(part), "door", 0.0, math.inf), True, "")


def find_coordinate(model: ModelView, part: str) -> Symbol | None:
    """Return the only coordinate that moves a part in the world; None without one, or if it has several."""
    symbols = model.fk(part).symbols
    return next(iter(symbols)) if len(symbols) == 1 else None


def find_bar(model: Model, part: str, state: State) -> str:
    """Return the body of a part, or on it, that a hand closes around; UnknownNameError if there is none."""
    on_it = [f for f in model.bodies if part in path_to_root(model, f) and not model.fk(f, part).symbols]
    for frame in sorted(on_it, key=lambda f: -len(path_to_root(model, f))):
        try:
            free_part(model, part, frame, state)
        except UnknownNameError:
            continue
        return frame
    raise UnknownNameError(f"'{part}' has no handle that a hand could close around.")
