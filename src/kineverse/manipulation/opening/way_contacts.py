"""Contacts of a robot with everything else along its ways to a handle, with it and away from it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from kineverse.geometry import Rule, Scene
from kineverse.geometry.prepared_query import PreparedQuery
from kineverse.grasping import Gripper
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

OWN_MARGIN = 0.003
"""Least distance of the robot's own links [m]; pairs that are always nearer do not count."""
_BESIDE_BAR = 5e-4
"""Least distance of the opened fingers from the handle [m]."""


class WayContacts:
    """Queries of the distances of a robot along ways."""

    def __init__(
        self,
        model: ModelView,
        scene: Scene,
        gripper: Gripper,
        own: Sequence[str],
        others: Sequence[str],
        margin: float,
    ) -> None:
        self.scene, self.gripper, self.margin = scene, gripper, margin
        self.own, self.others = tuple(own), tuple(others)
        self._model = model
        self._hand = {b for b in own if b in gripper.bodies or not model.speeds_of(b, gripper.hand)}
        self._around: dict[str, PreparedQuery] = {}
        self._beside: dict[str, PreparedQuery] = {}
        self._found: tuple[PreparedQuery, float] | None = None

    def first(
        self, state: State, columns: Sequence[Symbol], rows: Array, handle: str, *, opened: bool
    ) -> int | None:
        """Return the index of the first row of values (N, n) at which the robot comes too near to something.

        The scene is placed there.
        """
        self.scene.update(state.updated(dict(zip(columns, rows[0].tolist(), strict=True))))
        queries = [(self._watch_around(handle), self.margin), (self._own_watch, OWN_MARGIN)]
        if opened and handle:
            queries.append((self._watch_beside(handle), _BESIDE_BAR))
        first: int | None = None
        for query, radius in queries:
            found = query.first_within(columns, rows[:first], radius) if first != 0 else None
            if found is not None:
                first, self._found = found, (query, radius)
        if first is not None:
            self.scene.update(state.updated(dict(zip(columns, rows[first].tolist(), strict=True))))
        return first

    def touching(self) -> tuple[str, str]:
        """Return the pair of bodies that is too near in the scene, the robot's first."""
        assert self._found is not None
        query, radius = self._found
        pair = query(radius)[0]
        return (pair.b, pair.a) if pair.b in self._hand else (pair.a, pair.b)

    def is_of_hand(self, body: str) -> bool:
        """Return True if a body is rigid with the hand or one of its fingers."""
        return body in self._hand

    def _watch_around(self, handle: str) -> PreparedQuery:
        """Return the query of the robot's distance from everything else, but of the hand from the handle."""
        if handle not in self._around:
            bodies = self.gripper.bodies if handle else ()
            allowed = [Rule(b, handle, False, "grasped") for b in bodies]
            self._around[handle] = self.scene.watch(self.own, self.others, self.margin, rules=allowed)
        return self._around[handle]

    def _watch_beside(self, handle: str) -> PreparedQuery:
        """Return the query of the hand's distance from the handle."""
        if handle not in self._beside:
            self._beside[handle] = self.scene.watch([*self.gripper.bodies], [handle], _BESIDE_BAR)
        return self._beside[handle]

    @cached_property
    def _own_watch(self) -> PreparedQuery:
        return self.scene.watch(self.own, self.own, OWN_MARGIN)
