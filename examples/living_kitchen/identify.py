"""Learning a joint while it moves: poses are kept, families weighed, and the best one becomes a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import kineverse as kv
from kineverse.estimation import Fit, IdentificationResult, ObservedPose, Outliers, Tracker, identify
from kineverse.model.frame import WORLD
from kineverse.view.triangle_mesh import Floats

from .gating import Sorter
from .sensor import Seen, Sight
from .unknown_mechanisms import BASE, PART

LEARNED = "stranger/learned"
"""The joint in the model that was learned."""

LOOKS, THINKS = 0.25, 1.0
"""How often a pose is kept, and how often all of them are weighed [s]."""

FEWEST, MOST = 4, 96
"""With how many poses the weighing begins, and from how many on every other one is forgotten."""

RESTLESS = 0.06
"""Of what was learned: the variance that a coordinate gains [m²/s], [rad²/s]."""

TOLD = ("revolute", "prismatic", "screw", "cylindrical", "rigid")
"""Families of which a model is made; what else moves is only watched."""


@dataclass(frozen=True, slots=True)
class Thought:
    """What was thought at a time [s]: the probability of each family."""

    time: float
    probabilities: dict[str, float]


class Learner:
    """Learns how a part moves on its base from poses of both, which nobody explains to it.

    Attributes
    ----------
    found
        What all poses so far say; None as long as there are too few.
    thoughts
        What was thought before, one for each time they were weighed.
    model
        Base and part, connected by what was learned; None as long as nothing is certain.
    tracker
        Of the joint that was learned, if it can move.
    """

    def __init__(self) -> None:
        self.found: IdentificationResult | None = None
        self.thoughts: list[Thought] = []
        self.model: kv.Model | None = None
        self.tracker: Tracker | None = None
        self._base: list[Floats] = []
        self._part: list[Floats] = []
        self._covariances: list[Floats] = []
        self._fk: Callable[[dict[str, float]], Floats] | None = None
        self._looked = self._thought = -np.inf
        self._sorter = Sorter()
        self._pace = LOOKS

    def step(self, seen: Seen, time: float, dt: float, sight: Sight) -> None:
        """Take in what was seen of base and part, in this order, ``dt`` after the last time [s]."""
        good = self._sorter.good(seen, dt, sight)
        if good.all() and time >= self._looked + self._pace:
            self._looked = time
            self._keep(seen, sight)
        if time >= self._thought + THINKS and len(self._part) >= FEWEST:
            self._thought = time
            self._think(time, sight)
        if self.tracker is not None:
            self.tracker.predict(dt)
            if seen.there[1]:
                self.tracker.update({PART: (seen.poses[1], sight.covariance)})

    def _keep(self, seen: Seen, sight: Sight) -> None:
        """Remember poses, and forget every other one where there are many: old ones say as much as new."""
        self._base.append(seen.poses[0])
        self._part.append(seen.poses[1])
        self._covariances.append(sight.covariance)
        if len(self._part) > MOST:
            self._base, self._part = self._base[::2], self._part[::2]
            self._covariances = self._covariances[::2]
            self._pace *= 2.0

    def _think(self, time: float, sight: Sight) -> None:
        covariances = np.array(self._covariances)
        base, part = np.array(self._base), np.array(self._part)
        self.found = identify(base, part, parent_covariance=covariances, child_covariance=covariances)
        self.thoughts.append(Thought(time, {fit.family: fit.probability for fit in self.found}))
        best = self.found.best
        if self.found.is_ambiguous or best.family not in TOLD:
            self.model = self.tracker = self._fk = None
            return
        # The base stands somewhere, which is learned in the same way.
        stands = identify(None, base, child_covariance=covariances, families=["rigid"]).best
        model = kv.Model()
        with model.edit() as edit:
            edit.apply(stands.operation(BASE, WORLD))
            edit.apply(best.operation(LEARNED, BASE, PART))
        self._follow(model, best, sight)

    def _follow(self, model: kv.Model, fit: Fit, sight: Sight) -> None:
        """Track with what was just learned, from where the part was seen last."""
        self.model, self.tracker, self._fk = model, None, kv.compile(model.fk(PART))
        names = [str(s) for s in model.degrees_of_freedom]
        if names:
            self.tracker = Tracker(
                model,
                [ObservedPose(PART)],
                start=dict(zip(names, fit.joint_values[-1].tolist(), strict=True)),
                process_noise={s.derivative(): RESTLESS for s in model.degrees_of_freedom},
                outliers=Outliers(sight.outliers) if sight.outliers else None,
            )

    @property
    def values(self) -> dict[str, float]:
        """Of the coordinates of the model that was learned, by name."""
        if self.tracker is None:
            return {}
        return {str(symbol): value for symbol, value in self.tracker.estimate.state.items()}

    @property
    def part(self) -> Floats | None:
        """Where the part is held to be, 4×4; None as long as nobody knows how it moves."""
        return None if self._fk is None else self._fk(self.values)

    @property
    def seen(self) -> Floats:
        """The places at which the part was seen (N, 3) [m]."""
        return np.array(self._part).reshape(-1, 4, 4)[:, :3, 3]

    @property
    def base(self) -> Floats:
        """Where the base is held to be; where it was seen last, while nothing is certain."""
        if self.model is not None:
            return np.asarray(self.model.fk(BASE)({}))
        return self._base[-1] if self._base else np.eye(4)
