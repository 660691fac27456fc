"""Two levels of spheres over fine ones: coarse spheres, and one ball around everything."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.geometry.mesh_files import Floats, Integers

_ALWAYS_FLAT = 4
_LLOYD_ROUNDS = 10
_BALL_STEPS = 100
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class SphereTree:
    """Spheres sorted by coarse spheres that contain them, and one ball that contains all.

    Attributes
    ----------
    centres, radii
        (N, 3) and (N,) fine spheres, the children of each coarse sphere together [m].
    order
        (N,) index of each fine sphere among the given ones.
    coarse_centres, coarse_radii
        (M, 3) and (M,) coarse spheres [m].
    first
        (M + 1,) children of coarse sphere k are ``first[k]`` to ``first[k + 1] - 1``.
    ball_centre, ball_radius
        (3,) and radius of the ball that contains all [m].

    See Also
    --------
    kineverse.planning.spheres.make_sphere_tree
    """

    centres: Floats
    radii: Floats
    order: Integers
    coarse_centres: Floats
    coarse_radii: Floats
    first: Integers
    ball_centre: Floats
    ball_radius: float


def make_sphere_tree(centres: npt.ArrayLike, radii: npt.ArrayLike) -> SphereTree:
    """Return the hierarchy over spheres, (N, 3) and (N,) [m], with about √N coarse spheres.

    Up to four spheres are their own coarse spheres. The clusters are those of Lloyd's iteration from the
    furthest points.

    Raises
    ------
    ShapeError
        If the arrays have other shapes, or there is no sphere.
    InvalidValueError
        If a centre is not finite, or a radius not positive.

    Examples
    --------
    >>> centres = np.random.default_rng(0).uniform(size=(50, 3))
    >>> tree = kv.planning.spheres.make_sphere_tree(centres, np.full(50, 0.1))
    >>> len(tree.coarse_radii) < 50
    True
    """
    where, sizes = np.array(centres, dtype=float), np.array(radii, dtype=float)
    if where.ndim != 2 or where.shape[1] != 3 or sizes.shape != where.shape[:1] or not len(sizes):
        raise ShapeError(f"Spheres have centres (N, 3) and radii (N,), not {where.shape} and {sizes.shape}.")
    if not (np.isfinite(where).all() and np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise InvalidValueError("Spheres have finite centres and positive radii.")
    ball_centre, ball_radius = enclosing_ball(where, sizes)
    if len(sizes) <= _ALWAYS_FLAT:
        first = np.arange(len(sizes) + 1)
        return SphereTree(where, sizes, first[:-1], where, sizes, first, ball_centre, ball_radius)
    clusters = _cluster(where, sizes, round(math.sqrt(len(sizes))))
    order = np.argsort(clusters, kind="stable")
    where, sizes, clusters = where[order], sizes[order], clusters[order]
    first = np.append(np.flatnonzero(np.diff(clusters, prepend=-1)), len(sizes))
    balls = [enclosing_ball(where[i:j], sizes[i:j]) for i, j in pairwise(first.tolist())]
    coarse_centres = np.array([centre for centre, _ in balls])
    coarse_radii = np.array([radius for _, radius in balls])
    return SphereTree(where, sizes, order, coarse_centres, coarse_radii, first, ball_centre, ball_radius)


def enclosing_ball(centres: Floats, radii: Floats) -> tuple[Floats, float]:
    """Return centre (3,) and radius [m] of a ball around spheres, close to the smallest one.

    The centre approaches the sphere that reaches furthest by ever smaller steps (Bădoiu and Clarkson, Smaller
    core-sets for balls, 2003); the best centre on the way is taken.

    Examples
    --------
    >>> centre, radius = kv.planning.spheres.enclosing_ball(np.eye(3), np.full(3, 0.1))
    >>> round(radius, 2)
    0.92
    """
    if len(radii) == 1:
        return centres[0].copy(), float(radii[0])
    centre = centres.mean(axis=0)
    best, least = centre, math.inf
    for k in range(1, _BALL_STEPS + 1):
        reach = np.linalg.norm(centres - centre, axis=1) + radii
        furthest = int(reach.argmax())
        if reach[furthest] < least:
            best, least = centre, float(reach[furthest])
        away = centres[furthest] - centre
        # Towards the furthest point of that sphere, not its centre only.
        length = float(np.linalg.norm(away))
        if length == 0.0:
            break
        centre = centre + away * (float(reach[furthest]) / length / (k + 1))
    return best, least * (1.0 + _ROUNDING)


def _cluster(centres: Floats, radii: Floats, count: int) -> Integers:
    seeds = [int(np.linalg.norm(centres - centres.mean(axis=0), axis=1).argmax())]
    nearest = np.linalg.norm(centres - centres[seeds[0]], axis=1)
    while len(seeds) < count:
        seeds.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(centres - centres[seeds[-1]], axis=1))
    means = centres[seeds]
    clusters = np.zeros(len(centres), dtype=np.int64)
    for _ in range(_LLOYD_ROUNDS):
        clusters = (np.linalg.norm(centres[:, None] - means, axis=2) + radii[:, None]).argmin(axis=1)
        used = np.unique(clusters)
        before, means = means, np.array([centres[clusters == k].mean(axis=0) for k in used.tolist()])
        if means.shape == before.shape and np.allclose(means, before):
            break
    return np.asarray(np.unique(clusters, return_inverse=True)[1].reshape(-1), dtype=np.int64)
