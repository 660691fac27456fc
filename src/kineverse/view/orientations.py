"""Quaternions as angles: nobody turns anything by four numbers of which only the ratios count."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

import kineverse as kv
from kineverse.model.view import ModelView
from kineverse.view.rotation import roll_pitch_yaw

ANGLES = ("roll", "pitch", "yaw")
ELEMENTS = ("qx", "qy", "qz", "qw")

REACH = {"roll": math.pi, "pitch": math.pi / 2, "yaw": math.pi}
"""How far each angle goes either way [rad]; within that there is one rotation for each of them."""


class Orientations:
    """The quaternions among the coordinates of a model, each shown as three angles about fixed x, y and z.

    A quaternion is four coordinates ``name/qx`` to ``name/qw`` that are moved by the same three speeds. Its
    angles are ``name/roll``, ``name/pitch`` and ``name/yaw`` [rad].

    Parameters
    ----------
    model
        The model.
    values
        The values of its symbols, by name.

    Attributes
    ----------
    angles
        What the angles are now, by name [rad]. They may be others than those of the quaternion, where two of
        them turn the same way: a slider keeps what it was set to.
    """

    def __init__(self, model: ModelView, values: Mapping[str, float]) -> None:
        rows = {str(coordinate): frozenset(row) for coordinate, row in model.rates.items()}
        self._names = []
        for name in sorted({path.rpartition("/")[0] for path in rows}):
            speeds = {rows.get(f"{name}/{element}", frozenset()) for element in ELEMENTS}
            if len(speeds) == 1 and len(speeds.pop()) == 3:
                self._names.append(name)
        self.angles: dict[str, float] = {}
        self.read(values)

    @property
    def coordinates(self) -> frozenset[str]:
        """The coordinates that are elements of quaternions, by name."""
        return frozenset(f"{name}/{element}" for name in self._names for element in ELEMENTS)

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """How far the angles go [rad]."""
        return {f"{name}/{angle}": (-REACH[angle], REACH[angle]) for name in self._names for angle in ANGLES}

    def in_place(self, names: Iterable[str]) -> list[str]:
        """Return names of coordinates with the angles where the elements of quaternions were."""
        found: dict[str, None] = {}
        for name in names:
            stem = name.rpartition("/")[0]
            for shown in [f"{stem}/{a}" for a in ANGLES] if name in self.coordinates else [name]:
                found[shown] = None
        return list(found)

    def turned(self, angle: str, value: float) -> dict[str, float]:
        """Set an angle [rad] and return the quaternion's elements, by name."""
        self.angles[angle] = value
        name = angle.rpartition("/")[0]
        (cr, sr), (cp, sp), (cy, sy) = (
            (math.cos(half), math.sin(half)) for half in (self.angles[f"{name}/{a}"] / 2 for a in ANGLES)
        )
        elements = (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
        return {f"{name}/{e}": value for e, value in zip(ELEMENTS, elements, strict=True)}

    def read(self, values: Mapping[str, float]) -> None:
        """Set the angles to those of the quaternions; of one that is zero, to none."""
        for name in self._names:
            q = np.array([values[f"{name}/{element}"] for element in ELEMENTS])
            size = float(np.linalg.norm(q))
            found = np.zeros(3)
            if math.isfinite(size) and size > 1e-9:
                found = roll_pitch_yaw(kv.quaternion(*q / size)())
            self.angles.update({f"{name}/{a}": float(v) for a, v in zip(ANGLES, found, strict=True)})
