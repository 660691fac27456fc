"""The scene that lives, in numbers: what moves, what is seen, what is believed, and what is learned."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

import kineverse as kv

from .identify import Learner
from .sensor import Markers, Seen, Sight
from .track import Figures, Following, average
from .trajectory import Routine, smooth
from .unknown_mechanisms import STRANGERS, Stranger

KITCHEN = "kitchen"

SWING, GROWS = 5.0, 9.0
"""How long the stranger takes to and fro, and until it goes all its way [s]."""

STAYS = 40.0
"""After this time another stranger comes [s]."""

REMEMBERED = 2.0
"""Over how long figures are averaged [s]."""


class Life:
    """A kitchen that opens and shuts, a stranger that moves, and those who look at them through noise.

    Time passes only in :meth:`step`, and equal seeds and steps give equal lives.

    Parameters
    ----------
    seed
        Of all noise.
    sight
        How well things are seen at first.
    stranger
        The name of the first one, see :data:`.strangers.STRANGERS`.

    Attributes
    ----------
    kitchen
        The model, known to who tracks it.
    sight
        How well things are seen; set it whenever you like.
    time
        Since the beginning [s].
    truth
        The values of the kitchen's coordinates, by name.
    following, learner
        What is believed of the kitchen, and of the stranger.
    seen, now
        The last observations of the kitchen's markers, and how good the belief is since.
    stranger, position
        What moves without anybody knowing how, and the true position of its joint.
    poses, stranger_seen
        Of the stranger's base and part: the truth (2, 4, 4), and what was seen.
    """

    def __init__(self, seed: int = 0, sight: Sight | None = None, stranger: str = "chest") -> None:
        self.kitchen = kv.load(KITCHEN)
        self.sight = sight or Sight()
        self.time = 0.0
        self._seed = seed
        self._routine = Routine(self.kitchen)
        self.following = Following(self.kitchen, self.sight)
        self._markers = Markers(len(self.following.frames), seed)
        self._figures: deque[tuple[float, Figures]] = deque()
        self.meet(stranger)
        self.step(0.0)

    def meet(self, stranger: str | None = None) -> None:
        """Forget what was learned; another stranger comes, the next one if none is named.

        Raises
        ------
        UnknownNameError
            If there is no such stranger.
        """
        names = list(STRANGERS)
        if stranger is None:
            stranger = names[(names.index(self.stranger.name) + 1) % len(names)]
        elif stranger not in STRANGERS:
            hint = kv.errors.suggest(stranger, names, "stranger")
            raise kv.errors.UnknownNameError(f"There is no stranger '{stranger}'. {hint}")
        self.stranger: Stranger = STRANGERS[stranger]()
        self._met = self.time
        self.learner = Learner()
        # Sequences of its own: what is seen of the kitchen does not depend on who else is there.
        self._strange_markers = Markers(2, self._seed + 1)

    def step(self, dt: float) -> None:
        """Let time pass [s], look, and think."""
        self.time += dt
        self.truth = self._routine.at(self.time)
        poses = self.following.poses(self.truth)
        self.seen: Seen = self._markers.look(poses, self.time, self.sight)
        self.now = self.following.step(self.seen, self.truth, dt, self.sight)
        self._figures.append((self.time, self.now))
        while self._figures[0][0] < self.time - REMEMBERED:
            self._figures.popleft()
        if self.time >= self._met + STAYS:
            self.meet()
        self._move_stranger(dt)

    def _move_stranger(self, dt: float) -> None:
        since = self.time - self._met
        low, high = self.stranger.reach
        swing = smooth(since / GROWS) * (0.5 - 0.5 * math.cos(math.tau * since / SWING))
        self.position = low + swing * (high - low)
        self.poses = np.stack(self.stranger.poses(self.position))
        self.stranger_seen = self._strange_markers.look(self.poses, self.time, self.sight)
        self.learner.step(self.stranger_seen, self.time, dt, self.sight)

    @property
    def figures(self) -> Figures:
        """How good the belief about the kitchen was over the last two seconds."""
        return average([figures for _, figures in self._figures])

    @property
    def part_error(self) -> float | None:
        """How far the tracked part of the stranger is off [m]; None while it is not known how it moves."""
        part = self.learner.part
        return None if part is None else float(np.linalg.norm(part[:3, 3] - self.poses[1, :3, 3]))
