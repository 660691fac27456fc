"""Nearest points as things to draw: lines between them, arrows where bodies touch, colours by distance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.model.body import Cone, Cylinder
from kineverse.model.frame import WORLD
from kineverse.view.geometry import triangles_of
from kineverse.view.near import Nearness
from kineverse.view.parts import Part
from kineverse.view.primitives import placeholder
from kineverse.view.triangles import Floats, Triangles

FAR, MIDDLE, CLOSE = (0.13, 0.62, 0.20), (0.98, 0.78, 0.05), (0.95, 0.33, 0.10)
"""The colours at the radius, half way, and just before contact."""

CONTACT = (0.86, 0.04, 0.10)
IGNORED = (0.45, 0.48, 0.52)

BALL, LINE, SHAFT, HEAD, TIP = 0.1, 0.05, 0.05, 0.12, 0.35
"""Radii of the ends and middles of lines and arrows, and how long tips are, as parts of an arrow's length."""


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """What is drawn of nearest points.

    Attributes
    ----------
    lines
        (N, 2, 3) from a to b, of all pairs [m]. Between bodies that are apart that is along the normal.
    colors
        (N, 3) red, green, blue in [0, 1].
    arrows
        (M, 2, 3) along the normal, out of a where that is deepest in b, of the pairs that touch [m].
    depths
        M texts: how deep these are.
    """

    lines: Floats
    colors: Floats
    arrows: Floats
    depths: tuple[str, ...]

    @staticmethod
    def of(found: Nearness, length: float) -> Marks:
        """Return the marks of what was found, with arrows of a length [m]."""
        touching = [pair for pair in found.pairs if pair.touches]
        pairs = [*found.pairs, *(pair for pair, _ in found.ignored)]
        colors = [color(pair.distance, found.radius) for pair in found.pairs]
        return Marks(
            _ends((pair.point_a, pair.point_b) for pair in pairs),
            np.array([*colors, *[IGNORED] * len(found.ignored)]).reshape(-1, 3),
            _ends((pair.point_a, pair.point_a + length * pair.normal) for pair in touching),
            tuple(millimetres(-pair.distance) for pair in touching),
        )


def color(distance: float, radius: float) -> tuple[float, float, float]:
    """Return green at a radius [m], over yellow to orange the nearer it is; red in contact."""
    if distance <= 0.0:
        return CONTACT
    share = min(distance / radius, 1.0) if radius > 0.0 else 1.0
    stops = np.array([CLOSE, MIDDLE, FAR])
    red, green, blue = (float(np.interp(share, (0.0, 0.5, 1.0), stops[:, k])) for k in range(3))
    return red, green, blue


def millimetres(distance: float) -> str:
    """Return a distance [m] in millimetres, with no more digits than one can make use of."""
    value = 1000.0 * distance
    digits = 0 if abs(value) >= 99.5 else 1 if abs(value) >= 0.95 else 2
    rounded = round(value, digits) + 0.0  # and no minus sign before a zero
    return f"{rounded:.{digits}f} mm".replace("-", "−")


def mark_parts(marks: Marks, length: float) -> list[Part]:
    """Return marks as parts in the world, for a picture with arrows of a length [m]."""
    found = []
    for ends, shade in zip(marks.lines, marks.colors, strict=True):
        rgba = (float(shade[0]), float(shade[1]), float(shade[2]), 1.0)
        ball = placeholder().scaled(length * BALL / 0.05)  # which is 0.05 m large
        surfaces = [ball.moved(_at(end)) for end in ends]
        if (rod := _rod(ends, length * LINE)) is not None:
            surfaces.append(rod)
        found += [Part(WORLD, surface, rgba, "visual") for surface in surfaces]
    for ends in marks.arrows:
        found += [Part(WORLD, surface, (*CONTACT, 1.0), "visual") for surface in _arrow(ends, length)]
    return found


def _ends(pairs: Iterable[Sequence[Floats]]) -> Floats:
    return np.array([np.stack(list(ends)) for ends in pairs]).reshape(-1, 2, 3)


def _arrow(ends: Floats, length: float) -> list[Triangles]:
    tip = triangles_of(Cone(length * HEAD, length * TIP))
    pose = _along(ends)
    pose[:3, 3] = ends[0] + (1.0 - TIP / 2) * (ends[1] - ends[0])
    shaft = np.array([ends[0], ends[0] + (1.0 - TIP) * (ends[1] - ends[0])])
    rod = _rod(shaft, length * SHAFT)
    return [tip.moved(pose), *([rod] if rod is not None else [])]


def _rod(ends: Floats, radius: float) -> Triangles | None:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return triangles_of(Cylinder(radius, length)).moved(_along(ends)) if length > 1e-6 else None


def _at(point: npt.NDArray[np.float64]) -> Floats:
    pose = np.eye(4)
    pose[:3, 3] = point
    return pose


def _along(ends: Floats) -> Floats:
    """Return the pose in the middle of a line with z along it, 4×4."""
    z = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    pose = _at(ends.mean(axis=0))
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return pose
