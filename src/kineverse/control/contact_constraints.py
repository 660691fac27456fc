"""Constraints of controllers that keep near pairs of bodies apart.

With the distance d of a pair, the normal n from a to b, the nearest points p, and the twists (v, ω) of both
bodies over the columns, ``ḋ = n·(v_b + ω_b × p_b) - n·(v_a + ω_a × p_a) >= -γ max(d - margin, 0)`` by the
envelope theorem; see :mod:`kineverse.geometry.distance_expressions`. Twists are compiled once for each group
of bodies that move together, so other bodies may come near without another compilation. Within the margin a
soft goal, ``½ weight (ḋ - rate)²``, separates the pair.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.compilation.c_library import SourceLibrary, struct_fields
from kineverse.compilation.function import WantedTier
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.geometry import Rule, Scene
from kineverse.geometry.bindings import FacingPoints
from kineverse.geometry.distance_queries import PairFlags, flag_between, flag_matching
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.symbols import Symbol

from .velocity_program import INWARDS, RECOVERY_WEIGHT


class _Struct(ctypes.Structure):
    _fields_ = struct_fields(
        "i n width bodies used; p group twists margins H f A lower distances witnesses owners; "
        "d gain recovery weight inwards"
    )


def _declare(code: Any) -> None:
    code.write_rows.argtypes, code.write_rows.restype = (ctypes.c_void_p,), None


row_library = SourceLibrary("contact_rows.c", _declare)


class ContactRows:
    """Writer of the rows of near pairs into the arrays of a quadratic program, which it keeps."""

    def __init__(
        self,
        group: npt.NDArray[np.intp],
        twists: Array,
        margins: Array,
        H: Array,
        f: Array,
        A: Array,
        lower: Array,
    ) -> None:
        self._group, self._twists, self._margins = group.astype(np.int64), twists, margins
        self._H, self._f, self._A, self._lower = H, f, A, lower
        self._struct = struct = _Struct(n=twists.shape[2], width=A.shape[1], bodies=len(group))
        struct.inwards = INWARDS
        arrays = {"group": self._group, "twists": twists, "margins": margins}
        for name, values in (arrays | {"H": H, "f": f, "A": A, "lower": lower}).items():
            setattr(struct, name, values.ctypes.data)
        self._address = ctypes.addressof(struct)
        row_library.prepare(wait=True)  # now, so that numbers never change

    def write(
        self, found: DistanceResults, used: int, *, gain: float, recovery: float, weight: float
    ) -> None:
        """Write the rows of the first pairs, and add those within their margins to the costs."""
        if row_library.code is None:
            self._write_by_numpy(found, used, gain, recovery, weight)
            return
        struct = self._struct
        struct.used, struct.gain, struct.recovery, struct.weight = used, gain, recovery, weight
        struct.owners = _address(found.body_indices)
        struct.distances, struct.witnesses = _address(found.distances), _address(found.witnesses)
        row_library.code.write_rows(self._address)

    def _write_by_numpy(
        self, found: DistanceResults, used: int, gain: float, recovery: float, weight: float
    ) -> None:
        n = self._twists.shape[2]
        owners, normals = found.body_indices[:used], found.normals[:used]
        ends = ((owners[:, 1], found.points_b[:used]), (owners[:, 0], found.points_a[:used]))
        wrenches = (np.hstack([normals, np.cross(p, normals)]) for _, p in ends)
        twists = (self._twists[self._group[owner]] for owner, _ in ends)
        grows, shrinks = map(partial(np.einsum, "ki,kij->kj"), wrenches, twists)
        rows = self._A[:used, :n] = grows - shrinks
        gap = found.distances[:used] - self._margins[owners[:, 0], owners[:, 1]]
        self._lower[:used] = -gain * np.maximum(gap, 0.0)
        near = gap < 0.0
        inside = rows[near]
        self._H[:n, :n] += weight * (inside.T @ inside)
        self._f[:n] -= weight * recovery * ((INWARDS - gap[near]) @ inside)


def _address(array: npt.NDArray[Any]) -> int:
    """Return the address of an array that is not empty, in a third of the time of ``array.ctypes.data``."""
    return ctypes.addressof(ctypes.c_char.from_buffer(array.data))


class ContactSlots:
    """Rows of the nearest pairs of bodies."""

    found: DistanceResults  # all near pairs of the last update, nearest first

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
        if not (math.isfinite(margin) and margin < radius):
            raise InvalidValueError(f"radius= is above margin=, not {radius!r} m for one of {margin!r} m.")
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
                "Build the controller again, or with a scene of model.snapshot()."
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
            flags = (flag_matching(bodies, names) for names in (ones, others))
            self._selected[ones, others] = flag_between(*flags)
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
        for part in (H, f, A, lower):
            if not part.flags.c_contiguous or part.dtype != np.float64:
                raise InvalidValueError("Rows of contacts are written in place, into contiguous doubles.")
        self._rows = ContactRows(self._group, self._twists.outputs[0], self._margins, H, f, A, lower)

    def write(self, recovery: float, weight: float = RECOVERY_WEIGHT) -> None:
        """Write the rows of the nearest pairs into the program, and the soft goals into its costs."""
        used = min(len(self.found), self.count)
        if used:
            self._rows.write(self.found, used, gain=self.gain, recovery=recovery, weight=weight)
