"""What is near to what at a state: the collision scene of a model, asked for people to look at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from kineverse.geometry import Closest, Rule, Scene
from kineverse.geometry.left_out import RIGID, Ignored, remarks, unusable
from kineverse.model.view import ModelView
from kineverse.state import State

RADIUS = 0.1
"""Within what distance pairs are shown unless somebody says otherwise [m]."""

MOST = 40
"""Pairs that are shown: more than these are counted, not drawn."""


@dataclass(frozen=True, slots=True)
class Nearness:
    """What was found at a state.

    Attributes
    ----------
    radius
        Within what distance was looked [m].
    pairs
        The nearest pairs, nearest first, at most :data:`MOST` of them.
    found, touching
        How many pairs there are within the radius, and how many of them touch or penetrate.
    ignored
        Pairs within the radius that are not looked at although they can move with respect to each other, with
        the reason, nearest first; at most :data:`MOST`.
    looked_at, not_looked_at
        How many pairs of bodies there are of either kind.
    """

    radius: float
    pairs: Sequence[Closest] = ()
    found: int = 0
    touching: int = 0
    ignored: Sequence[tuple[Closest, str]] = field(default=())
    looked_at: int = 0
    not_looked_at: int = 0


class Near:
    """Distances in a model, for one thread; shapes that cannot be used are left out.

    Parameters
    ----------
    model
        The model; after an edit :meth:`follow` has to be called.
    decomposed
        Whether meshes are the hulls that they were decomposed into, as far as they were.

    Attributes
    ----------
    problems
        Why bodies, or shapes of bodies, are left out, by what people call them.

    Raises
    ------
    MissingExtraError
        If the extra ``geometry`` is not installed.
    """

    def __init__(self, model: ModelView, decomposed: bool = False) -> None:
        self._model = model
        self.decomposed = decomposed
        self._make()

    def _make(self) -> None:
        self._unusable = unusable(self._model)
        self.problems = remarks(self._model, self._unusable)
        self._scene = self._scene_with(())
        self._all: Scene | None = None
        self._ignored = Ignored(self._model, self._scene.bodies)

    def _scene_with(self, rules: Iterable[Rule]) -> Scene:
        decomposed = ("*",) if self.decomposed else ()
        return Scene(self._model, rules=rules, decomposed=decomposed, leave_out=self._unusable)

    def follow(self) -> None:
        """Look at the model as it is now."""
        if unusable(self._model) != self._unusable:
            self._make()
        else:
            self._ignored = Ignored(self._model, self._scene.bodies)

    def at(
        self,
        values: Mapping[str, float],
        radius: float = RADIUS,
        *,
        containing: str = "",
        ignored: bool = False,
    ) -> Nearness:
        """Return what is near at values of all symbols, by name.

        Parameters
        ----------
        values
            [m], [rad].
        radius
            How near [m].
        containing
            Only pairs of which a name contains this, whatever its case.
        ignored
            Whether to look at ignored pairs as well.

        Raises
        ------
        KineverseError
            If there are no distances at these values, as where a pose is not finite.
        """
        # A state, for the values may be of more symbols than the scene has.
        self._scene.update(State(values))
        found = _named(self._scene.within(radius), containing)
        looked_at, not_looked_at = self._ignored.counts
        return Nearness(
            radius,
            found[:MOST],
            len(found),
            sum(1 for _ in takewhile(lambda pair: pair.touches, found)),  # they come first
            self._not_looked_at(values, radius, containing) if ignored else (),
            looked_at,
            not_looked_at,
        )

    def _not_looked_at(
        self, values: Mapping[str, float], radius: float, containing: str
    ) -> list[tuple[Closest, str]]:
        if self._all is None:
            self._all = self._scene_with([Rule("*", "*", check=True)])
        self._all.update(State(values))
        found = _named(self._all.within(radius), containing)
        reasons = ((pair, self._ignored.why(pair.a, pair.b)) for pair in found)
        return [(pair, why) for pair, why in reasons if why not in ("", RIGID)][:MOST]


def _named(pairs: Sequence[Closest], containing: str) -> Sequence[Closest]:
    text = containing.strip().lower()
    return [pair for pair in pairs if text in pair.a.lower() or text in pair.b.lower()] if text else pairs
