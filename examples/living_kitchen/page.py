"""The scene that lives, in the browser."""

from __future__ import annotations

import logging
import threading
import time

from kineverse.errors import KineverseError
from kineverse.view import server as web

from .panel import Panel
from .scene import Scenery
from .simulation import Life
from .viser_scene import Stagehand

logger = logging.getLogger(__name__)

PERIOD = 1.0 / 12.0
"""Least time between two moments that are shown [s]."""

SHARE = 0.5
"""The part of the time in which the page thinks at most: the rest is for whoever shows it."""

LONGEST = 0.2
"""The longest step of the scene [s]; what took longer is not made up for."""

REPORTED = 0.4
"""Time between two reports in the panel [s]."""

WIDTH = 380
"""Width of the controls [pixels]."""


class LivingPage:
    """A life on a web page of this computer.

    It goes on while somebody looks, and waits while nobody does. Use it as a context, or call :meth:`stop`.

    Parameters
    ----------
    life
        What is shown, and moved on from now on; one of its own if None.
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
        life: Life | None = None,
        *,
        port: int | None = None,
        label: str = "Kineverse",
        host: str = web.HOST,
    ) -> None:
        self._server = web.start(port, label, host)
        try:
            self.life = life or Life()
            gui = self._server.gui
            gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(34, 104, 172))
            gui.main_panel.dock_right()
            gui.main_panel.set_width(WIDTH)
            self._scenery = Scenery(self.life)
            self._stage = Stagehand(self._server, self._scenery)
            self._wanted: str | None = None
            self._panel = Panel(gui, self.life, self._meet)
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
        """Keep the page up until :meth:`stop` or Ctrl-C; without a page this is an error."""
        if self._stopping.is_set():
            raise KineverseError(web.TAKEN_DOWN)
        # A wait without a limit cannot be interrupted on every platform.
        while not self._ended.wait(timeout=0.5):
            pass

    def stop(self) -> None:
        """Take the page down; calling it again does nothing."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._thread.join(timeout=5.0)
        web.stop(self._server)
        self._ended.set()

    def __enter__(self) -> LivingPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _meet(self, stranger: str) -> None:
        """Note that somebody wants another stranger; it comes between two steps."""
        self._wanted = stranger

    def _work(self) -> None:
        """Let the scene live until told to stop."""
        last, took = time.monotonic(), 0.0
        while not self._stopping.wait(max(PERIOD - took, took * (1.0 / SHARE - 1.0))):
            now = time.monotonic()
            passed, last = min(now - last, LONGEST), now
            try:
                if self._server.get_clients():
                    self._go_on(passed)
            except Exception:
                # The thread outlives whatever one moment does to it.
                logger.exception("the scene could not go on")
            took = time.monotonic() - now

    def _go_on(self, passed: float) -> None:
        wanted, self._wanted = self._wanted, None
        if wanted is not None:
            self.life.meet(wanted)
        speed = self._panel.speed
        self.life.sight = self._panel.sight
        if speed or wanted is not None:
            self.life.step(speed * passed)
            if self.life.stranger is not self._scenery.known_stranger:
                self._scenery.meet()
            self._stage.update()
        now = time.monotonic()
        if now >= self._reported + REPORTED:
            self._reported = now
            self._panel.update()
