"""Emergency stop of a page: a button above everything on it, and what it asks the world.

The button is HTML of its own beside the page's controls, and asks this process by plain requests: it is there
while the page loads, when the panel is folded, and when the connection of the page is broken, which it says.
A stop that the world has not confirmed is asked for again, also after the world was started anew.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any, Final

import msgspec

from kineverse.errors import KineverseError
from kineverse.exchange.state import StateReader

from .streams import ROBOT, RobotNote, ask, decode

_ANSWER = 1.0  # longest time until the world answers [s]
_NEWS = 0.1  # longest time until the robot's news say what has been done [s]
_SILENT = 0.5  # age of the robot's news from which on nobody knows what it does [s]
_HEARD = 2.5  # time for which a browser counts as one that looks [s]

STOP_PATH, RELEASE_PATH, STATE_PATH = "/robot/stop", "/robot/release", "/robot/state"


class RobotState(msgspec.Struct):
    """State of the robot, for the button."""

    robot: bool  # whether there is one at all
    stopped: str = ""  # why it takes no commands; empty if it does
    problem: str = ""


class EmergencyStop:
    """Emergency stop of the robot of a live system, for any number of browsers.

    The reader of the streams reaches the world without the model server. A stop is ``wanted`` until somebody
    releases it.
    """

    def __init__(self, reader: StateReader) -> None:
        self._reader, self.wanted = reader, False
        self._is_confirmed, self._ticks, self._asked = False, 0, 0.0
        self._problem = ""
        self._rates: list[tuple[float, float]] = []  # time of a report, and frames a second of the browser

    def stop(self) -> RobotState:
        """Stop the robot; if the world does not answer, :meth:`watch` asks again."""
        self._is_confirmed, self.wanted = False, True
        if self._send_stop():
            self._wait_until(lambda note: bool(note.stopped))
        return self.state

    def release(self) -> RobotState:
        """Let the robot take commands again."""
        self.wanted = False
        if self._ask("release"):
            self._wait_until(lambda note: not note.stopped)
        return self.state

    def watch(self) -> None:
        """Ask again for a stop that was not confirmed, or that a world started anew does not know."""
        note, age = self._read()
        if note is None or note.ticks < self._ticks:
            self._is_confirmed = False
        if note is None or age > _SILENT:
            return
        self._ticks = note.ticks
        if note.stopped:
            self._is_confirmed = True
        elif self._is_confirmed:
            self.wanted = False  # somebody else has released it
        elif self.wanted and time.monotonic() - self._asked > _ANSWER / 2:
            self._send_stop()

    @property
    def state(self) -> RobotState:
        """The state of the robot, which the button shows."""
        note, age = self._read()
        if note is None:
            return RobotState(self.wanted, problem="No robot is there." if self.wanted else "")
        silent = f"The world is silent for {age:.0f} s." if age > _SILENT else ""
        asked = "A stop is asked for." if self.wanted and not note.stopped else ""
        problem = " ".join(text for text in (silent, self._problem, asked) if text)
        return RobotState(True, note.stopped, problem)

    def answers(self) -> dict[str, Any]:
        """Return functions of a browser's frames a second, by path, that answer requests as JSON."""
        return {
            STOP_PATH: lambda rate: self._answer(rate, self.stop),
            RELEASE_PATH: lambda rate: self._answer(rate, self.release),
            STATE_PATH: lambda rate: self._answer(rate, lambda: self.state),
        }

    @property
    def slowest_rate(self) -> float:
        """Frames a second that the slowest browser draws; 0 if none looks."""
        now = time.monotonic()
        self._rates = [(at, rate) for at, rate in self._rates if now - at < _HEARD]
        return min((rate for _, rate in self._rates), default=0.0)

    def _answer(self, rate: str, function: Any) -> str:
        with contextlib.suppress(ValueError):  # the first report has none
            self._rates = [*self._rates[-99:], (time.monotonic(), max(float(rate), 1.0))]
        return msgspec.json.encode(function()).decode()

    def _send_stop(self) -> bool:
        self._asked = time.monotonic()
        return self._ask("stop")

    def _ask(self, do: str) -> bool:
        try:
            ask(self._reader, ROBOT, do, _ANSWER)
            self._problem = ""
        except KineverseError as error:
            self._problem = str(error)
        return not self._problem

    def _wait_until(self, is_so: Callable[[RobotNote], bool]) -> None:
        """Wait for a moment until the robot's news say so, for the answer to the browser."""
        end = time.monotonic() + _NEWS
        while (note := self._read()[0]) is not None and not is_so(note) and time.monotonic() < end:
            self._reader.wait(_NEWS)

    def _read(self) -> tuple[RobotNote | None, float]:
        newest = self._reader.newest(ROBOT)
        if newest is None:
            return None, 0.0
        return decode(newest.note, RobotNote), time.monotonic() - newest.arrival


