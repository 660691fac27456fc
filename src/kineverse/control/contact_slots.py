"""Contact slots: rows of a controller about the near pairs of bodies, whose numbers change each step.

With the distance d of a pair, its nearest points p and normal n (from a to b)::

    ḋ = n·(ṗ_b - ṗ_a) >= -γ max(d - margin, 0)

by the envelope theorem; see :mod:`kineverse.geometry.distance_expressions`. The velocity of a point follows
from the twist of its body. Twists are compiled once for each group of bodies that move together, so other
bodies may come near without another compilation. Within the margin a soft goal leads back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.compile.function import WantedTier
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.geometry import Rule, Scene
from kineverse.geometry.bindings import FacingPoints
from kineverse.geometry.prepared_query import PairFlags, flag_between, flag_matching
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.symbols import Symbol

from .contact_rows import ContactRows
from .velocity_program import RECOVERY_WEIGHT


class ContactSlots:
    """Rows of the nearest pairs of bodies."""

    found: DistanceResults  # near pairs of the last update, nearest first, all of them

    def __init__(
        self,
        scene: Scene,
        speeds: Sequence[Symbol],
        count: int,
        *,
        margin: float,
        radius: float,
        gain: float,
        twist: Callable[[str], Expression] | None = None,
        rules: Iterable[Rule] = (),
        tier: WantedTier = "auto",
    ) -> None:
        if not isinstance(scene, Scene):
            raise InvalidValueError(f"scene= is a kineverse.geometry.Scene of the model, not {scene!r}.")
        check_slots(count)
        if not (math.isfinite(margin) and margin < radius):
            raise InvalidValueError(
                f"Pairs count from a radius on that is larger than their margin, not {radius!r} m beside "
                f"{margin!r} m."
            )
        model = scene.model
        self._version = model.version
        self.scene, self.count = scene, count
        self.margin, self.radius, self.gain = margin, radius, gain
        motion = FrameDependence(model, speeds)
        self._query = scene.watch(radius=radius, moving=speeds, rules=rules, per_shape=True)
        self._query.prepare()
        watched = set(self._query.pairs.ravel().tolist())
        moved = [motion.moving_ancestors(b) if k in watched else () for k, b in enumerate(scene.bodies)]
        groups = {group: k for k, group in enumerate(dict.fromkeys(((), *moved)))}
        self._group = np.array([groups[group] for group in moved], dtype=np.intp)
        self._margins = np.full((len(scene.bodies), len(scene.bodies)), self.margin)
        # Pairs with a margin of their own press on each other, and slide.
        self._facing = FacingPoints(self._margins, self.margin)
        self._rows: ContactRows
        self._selected: dict[tuple[tuple[str, ...], tuple[str, ...]], PairFlags] = {}
        members = dict(zip(moved, scene.bodies, strict=True))
        twists: list[Expression] = [as_expression(np.zeros((6, len(speeds))))]
        twist = twist or (lambda body: model.jacobian(body, form="world", symbols=speeds))
        twists += [twist(members[group]) for group in groups if group]
        stacked = array([e for twist in twists for e in twist.ravel()]).reshape(len(twists), 6, len(speeds))
        self.inputs = tuple(sorted({*scene.inputs, *stacked.symbols}, key=lambda s: s.sort_key))
        self.function = compile([stacked], tier=tier)
        self._twists = self.function.bind()
        place = {s: k for k, s in enumerate(self.inputs)}
        self._scene_values = np.array([place[s] for s in scene.inputs], dtype=np.intp)
        self._twist_values = np.array([place[s] for s in self.function.inputs], dtype=np.intp)

    def update(self, values: Array) -> None:
        """Find the near pairs at the values of :attr:`inputs`."""
        if self.scene.model.version != self._version:
            raise InvalidValueError(
                "The model of the scene was edited since, so the rows of contacts are not about its bodies. "
                "Build anew, or with a scene of model.snapshot()."
            )
        self.found = self._query.at(values[self._scene_values], self.radius, self._facing)
        self._twists.input[:] = values[self._twist_values]
        self._twists()

    def set_margin(self, one: str | Iterable[str], other: str | Iterable[str], margin: float) -> None:
        """Set the distance that some pairs keep [m]; negative for bodies that press on each other."""
        if not (math.isfinite(margin) and margin < self.radius):
            raise InvalidValueError(f"A margin is smaller than the radius {self.radius!r} m, not {margin!r}.")
        bodies = self.scene.bodies
        ones, others = (tuple([names] if isinstance(names, str) else names) for names in (one, other))
        if (ones, others) not in self._selected:
            self._selected[ones, others] = flag_between(
                flag_matching(bodies, ones), flag_matching(bodies, others)
            )
        self._margins[self._selected[ones, others]] = margin

    def twist(self, body: int) -> Array:
        """Return the twist (v, ω) of a body, (6, n) over the columns in the world, at the last update.

        The velocities of a point p of the body are ``v + ω × p``.
        """
        return np.asarray(self._twists.outputs[0][self._group[body]])

    def twists(self, bodies: Sequence[int]) -> Array:
        """Return the twists of some bodies, (k, 6, n), see :meth:`twist`."""
        return np.asarray(self._twists.outputs[0][self._group[bodies]])

    def bind(self, H: Array, f: Array, A: Array, lower: Array) -> None:
        """Choose the arrays of the program into which :meth:`write` writes."""
        self._rows = ContactRows(
            self._group, self._twists.outputs[0], self._margins, *map(_contiguous, (H, f, A, lower))
        )

    def write(self, recovery: float, weight: float = RECOVERY_WEIGHT) -> None:
        """Write the rows of the nearest pairs into the program, and the soft goals into its costs."""
        used = min(len(self.found), self.count)
        if used:
            self._rows.write(self.found, used, gain=self.gain, recovery=recovery, weight=weight)


def check_slots(count: object) -> None:
    """Raise InvalidValueError for a number of contact slots that is no natural number."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise InvalidValueError(f"contacts= is a number of rows, 0 or more, not {count!r}.")


def _contiguous(array: Array) -> Array:
    """Return an array that C can write to."""
    if not array.flags.c_contiguous or array.dtype != np.float64:
        raise InvalidValueError("Rows of contacts are written in place, into contiguous arrays of doubles.")
    return array
