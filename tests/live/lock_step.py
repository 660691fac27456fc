"""Sessions of a behaviour in lock step with a simulated world."""

from kineverse.errors import OfflineError, StoppedError
from kineverse.manipulation import Session
from robot_interface_proxy import InterfaceOnly


class Stoppable:
    """World whose robot takes no commands while its sessions have a problem."""

    def __init__(self, sessions):
        self._sessions = sessions

    def __getattr__(self, name):
        return getattr(self._sessions.world, name)

    def apply(self, speeds, duration, *, stamp=None):
        problem = self._sessions.problem
        self._sessions.world.apply({} if problem else speeds, duration, stamp=stamp)
        if problem:
            raise StoppedError(problem)


class LockStep:
    """Source of sessions with a world, whose problems and edits a test makes up."""

    def __init__(self, world, belief, dt=0.02):
        self.world, self.belief, self.dt = world, belief, dt
        self.problem, self.offline, self.version, self.opened = "", "", 0, 0
        self.on_step = lambda session: None
        self._version = 0

    def open(self, on_step, on_search):
        if self.offline:
            raise OfflineError(self.offline)
        self.opened, self._version = self.opened + 1, self.version

        def look(session):
            self.on_step(session)
            on_step(session)

        return Session(InterfaceOnly(Stoppable(self)), belief=self.belief, dt=self.dt, on_step=look)

    def is_current(self, session):
        return self._version == self.version

    def find_problem(self, session):
        return self.problem

    def rest(self, session, seconds):
        if session is not None and not self.problem:
            for _ in range(round(seconds / self.dt)):
                session.act({})
