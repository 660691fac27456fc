"""A thread that looks at what is near, so that sliders need not wait for it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from kineverse.errors import KineverseError
from kineverse.model.view import ModelView
from kineverse.view.near import RADIUS, Near, Nearness

logger = logging.getLogger(__name__)

PERIOD = 1.0 / 20.0
"""Least time between two looks [s]."""

SHARE = 3.0
"""How many times as long as a look took is waited for the next one: python threads slow each other down."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to look for: whether at all, within what radius [m], names containing what, what else.

    ``ignored``: also pairs that are not looked at. ``decomposed``: meshes as the hulls of their parts.
    """

    on: bool = False
    radius: float = RADIUS
    containing: str = ""
    ignored: bool = False
    decomposed: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """What was seen last: what is near, why bodies and shapes are left out, and what went wrong if it did."""

    nearness: Nearness | None = None
    problems: Mapping[str, str] | None = None
    failure: str = ""


class Watch:
    """Looks at the newest values whenever there are some, and hands on what it sees.

    Parameters
    ----------
    model
        The model.
    values
        The values of all symbols at first, by name [m], [rad].
    show
        Called by the thread with what it sees; nothing of it while nothing is wanted.
    """

    def __init__(self, model: ModelView, values: Mapping[str, float], show: Callable[[Seen], None]) -> None:
        self._model, self._values, self._show = model, dict(values), show
        self._wanted = Wanted()
        self._near: Near | None = None
        self._edited = False
        self._asked, self._done, self._stopping = 0, 0, False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="kineverse-near", daemon=True)
        self._thread.start()

    @property
    def wanted(self) -> Wanted:
        """What it looks for."""
        return self._wanted

    def look_for(self, wanted: Wanted) -> None:
        """Look for something else from now on."""
        with self._change:
            if wanted != self._wanted:
                self._wanted = wanted
                self._ask()

    def update(self, values: Mapping[str, float], edited: bool = False) -> None:
        """Look at other values, and if it was edited, at a model that has changed."""
        with self._change:
            self._values = dict(values)
            self._edited |= edited
            if self._wanted.on:
                self._ask()

    def settled(self, timeout: float) -> bool:
        """Wait at most ``timeout`` [s] for all that was asked for; return whether it was seen."""
        with self._change:
            return self._change.wait_for(lambda: self._done >= self._asked, timeout)

    def stop(self) -> None:
        """End the thread."""
        with self._change:
            self._stopping = True
            self._change.notify_all()
        self._thread.join(timeout=5.0)

    def _ask(self) -> None:
        self._asked += 1
        self._change.notify_all()

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._stopping or self._asked > self._done)
                if self._stopping:
                    return
                asked, values, wanted = self._asked, self._values, self._wanted
                edited, self._edited = self._edited and wanted.on, self._edited and not wanted.on
            begin = time.monotonic()
            try:
                self._show(self._look(values, wanted, edited))
            except Exception:
                # The page may be going away, and the thread outlives whatever it is shown.
                logger.exception("what is near could not be shown")
            took = time.monotonic() - begin
            with self._change:
                self._done = max(self._done, asked)
                self._change.notify_all()
                self._change.wait_for(lambda: self._stopping, timeout=max(PERIOD, SHARE * took))

    def _look(self, values: Mapping[str, float], wanted: Wanted, edited: bool) -> Seen:
        if not wanted.on:
            return Seen()
        try:
            if self._near is None or self._near.decomposed != wanted.decomposed:
                self._near = Near(self._model, wanted.decomposed)
            elif edited:
                self._near.follow()
            found = self._near.at(values, wanted.radius, containing=wanted.containing, ignored=wanted.ignored)
            return Seen(found, self._near.problems)
        except KineverseError as error:
            return Seen(failure=str(error))
        except Exception as error:
            logger.exception("no distances")
            return Seen(failure=f"{type(error).__name__}: {error}")
