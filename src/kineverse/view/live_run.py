"""Run of a skill on the page while it happens: the truth, the belief as a ghost, arrows of the controller."""

from __future__ import annotations

import time

from kineverse.view.run_drawing import RunDrawing, RunMoment, find_arrows, format_contact_lines
from kineverse.view.run_layer import RunLayer
from kineverse.view.viewer import PERIOD, Viewer
from kineverse.worlds.recorder import RecordedStep


class LiveRun:
    """Callable for the steps of a session, which shows them on a page.

    It draws at most thirty times a second, and waits for the clock so that a world that is faster than real
    time can be watched.

    Parameters
    ----------
    page
        Page of the world's model.
    speed
        Time of the world per time of the clock, at most; 0 not to wait.
    """

    def __init__(self, page: Viewer, speed: float = 1.0) -> None:
        self._page, self._speed = page, speed
        self._drawing = RunDrawing(page.model)
        self._layer = RunLayer(page.server, self._drawing, "run")
        self._drawn = self._begin = 0.0

    def __call__(self, step: RecordedStep) -> None:
        """Show a step at the present time of its world."""
        now, world = time.monotonic(), step.world
        if self._speed:
            if not self._begin or world.time / self._speed < now - self._begin:
                self._begin = now - world.time / self._speed  # the world is late, or begins anew
            elif (early := world.time / self._speed - (now - self._begin)) > 0.0:
                time.sleep(min(early, 1.0))
                now = time.monotonic()
        if now - self._drawn < PERIOD:
            return
        self._drawn = now
        truth = world.state
        belief = step.state if step.state is not truth else None
        ghosts = {} if belief is None else self._drawing.find_ghosts(truth, belief)
        lines = [f"{world.time:.1f} s"] + ([f"phase: {step.phase}"] if step.phase else [])
        lines += format_contact_lines(world.contacts())
        self._page.move(self._drawing.values(truth))
        self._layer.draw(RunMoment(ghosts, find_arrows(getattr(step, "vectors", None) or {}), lines))

    def remove(self) -> None:
        """Remove ghost, arrows and text from the page."""
        self._layer.remove()
