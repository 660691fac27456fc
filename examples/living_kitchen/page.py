"""Page of the simulation in the browser."""

from __future__ import annotations

import logging
import threading
import time

from kineverse.errors import KineverseError
from kineverse.view import server as web
from kineverse.view.viewer import PANEL_WIDTH

from .panel import Panel
from .scene import SceneDrawables
from .simulation import Simulation
from .viser_scene import SceneNodes

logger = logging.getLogger(__name__)

PERIOD = 1.0 / 12.0
"""Least time between two frames [s]."""

BUSY_FRACTION = 0.5
"""Largest fraction of the time in which the page computes; the rest is left to the browser."""

LONGEST_STEP = 0.2
"""The longest time step of the simulation [s]; slower frames slow it down."""

REPORT_PERIOD = 0.4
"""Time between two reports in the panel [s]."""


class SimulationPage:
    """Web page that runs and shows a simulation.

    The simulation runs while a browser shows the page, and pauses otherwise. Use it as a context, or call
    :meth:`stop`.

    Parameters
    ----------
    simulation
        The simulation to run; a new one if None.
    port
        The port, 0 for any free one; None for 8080 or any free one.
    label
        The title of the page.
    host
        The address to listen on, as that of a :class:`kineverse.view.viewer.Viewer`.

    Raises
    ------
    MissingDependencyError
        If viser is not installed.
    InvalidValueError
        If the port is taken or none.
    """

    def __init__(
        self,
        simulation: Simulation | None = None,
        *,
        port: int | None = None,
        label: str = "Kineverse",
        host: str = web.HOST,
    ) -> None:
        self._server = web.start(port, label, host)
        try:
            self.simulation = simulation or Simulation()
            gui = self._server.gui
            gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(34, 104, 172))
            gui.main_panel.dock_right()
            gui.main_panel.set_width(PANEL_WIDTH)
            self._drawables = SceneDrawables(self.simulation)
            self._nodes = SceneNodes(self._server, self._drawables)
            self._requested: str | None = None
            self._panel = Panel(gui, self.simulation, self._request_mechanism)
        except BaseException:
            web.stop(self._server)
            raise
        self._reported = 0.0
        self._stopping, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="kineverse-living", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """The address of the page."""
        return str(self._server.address)

    def wait(self) -> None:
        """Keep the page up until :meth:`stop` or Ctrl-C; an error after that."""
        if self._stopping.is_set():
            raise KineverseError(web.TAKEN_DOWN)
        # A wait without a limit cannot be interrupted on every platform.
        while not self._ended.wait(timeout=0.5):
            pass

    def stop(self) -> None:
        """Take the page down; further calls do nothing."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._thread.join(timeout=5.0)
        web.stop(self._server)
        self._ended.set()

    def __enter__(self) -> SimulationPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _request_mechanism(self, mechanism: str) -> None:
        """Store a request for another mechanism, which is served between two steps."""
        self._requested = mechanism

    def _work(self) -> None:
        """Run the simulation until :meth:`stop`."""
        last, took = time.monotonic(), 0.0
        while not self._stopping.wait(max(PERIOD - took, took * (1.0 / BUSY_FRACTION - 1.0))):
            now = time.monotonic()
            passed, last = min(now - last, LONGEST_STEP), now
            try:
                if self._server.get_clients():
                    self._advance(passed)
            except Exception:
                # The thread survives an error of one step.
                logger.exception("the scene could not go on")
            took = time.monotonic() - now

    def _advance(self, passed: float) -> None:
        requested, self._requested = self._requested, None
        if requested is not None:
            self.simulation.change_mechanism(requested)
        speed = self._panel.speed
        self.simulation.sensor = self._panel.sensor
        if speed or requested is not None:
            self.simulation.step(speed * passed)
            if self.simulation.mechanism is not self._drawables.known_mechanism:
                self._drawables.change_mechanism()
            self._nodes.update()
        now = time.monotonic()
        if now >= self._reported + REPORT_PERIOD:
            self._reported = now
            self._panel.update()