OVERLAY: Final = """
<style>
#kineverse-stop { position: fixed; top: 12px; left: 12px; z-index: 10000; display: none; width: 11em;
  font: 15px/1.3 system-ui, sans-serif; }
#kineverse-stop button { display: block; width: 100%; border: 0; border-radius: 8px; cursor: pointer;
  font: inherit; font-weight: 700; box-shadow: 0 1px 6px #0006; }
#kineverse-stop .stop { background: #d6001c; color: #fff; padding: 1.1em .4em; font-size: 18px;
  border: 4px solid #ffd43b; }
#kineverse-stop .stop:active { background: #8f0013; }
#kineverse-stop .release { background: #fff; color: #1d3b2a; padding: .6em; margin-top: 6px; display: none; }
#kineverse-stop .line { background: #fffd; border-radius: 6px; margin-top: 6px; padding: 4px 8px;
  color: #8f0013; font-size: 13px; overflow-wrap: anywhere; }
#kineverse-stop .line:empty { display: none; }
#kineverse-stop.stopped .release { display: block; }
#kineverse-stop.stopped .stop { background: #8f0013; }
#kineverse-stop.lost .stop { background: #868e96; border-color: #495057; }
</style>
<div id="kineverse-stop" role="group" aria-label="robot">
<button class="stop" type="button">EMERGENCY STOP</button>
<button class="release" type="button">Release</button>
<div class="line" role="status"></div>
</div>
<script>
(() => {
  const box = document.getElementById("kineverse-stop");
  const [button, release, line] = ["stop", "release", "line"].map(name => box.querySelector("." + name));
  const base = location.pathname.replace(/\\/$/, "") + "/robot/";
  let frames = 0, begin = performance.now(), wanted = false;
  const count = () => { frames += 1; requestAnimationFrame(count); };
  requestAnimationFrame(count);
  const ask = async what => {
    const passed = (performance.now() - begin) / 1000;
    const rate = passed > .3 ? (frames / passed).toFixed(1) : "-";
    if (passed > .3) { frames = 0; begin = performance.now(); }
    try {
      const answer = await fetch(base + what, {
        headers: {"X-Kineverse": rate}, cache: "no-store", signal: AbortSignal.timeout(6000)});
      if (!answer.ok) throw new Error();
      const state = await answer.json();
      if (what === "stop") wanted = false;
      box.className = state.stopped ? "stopped" : "";
      box.style.display = state.robot ? "block" : "none";
      button.textContent = state.stopped ? "STOPPED" : "EMERGENCY STOP";
      line.textContent = [state.stopped, state.problem].filter(Boolean).join(". ");
    } catch {
      box.className = "lost";
      button.textContent = "NO CONNECTION";
      line.textContent = "This page does not reach the robot. " +
        (wanted ? "It goes on asking for a stop." : "Stop it elsewhere.");
    }
  };
  const poll = async () => {
    if (wanted || !document.hidden) await ask(wanted ? "stop" : "state");
    setTimeout(poll, 1000);
  };
  button.onclick = () => { wanted = true; button.textContent = "STOPPING"; ask("stop"); };
  release.onclick = () => { wanted = false; ask("release"); };
  poll();
})();
</script>
"""
"""Button, and the script behind it; it is hidden until there is a robot."""
