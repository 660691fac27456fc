"""Covers of convex solids, and of unions of them, by few spheres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.geometry.mesh_files import Faces, Floats
from kineverse.geometry.shapes import Hull, Solid, scale_solid, thicken_primitive
from kineverse.model.body import Capsule, Sphere

from .cover_fit import fit_spheres
from .polytope import CoverPolytope, CoverRegion, bound_solid, solid_volume

MOST = 48  # default largest number of spheres of a cover

PROTRUSION_OF_SIZE, LEAST_PROTRUSION, LARGEST_PROTRUSION = 0.1, 5e-3, 25e-3
"""Default protrusion, as a fraction of the edge of a cube with the volume of the solid; its bounds [m]."""

_MOST_OF_ALL = 1024

_NEEDLE, _LEAST_RATIO = 1e-3, 1e-4
"""Thickness of a needle relative to its length, and least thickness relative to the largest size."""
_SMALL, _LARGE = 1e-4, 1e4  # radii between which a solid is bounded as it is [m]


@dataclass(frozen=True, slots=True, eq=False)
class SphereCover:
    """Spheres whose union contains solids.

    Attributes
    ----------
    centres, radii
        (N, 3) and (N,) in the frame of the solids' poses [m]; read-only.
    protrusion
        Upper bound of the distance of any point of a sphere from the solids [m].

    See Also
    --------
    kineverse.planning.spheres.cover_solids
    """

    centres: Floats
    radii: Floats
    protrusion: float

    def __len__(self) -> int:
        return len(self.radii)

    def move(self, pose: Floats) -> SphereCover:
        """Return the cover with its solids at a pose (4, 4)."""
        centres: Floats = self.centres @ pose[:3, :3].T + pose[:3, 3]
        centres.flags.writeable = False
        return replace(self, centres=centres)


def cover_solid(solid: Solid, protrusion: float | None = None, most: int = MOST) -> SphereCover:
    """Return few spheres that cover a convex solid, in its frame; see :func:`cover_solids`.

    See Also
    --------
    kineverse.planning.spheres.cover_solids
    """
    return cover_solids([(solid, np.eye(4))], protrusion, most)


def cover_solids(
    solids: Sequence[tuple[Solid, Floats]], protrusion: float | None = None, most: int = MOST
) -> SphereCover:
    """Return few spheres that cover the union of convex solids at poses (4, 4).

    Every point of the solids lies in a sphere: subdivision proves it, up to rounding. Spheres cover
    themselves. The same solids have the same cover in every run on one machine.

    Parameters
    ----------
    solids
        The solids with their poses.
    protrusion
        Largest distance of a point of a sphere from the union [m]; None for :func:`default_protrusion`. It is
        exceeded where ``most`` spheres are not enough; :attr:`SphereCover.protrusion` has what was reached.
    most
        Largest number of spheres.

    Raises
    ------
    InvalidValueError
        For a triangle mesh, which has no inside; or if there is no solid, the protrusion is not a positive
        length, or ``most`` not between 1 and 1024.

    Examples
    --------
    >>> from kineverse.geometry.shapes import solid_from_geometry
    >>> solid = solid_from_geometry(kv.model.Box((0.4, 0.3, 0.2)))
    >>> cover = kv.planning.spheres.cover_solids([(solid, np.eye(4))], protrusion=0.05)
    >>> cover.protrusion < 0.06, len(cover.radii) < 48
    (True, True)
    """
    check_cover_settings(protrusion, most)
    if not solids:
        raise InvalidValueError("There is no solid to cover.")
    spheres = [(pose, solid.surface) for solid, pose in solids if isinstance(solid.surface, Sphere)]
    if len(spheres) == len(solids) <= most:
        places = np.array([pose[:3, 3] for pose, _ in spheres])
        return _make_cover(places, np.array([sphere.radius for _, sphere in spheres], dtype=float), 0.0)
    if protrusion is None:
        protrusion = default_protrusion(solids)
    # Solids may be longer than any sensible protrusion, and one ball is then enough.
    protrusion = min(protrusion, 2.0 * sum(solid.radius for solid, _ in solids))
    (first, pose), *others = solids
    if isinstance(first.surface, Capsule) and not others:
        centres, radii, reached = _capsule_chain(first.surface, protrusion, most)
        return _make_cover(centres, radii, reached).move(pose)
    _, width, length = np.sort(first.half).tolist()
    is_primitive = not isinstance(first.surface, Hull | Faces)
    if is_primitive and width <= _NEEDLE * length and not others:
        centres, reached = _needle_chain(first, protrusion, most)
        return _make_cover(centres, np.full(len(centres), reached), reached).move(pose)
    parts, growth = _bound_solids(solids, protrusion)
    corners = np.concatenate([part.corners for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    origin, unit = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    shift = np.eye(4)
    shift[:3, 3] = -origin
    region = CoverRegion([part.move(shift, 1.0 / unit) for part in parts])
    fitted = fit_spheres(region, protrusion / unit, most)
    reached = fitted.protrusion * unit + growth
    return _make_cover(fitted.centres * unit + origin, fitted.radii * unit, reached)


def default_protrusion(solids: Sequence[tuple[Solid, Floats]]) -> float:
    """Return the default protrusion of covers: a tenth of the size, from 5 mm to 25 mm [m].

    The size is the edge of a cube with the volume of the union.

    See Also
    --------
    kineverse.planning.spheres.cover_solids
    """
    if len(solids) == 1:
        volume = solid_volume(solids[0][0])
    else:
        parts, _ = _bound_solids(solids, 0.1 * min(solid.radius for solid, _ in solids))
        volume = CoverRegion(parts).measure_volume()
    return min(max(PROTRUSION_OF_SIZE * math.cbrt(volume), LEAST_PROTRUSION), LARGEST_PROTRUSION)


def check_cover_settings(protrusion: float | None, most: int) -> None:
    """Raise InvalidValueError for a protrusion [m] or a number of spheres that no cover can have."""
    if protrusion is not None and not (math.isfinite(protrusion) and protrusion > 0.0):
        raise InvalidValueError(f"A protrusion of {protrusion:g} m: spheres stick out by a positive length.")
    if not 1 <= most <= _MOST_OF_ALL:
        raise InvalidValueError(f"most={most}: a cover has 1 to {_MOST_OF_ALL} spheres.")


def _bound_solids(
    solids: Sequence[tuple[Solid, Floats]], protrusion: float
) -> tuple[list[CoverPolytope], float]:
    """Bound solids at poses by polytopes; return these and the largest growth of a solid [m].

    Plates and needles are thickened, and what is very large or small is bounded at a size of 1 m, since hulls
    need a volume and a size.
    """
    parts, most = [], 0.0
    for solid, pose in solids:
        if isinstance(solid.surface, Hull | Faces):
            parts.append(bound_solid(solid, protrusion).move(pose))
            continue
        solid, growth = thicken_primitive(solid, _LEAST_RATIO)
        most = max(most, growth)
        size = solid.radius if not _SMALL < solid.radius < _LARGE else 1.0
        part = bound_solid(solid if size == 1.0 else scale_solid(solid, 1.0 / size), protrusion / size)
        parts.append(part.move(np.eye(4), size).move(pose))
    return parts, most


def _needle_chain(solid: Solid, protrusion: float, most: int) -> tuple[Floats, float]:
    """Cover a needle by equal spheres along its axis; return their centres and radius [m].

    The axis lies inside, so that none sticks out by more than its radius.
    """
    *_, axis = np.argsort(solid.half, kind="stable").tolist()
    half = float(solid.half[axis])
    aside = float(np.linalg.norm(np.delete(solid.half, axis)))
    # Spheres reach this far along the axis where they contain the needle.
    reach = math.sqrt(max(protrusion**2 - aside**2, (half / most) ** 2))
    count = min(max(math.ceil(half / reach), 1), most)
    centres = np.zeros((count, 3))
    centres[:, axis] = half * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
    return solid.centre + centres, math.hypot(half / count, aside) * (1.0 + 1e-9)


def _make_cover(centres: Floats, radii: Floats, protrusion: float) -> SphereCover:
    centres.flags.writeable = radii.flags.writeable = False
    return SphereCover(centres, radii, protrusion)


def _capsule_chain(capsule: Capsule, protrusion: float, most: int) -> tuple[Floats, Floats, float]:
    """Cover a capsule by equal spheres along its axis; return them and their protrusion [m].

    With radius r + e they reach beyond both ends by e if the outermost are e inside of the ends of the axis,
    and cover the side as long as neighbours are no further than 2 √((r + e)² - r²) apart.
    """
    radius, length = float(capsule.radius), float(capsule.length)

    def count_spheres(e: float) -> int:
        span = max(length - 2 * e, 0.0)
        return 1 + math.ceil(span / (2 * math.sqrt(e * (2 * radius + e))))

    low, high = 0.0, max(protrusion, length / 2)
    count = count_spheres(protrusion)
    if count > most:
        low, count = protrusion, most
    # The least protrusion for that many spheres.
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if middle > 0.0 and count_spheres(middle) <= count else (middle, high)
    span = max(length / 2 - high, 0.0)
    centres = np.zeros((count, 3))
    centres[:, 2] = np.linspace(-span, span, count) if count > 1 else 0.0
    reached = high * (1.0 + 1e-9) + 1e-9 * radius
    return centres, np.full(count, radius + reached), reached
