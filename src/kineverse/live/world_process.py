"""World of a live system: a simulated robot in real time, which obeys fresh commands, and publishes readings.

Every tick lasts 10 ms by the clock of the computer. What comes too late is left out: a world that was held up
goes on from where it was, at the present time, and does not hurry.
"""

from __future__ import annotations

import logging
import math
import os
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from kineverse._checks import as_positive
from kineverse.errors import KineverseError, OfflineError
from kineverse.exchange import LiveModel
from kineverse.model.commits.follower import Follower, follow
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.worlds import ForceLimit, Sensors
from kineverse.worlds.simulated_world import ChangeableWorld

from .streams import (
    CAMERA,
    COMMANDS,
    OLDEST,
    ROBOT,
    TICK,
    TIMEOUT,
    TRUTH,
    CameraNote,
    CommandNote,
    Handler,
    RobotNote,
    answer_by,
    decode,
    encode,
)

_LATE = 0.005  # time after which a tick counts as late [s]
_KEPT_TICKS = 10  # ticks between two states in the file
_ANSWER = 2.0  # longest time until a tick has done what people ask for [s]
EMERGENCY = "emergency stop"
_LOG = logging.getLogger(__name__)


class _KeptState(msgspec.Struct):
    """State of a world in a file."""

    values: dict[str, float]  # by coordinate
    held: str | None = None  # body in the hand
    stopped: str = ""  # why the robot takes no commands


