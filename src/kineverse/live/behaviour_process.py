"""Process of a behaviour: sessions over the streams of a live system, and what is done, told to everybody."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

from kineverse.exchange import LiveModel
from kineverse.manipulation import Session, SkillError

from .behaviours import Behaviour, CloseByName, Closer, Look, OpenByName, Tour
from .live_robot import LiveBelief, LiveRobot
from .streams import ACTIVITY, TICK, ActivityNote, encode
from .unknown_behaviour import OpenUnknown

BEHAVIOURS: Mapping[str, Callable[..., Behaviour]] = {
    one.name: one for one in (Closer, Tour, OpenByName, CloseByName, OpenUnknown)
}
"""Behaviours by name."""
_LAST = 0.1  # time in which the last note arrives [s]
_BEAT = 0.3  # time after which what is done is told again, as while a plan is made [s]


class LiveSessions:
    """Source of sessions with the robot of a live system, for :class:`.Behaviour`."""

    def __init__(self, live: LiveModel, robot: str) -> None:
        self._live, self._name = live, robot
        self._robot: LiveRobot | None = None
        self._belief: LiveBelief | None = None
        self._version = -1

    def open(self, on_step: Look, on_search: Callable[[str], object]) -> Session:
        """Return a session of the newest model, in place of the one before."""
        self.close()
        model = self._live.snapshot()
        self._version = model.version
        self._robot = LiveRobot(model, self._name, self._live.exchange)
        self._belief = LiveBelief(self._robot)
        return Session(self._robot, dt=TICK, belief=self._belief, on_step=on_step, on_search=on_search)

    def is_current(self, session: Session) -> bool:
        """Return whether the model of a session is still the newest."""
        return self._live.version == self._version

    def find_problem(self, session: Session) -> str:
        """Return why the robot takes no commands, or is not known well; empty if it does and is."""
        assert self._robot is not None
        assert self._belief is not None
        return self._robot.problem or self._belief.problem

    def rest(self, session: Session | None, seconds: float) -> None:
        """Let time pass [s] without a command, and read the sensors."""
        time.sleep(seconds)
        if session is not None:
            with suppress(SkillError):
                session.refresh()

    def close(self) -> None:
        """Send no commands any more."""
        if self._robot is not None:
            self._robot.close()
            self._robot = None


class BehaviourProcess:
    """Behaviour that moves the robot of a live system, and publishes what it does.

    Parameters
    ----------
    live
        The served model.
    robot
        Prefix of the robot's names.
    make
        Function that makes the behaviour of sessions and of a function that gets its notes.

    See Also
    --------
    kineverse.live.WorldProcess
    """

    def __init__(
        self,
        live: LiveModel,
        robot: str,
        make: Callable[[LiveSessions, Callable[[ActivityNote], object]], Behaviour],
    ) -> None:
        self._publisher = live.exchange.publisher(ACTIVITY, ())
        self._note, self._told, self._is_over = b"", 0.0, threading.Event()
        self._sessions = LiveSessions(live, robot)
        self.behaviour = make(self._sessions, self.tell)
        self.tell(self.behaviour.note)
        self._beating = threading.Thread(target=self._beat, daemon=True, name="activity")
        self._beating.start()

    def tell(self, note: ActivityNote) -> None:
        """Publish a note."""
        self._note = encode(note)
        self._put()

    def _put(self) -> None:
        self._told = time.monotonic()
        if not self._publisher.is_closed:
            self._publisher.put((), None, self._note)

    def _beat(self) -> None:
        """Tell the last note again while nothing is told, so that all see that this process lives."""
        while not self._is_over.wait(_BEAT):
            if time.monotonic() - self._told > _BEAT:
                self._put()

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Go on until it is over, or nothing is left to do."""
        self.behaviour.run(is_over)

    def close(self) -> None:
        """Stop the robot, and end the stream."""
        self._is_over.set()
        self._beating.join()
        self._put()
        time.sleep(_LAST)  # a stream that ends takes with it what is on its way
        self._sessions.close()
        self._publisher.close()
