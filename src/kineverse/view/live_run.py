"""Run of a skill on the page while it happens: the truth, the belief as a ghost, aims of the controller."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

import numpy as np

from kineverse.view.poses import FramePoses
from kineverse.view.run_drawing import RunDrawing, RunMoment, Vectors, find_arrows, format_contact_lines
from kineverse.view.run_layer import RunLayer
from kineverse.view.viewer import PERIOD, Viewer
from kineverse.worlds.recorder import RecordedStep

_MOST_ACTIVE = 4
_AHEAD = 0.02
"""Time by which commands are followed to find the velocity of the hand [s]."""


class LiveRun:
    """Callable for the steps of a session, which shows them on a page.

    It draws at most thirty times a second, and waits for the clock so that a world that is faster than real
    time can be watched. If the steps have a ``reference`` and a ``command``, as those of a
    :class:`kineverse.manipulation.session.Session`, the way of the hand and the active constraints are shown.
    """

    def __init__(self, page: Viewer, speed: float = 1.0, hand: str | None = None) -> None:
        self._page, self._speed, self._hand = page, speed, hand
        self._drawing = RunDrawing(page.model)
        self._layer = RunLayer(page.server, self._drawing, "run")
        self._poses = None if hand is None else FramePoses(page.model, [hand])
        self._drawn = self._begin = 0.0
        self.captions: Sequence[str] = ()

    def __call__(self, step: RecordedStep) -> None:
        """Show a step at the present time of its world."""
        now, world = time.monotonic(), step.world
        if self._speed:
            if not self._begin or world.time / self._speed < now - self._begin:
                self._begin = now - world.time / self._speed  # the world is late, or begins anew
            elif (early := world.time / self._speed - (now - self._begin)) > 0.0:
                time.sleep(min(early, 1.0))
                now = time.monotonic()
        if now - self._drawn >= PERIOD:
            self._drawn = now
            self._draw(step)

    def show_text(self, *lines: str) -> None:
        """Show lines of text below the captions, and no drawings, until the next step."""
        self._layer.draw(RunMoment({}, {}, [*self.captions, *lines]))

    def show_table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Show a table below the text."""
        self._layer.show_table(head, rows)

    def remove(self) -> None:
        """Remove everything of the run from the page."""
        self._layer.remove()

    def _draw(self, step: RecordedStep) -> None:
        world = step.world
        truth = world.state
        belief = step.state if step.state is not truth else None
        ghosts = {} if belief is None else self._drawing.find_ghosts(truth, belief)
        lines = [*self.captions, f"{world.time:.1f} s"] + ([f"phase: {step.phase}"] if step.phase else [])
        active = getattr(getattr(step, "command", None), "active", ())[:_MOST_ACTIVE]
        lines += [f"limited by {', '.join(active)}"] if active else []
        lines += format_contact_lines(world.contacts())
        reference = getattr(step, "reference", None)
        way, wanted = (None, None) if reference is None else (reference.ahead, reference.pose)
        vectors = {**(getattr(step, "vectors", None) or {}), **self._find_hand_velocity(step)}
        self._page.move(self._drawing.values(truth))
        self._layer.draw(RunMoment(ghosts, find_arrows(vectors), lines, way, wanted))

    def _find_hand_velocity(self, step: RecordedStep) -> Vectors:
        """Return the commanded velocity of the hand [m/s], with the hand as its origin."""
        if self._poses is None or not step.commands:
            return {}
        model, truth = self._page.model, step.world.state
        ends = [
            self._poses.evaluate(self._drawing.values(state))[0, :3, 3]
            for state in (truth, model.integrate(truth, step.commands, _AHEAD))
        ]
        return {"hand": (ends[0], np.subtract(ends[1], ends[0]) / _AHEAD)}