class WorldProcess:
    """World whose robot is moved by the newest commands of a model server's streams.

    Parameters
    ----------
    live
        The served model. Its edits are followed: the world is made anew from where everything is.
    make
        Function that makes the world of a model.
    start
        State at the beginning.
    timeout
        Age of the state of a command from which on the robot stops [s].
    kept
        File that keeps the true state; if there is one, the world begins in it.
    follows
        Whether edits of the served model change the world, too. False for a world with a model of its own.
    force_limit
        Force between the robot and another body beyond which the robot is stopped until it is released [N].

    Attributes
    ----------
    world
        The present world.
    stopped
        Why the robot takes no commands; empty if it does.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> server = kv.exchange.serve(model, name="doc-world")
    >>> live = kv.load(server.address)
    >>> make = lambda model: kv.worlds.KinematicWorld(model, "fetch")
    >>> process = kv.live.WorldProcess(live, make, model.default_state())
    >>> process.tick(0.02)
    >>> process.stop("a person is near")
    >>> process.stopped
    'a person is near'
    >>> process.close()
    >>> live.close()
    >>> server.close()
    """

    def __init__(
        self,
        live: LiveModel,
        make: Callable[[ModelView], ChangeableWorld],
        start: State,
        *,
        timeout: float = TIMEOUT,
        kept: str | os.PathLike[str] | None = None,
        follows: bool = True,
        force_limit: float | None = None,
    ) -> None:
        self._limit = None if force_limit is None else ForceLimit(force_limit)
        self._timeout = as_positive(timeout, "timeout=", "time in s, such as 0.04")
        self._live, self._kept = live, None if kept is None else Path(kept)
        self._follower: Follower[ChangeableWorld] | None = follow(live, make) if follows else None
        self.world = make(live.snapshot()) if self._follower is None else self._follower.value
        self._version = None if self._follower is None else self._follower.version
        self.stopped = self._kept_stop = ""
        self._ticks = self._late = self._dropped = self._refused = self._picture = 0
        self._command: tuple[float, int] = (-math.inf, -1)  # the last one that came, by stamp and number
        self._fingers: dict[str, float] = {}
        self._commanded = 0.0
        self._asked: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._restore(start)
        self._list_names()
        self._reader = live.exchange.reader()
        handlers: dict[str, Handler] = {
            "stop": self.stop,
            "release": self.release,
            "move": self._in_tick(self.move),
            "noise": self._in_tick(self.set_noise),
            "hide": self._in_tick(self.hide),
        }
        self._robot = live.exchange.publisher(ROBOT, self.world.robot.coordinates, answer=answer_by(handlers))
        self._camera = live.exchange.publisher(CAMERA, ())
        self._truth = live.exchange.publisher(TRUTH, self._symbols)
        self._first = self._epoch = time.monotonic()
        self._wall = time.time() - self._epoch  # from the clock that only counts to that of stamps [s]

    def _list_names(self) -> None:
        self._symbols = [s for s in self.world.model.symbols if not s.order]
        self._finger_names = {
            str(s.derivative()) for gripper in self.world.robot.grippers for s in gripper.joints
        }
        self._speed_names = {str(v) for v in self.world.robot.speeds}
        self._rest = dict.fromkeys(self._finger_names, 0.0)

    # -- what is asked ---------------------------------------------------------------------------------------

    def stop(self, why: str = EMERGENCY) -> None:
        """Stop the robot until it is released."""
        self.stopped = why

    def release(self) -> None:
        """Let the robot take commands again."""
        self.stopped = ""
        if self._limit is not None:
            self._limit.release()

    def move(self, coordinate: str, value: float) -> None:
        """Move furniture in truth as a person does, with the errors of :meth:`.ChangeableWorld.displace`."""
        self.world.displace({coordinate: value})

    def set_noise(self, text: str) -> None:
        """Change the noise of the sensors; the text is that of :meth:`.Sensors.parse`, or none."""
        sensors = Sensors() if text == "none" else Sensors.parse(text)
        self.world.sensors = replace(sensors, hidden=self.world.sensors.hidden)

    def hide(self, frames: list[str]) -> None:
        """Cover the markers of some frames, and no others."""
        self.world.sensors = replace(self.world.sensors, hidden=frozenset(frames))

    def _in_tick(self, change: Callable[..., None]) -> Handler:
        """Return a function that has the next tick do a change, and waits for it."""

        def ask(**arguments: Any) -> None:
            done: Future[None] = Future()
            self._asked.put((lambda: change(**arguments), done))
            try:
                done.result(_ANSWER)
            except TimeoutError:
                raise OfflineError("The world does not answer: its time stands still.") from None

        return ask

    def _do_what_is_asked(self) -> None:
        while not self._asked.empty():
            change, done = self._asked.get()
            try:
                change()
            except Exception as error:  # that of whoever has asked
                done.set_exception(error)
            else:
                done.set_result(None)

    # -- ticks -----------------------------------------------------------------------------------------------

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Run in real time until it is over."""
        due = time.monotonic() + TICK
        while not is_over():
            now = time.monotonic()
            if now < due:
                time.sleep(due - now)
                now = time.monotonic()
            late = now - due
            self._late += late > _LATE
            if late > TICK:
                missed = math.floor(late / TICK)
                self._dropped += missed
                due += missed * TICK
            self.tick(due + self._wall)
            due += TICK

    def tick(self, now: float) -> None:
        """Advance by one tick to a time [s], and publish the readings."""
        self._follow()
        self._do_what_is_asked()
        speeds = self._choose_speeds(now)
        self._commanded = max((abs(v) for s, v in speeds.items() if s not in self._finger_names), default=0.0)
        self.world.apply(speeds, TICK)
        if self._limit is not None and self._limit.watch(self.world.peak_force, TICK) and not self.stopped:
            self.stop(f"protective stop, {self._limit.peak:.0f} N of at most {self._limit.limit:g} N")
        self._ticks += 1
        self._publish(now)
        if self._kept is not None and (self._ticks % _KEPT_TICKS == 0 or self.stopped != self._kept_stop):
            self._keep()

    def _choose_speeds(self, now: float) -> dict[str, float]:
        """Return the speeds of the newest command, unless it is too old; fingers then close no further."""
        newest = self._reader.newest(COMMANDS)
        note = None if newest is None else decode(newest.note, CommandNote)
        if newest is None or note is None or self.stopped:
            return self._rest
        arrived = now - (time.monotonic() - newest.arrival)
        if note.stamped:
            until = newest.stamp + self._timeout
            if (command := (newest.stamp, note.number)) != self._command:
                self._command = command
                self._refused += now - newest.stamp > OLDEST
        else:
            until = arrived + max(note.duration, TICK)
        if not now < until + 1e-9 or newest.stamp > now + TICK:
            return self._rest
        speeds = newest.named
        for k in note.kept:
            speeds[newest.names[k]] = self._fingers.get(newest.names[k], 0.0)
        self._fingers = {name: speeds[name] for name in self._finger_names if name in speeds}
        return {name: value for name, value in speeds.items() if name in self._speed_names}

    def _publish(self, now: float) -> None:
        world, observation = self.world, self.world.observe()
        coordinates = world.robot.coordinates
        stamp = now + observation.stamp - world.time
        passed = time.monotonic() - self._first
        note = RobotNote(
            world.name, self._timeout, sorted(observation.touching), self.stopped, world.peak_force,
            self._commanded, self._refused, self._late, self._dropped, self._ticks,
            self._ticks * TICK / max(passed, TICK),
        )  # fmt: skip
        self._robot.put([observation.joints[s] for s in coordinates], stamp, encode(note))
        if observation.poses:
            self._picture += 1
            shown = CameraNote.make(self._picture, observation.poses)
            self._camera.put((), now + observation.picture_stamp - world.time, encode(shown))
        self._truth.put(world.state.vector(self._symbols), now)

    # -- edits, and what is kept -----------------------------------------------------------------------------

    def _follow(self) -> None:
        """Go on in the world of an edited model, once it is made."""
        if self._follower is None or self._follower.version == self._version:
            return
        before, world = self._symbols, self.world
        made, self._version = self._follower.current
        try:
            made.take_over(world)
        except KineverseError as error:
            _LOG.warning("The world goes on without an edit of the model: %s", error)
            return
        self.world = made
        self._list_names()
        if before != self._symbols:
            self._truth.set_coordinates(self._symbols)

    def _keep(self) -> None:
        assert self._kept is not None
        values = {str(s): float(v) for s, v in self.world.state.items() if math.isfinite(v)}
        part = self._kept.with_suffix(".part")
        self._kept_stop = self.stopped
        part.write_bytes(msgspec.msgpack.encode(_KeptState(values, self.world.held, self._kept_stop)))
        part.replace(self._kept)

    def _restore(self, start: State) -> None:
        """Begin in the state that was kept, or in the one at the beginning."""
        self.world.reset(start)
        if self._kept is None or not self._kept.is_file():
            return
        try:
            kept = msgspec.msgpack.decode(self._kept.read_bytes(), type=_KeptState)
        except (msgspec.MsgspecError, OSError) as error:
            raise KineverseError(f"{self._kept} holds no state: {error}.") from None
        self.stopped = self._kept_stop = kept.stopped
        known = {str(s): s for s in self.world.model.symbols}
        values = {known[name]: value for name, value in kept.values.items() if name in known}
        state = State({**start, **values}, stamp=0.0)
        try:
            self.world.resume(state, kept.held)
        except KineverseError:  # such as without the body that was held
            self.world.reset(state)

    def close(self) -> None:
        """End the streams."""
        for one in (self._robot, self._camera, self._truth, self._reader):
            one.close()
        if self._follower is not None:
            self._follower.close()
