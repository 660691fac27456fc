"""Few spheres that cover a region within a protrusion.

A ball about a point c inside of a convex solid sticks out of it by its radius less the depth d(c), exactly.
A point p therefore needs the protrusion min_i |p - c_i| - d(c_i), and a cover with N spheres is the location
problem that minimises the largest need over the centres. The needs are largest at corners of the power cells
of the spheres. So rounds alternate, as in Lloyd's iteration: the power diagram gives points that are hard to
cover, and the needs of these, smoothed, are descended over the centres.

The first centres come from a greedy set cover, or from a lattice. Covers with N spheres lie in many local
minima, and the protrusion of either start is known only after the descent, so that the number of spheres is
found by trying.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kineverse.geometry.mesh_files import Floats, Integers

from .certificate import distances, find_uncovered
from .cover_sampling import CoverMesh, CoverStarts
from .polytope import CoverRegion

_ROUNDS, _FEW_ROUNDS, _STEPS = 14, 10, 6  # power diagrams of a descent and of a short one, steps between two
_WARM, _COLD = 0.2, 0.015  # first and last temperature of the smoothed maximum, in protrusions

_MOMENTUM, _SIDES = 0.6, 12
_SAMPLES, _SAMPLES_EACH, _HARD = 300, 8, 0.6
_TRIALS, _SPLITS = 4, 4
_REMOVALS, _FEW_SPHERES = 3, 12
_PROOF, _ALLOWANCE, _ATTEMPTS = 0.01, 1.04, 4
"""Growth of radii for the sake of the proof, as a fraction of the protrusion."""

_ROUNDING = 1e-9  # growth of radii for the sake of rounding, as a fraction


@dataclass(frozen=True, slots=True, eq=False)
class FittedSpheres:
    """Spheres that cover a region: (N, 3) centres, (N,) radii and their largest protrusion."""

    centres: Floats
    radii: Floats
    protrusion: float

    def is_better(self, other: FittedSpheres, aim: float) -> bool:
        """Return True if it reaches an aim with fewer spheres than another cover, or else protrudes less."""
        if self.protrusion > aim or other.protrusion > aim:
            return self.protrusion < other.protrusion
        return (len(self.radii), self.protrusion) < (len(other.radii), other.protrusion)


class _Problem:
    """Region, with the points of it that a cover is fitted to."""

    def __init__(self, region: CoverRegion, protrusion: float) -> None:
        self.region, self._protrusion = region.simplify(), protrusion
        self.gaps: Floats = np.zeros((0, 3))
        self.expect(0)

    def expect(self, spheres: int) -> None:
        """Make the points close enough for a number of spheres."""
        region, samples = self.region, max(_SAMPLES, _SAMPLES_EACH * spheres)
        a, b, c = np.moveaxis(region.corners[region.faces], 1, 0)
        area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
        self.mesh = CoverMesh(region, max(self._protrusion, math.sqrt(area / samples)))

    def find_critical(self, centres: Floats, radii: Floats) -> tuple[Floats, Integers]:
        """Return the points that are hardest to cover by spheres, and the sphere of each."""
        points, owners = self.mesh.find_critical(centres, radii)
        if not len(self.gaps):
            return points, owners
        powers = np.square(distances(self.gaps, centres)) - radii**2
        return np.concatenate([points, self.gaps]), np.concatenate([owners, powers.argmin(axis=1)])


def fit_spheres(region: CoverRegion, protrusion: float, most: int) -> FittedSpheres:
    """Cover a region by few spheres."""
    protrusion = max(protrusion, _least_protrusion(region, most))
    problem = _Problem(region, protrusion)
    aim = protrusion / _ALLOWANCE
    for _ in range(_ATTEMPTS):
        fitted = _fit_to_points(problem, aim, most)
        proved, gaps = prove(region, fitted)
        if len(gaps) and proved.protrusion > _ALLOWANCE * fitted.protrusion:
            # The proof found points between those of the mesh.
            problem.gaps = gaps[:: len(gaps) // _SAMPLES + 1]
            fitted = descend(problem, fitted.centres, aim)
            again, _ = prove(region, fitted)
            proved = min(proved, again, key=lambda cover: cover.protrusion)
        if proved.protrusion <= protrusion or fitted.protrusion > aim:
            break
        aim *= 0.99 * protrusion / proved.protrusion
    return proved


def _least_protrusion(region: CoverRegion, most: int) -> float:
    """Return a lower bound of the protrusion of covers by a number of spheres.

    The part of a convex surface in a sphere is no larger than the sphere, which sticks out by its radius less
    a depth.
    """
    a, b, c = np.moveaxis(region.corners[region.faces], 1, 0)
    areas = np.bincount(region.owners, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    radius = math.sqrt(float(areas.max()) / (4.0 * math.pi * most))
    return radius - float(region.depths(region.middles).max())


def _fit_to_points(problem: _Problem, aim: float, most: int) -> FittedSpheres:
    corners = problem.region.corners
    best = descend(problem, ((corners.min(axis=0) + corners.max(axis=0)) / 2)[None], aim, _FEW_ROUNDS)
    if best.protrusion <= aim or most == 1:
        return best
    starts = CoverStarts(problem.region, aim)
    problem.expect(min(len(starts.greedy(1.2 * aim)), most))
    best = _search_start(problem, starts, aim, most, best)
    split = best
    for _ in range(_SPLITS):
        if best.protrusion <= aim or len(split.radii) >= most:
            break
        # More spheres may protrude further at first, such as three of a cone that two cover well.
        split = descend(problem, _split_worst(problem, split, most), aim)
        best = split if split.is_better(best, aim) else best
    polished = descend(problem, best.centres, aim)
    return _remove(problem, polished if polished.is_better(best, aim) else best, aim)


def _search_start(
    problem: _Problem, start: CoverStarts, aim: float, most: int, best: FittedSpheres
) -> FittedSpheres:
    """Run short descents, each from a start for another protrusion, and return the best result."""
    least = start.least_greedy(most)
    wanted = max(1.2 * aim, least)
    tried: set[int] = set()
    for _ in range(_TRIALS):
        # A greedy choice may need more spheres for a larger protrusion.
        while len(centres := start.greedy(wanted)) > most:
            wanted *= 1.1
        # No candidate may be inside of a thin plate, nor any point of a lattice.
        if not len(centres) or len(centres) in tried:
            break
        tried.add(len(centres))
        result = descend(problem, centres, aim, _FEW_ROUNDS)
        best = result if result.is_better(best, aim) else best
        # The protrusion after the descent is about proportional to that of the start.
        wanted = max(wanted * aim / result.protrusion, least)
    for factor in (1.3, 1.1):
        centres = start.lattice(factor * aim, most)
        reached = best.protrusion <= aim
        if not len(centres) or len(centres) in tried or len(centres) > (len(best.radii) if reached else most):
            continue
        tried.add(len(centres))
        result = descend(problem, centres, aim, _FEW_ROUNDS)
        best = result if result.is_better(best, aim) else best
    return best


def _split_worst(problem: _Problem, cover: FittedSpheres, most: int) -> Floats:
    """Add a centre next to each sphere that protrudes most, up to a number of spheres."""
    depths = problem.region.depths(cover.centres)
    points, owners = problem.find_critical(cover.centres, depths + cover.protrusion)
    needs = np.linalg.norm(points - cover.centres[owners], axis=1) - depths[owners]
    order = np.argsort(-needs, kind="stable")
    first = order[np.sort(np.unique(owners[order], return_index=True)[1])][: most - len(cover.radii)]
    return np.concatenate([cover.centres, 0.4 * cover.centres[owners[first]] + 0.6 * points[first]])


def descend(problem: _Problem, centres: Floats, aim: float, rounds: int = _ROUNDS) -> FittedSpheres:
    """Descend from centres (N, 3), and return the cover with the least protrusion on the way."""
    region = problem.region
    best = FittedSpheres(centres, np.zeros(0), math.inf)
    estimate = aim
    for k in range(rounds):
        centres, solids, depths = _pull_inside(region, centres)
        points, owners = problem.find_critical(centres, depths + estimate)
        lengths = np.linalg.norm(points - centres[owners], axis=1)
        radii = np.zeros(len(centres))
        np.maximum.at(radii, owners, lengths)
        protrusions = radii - depths
        used = radii > 0.0
        protrusion = float(protrusions[used].max())
        if protrusion < best.protrusion:
            best = FittedSpheres(centres[used], radii[used], protrusion)
        estimate = min(protrusion, best.protrusion)
        if k == rounds - 1:
            break
        hard = lengths - depths[owners] > _HARD * protrusion
        if not used.all():
            centres = _relocate(centres, radii, protrusions, points)
        temperature = estimate * _WARM * (_COLD / _WARM) ** (k / (rounds - 1))
        centres = _relax(region, centres, solids, points[hard], owners[hard], temperature)
    return best


def _pull_inside(region: CoverRegion, centres: Floats) -> tuple[Floats, Integers, Floats]:
    """Move centres outside of all solids towards the middle of one, up to its surface.

    Also return the solid in which each is deepest, and its depth there. Depths are concave along the line.
    """
    depths = region.part_depths(centres)
    solids = depths.argmax(axis=1)
    outside = np.flatnonzero(depths[np.arange(len(centres)), solids] < 0.0)
    if len(outside):
        goals, least = region.middles[solids[outside]], depths[outside, solids[outside]]
        part = np.minimum(-1.0001 * least / np.maximum(region.depths(goals) - least, 1e-300), 1.0)[:, None]
        centres = centres.copy()
        centres[outside] += part * (goals - centres[outside])
        depths = region.part_depths(centres)
        solids = depths.argmax(axis=1)
    return centres, solids, depths[np.arange(len(centres)), solids]


def _relocate(centres: Floats, radii: Floats, protrusions: Floats, corners: Floats) -> Floats:
    """Move centres without a cell to the worst spheres, towards their furthest corner."""
    moved = centres.copy()
    unused = np.flatnonzero(radii <= 0.0)
    worst = np.argsort(np.where(radii > 0.0, -protrusions, np.inf), kind="stable")[: len(unused)]
    for free, crowded in zip(unused.tolist(), worst.tolist(), strict=False):
        gaps = np.abs(np.linalg.norm(corners - centres[crowded], axis=1) - radii[crowded])
        moved[free] = 0.4 * centres[crowded] + 0.6 * corners[gaps.argmin()]
    return moved


def _relax(
    region: CoverRegion,
    centres: Floats,
    solids: Integers,
    points: Floats,
    owners: Integers,
    temperature: float,
) -> Floats:
    """Descend the smoothed largest need of points over their centres in solids (n,)."""
    order = np.argsort(owners, kind="stable")
    points, owners = points[order], owners[order]
    first = np.flatnonzero(np.diff(owners, prepend=-1))
    moving = owners[first]
    solids = solids[moving]
    group = np.cumsum(np.diff(owners, prepend=-1) > 0) - 1
    result = centres.copy()
    centres, speed = centres[moving], np.zeros((len(moving), 3))
    slack, normals = region.nearest_sides(centres, solids, _SIDES)
    offsets = slack + np.einsum("nfj,nj->nf", normals, centres)
    for _ in range(_STEPS):
        slack = offsets - np.einsum("nfj,nj->nf", normals, centres)
        apart = centres[group] - points
        lengths = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        weights = np.exp((lengths - np.maximum.reduceat(lengths, first)[group]) / temperature)
        pulls = apart * (weights / np.maximum(lengths, 1e-12))[:, None]
        gradient = np.add.reduceat(pulls, first) / np.add.reduceat(weights, first)[:, None]
        near = np.exp((slack.min(axis=1, keepdims=True) - slack) / temperature)
        gradient += np.einsum("nf,nfj->nj", near, normals) / near.sum(axis=1, keepdims=True)
        speed = _MOMENTUM * speed - temperature * gradient
        centres = centres + speed
    result[moving] = centres
    return result


def _remove(problem: _Problem, cover: FittedSpheres, aim: float) -> FittedSpheres:
    failures = 0
    while cover.protrusion <= aim and len(cover.radii) > 1 and failures < _REMOVALS:
        # Protrusions shrink about as the number of spheres to the power -0.7.
        count = int(len(cover.radii) * (1.0 - (cover.protrusion / aim) ** 1.4))
        if count == 0 and len(cover.radii) > _FEW_SPHERES:
            break
        count = max(count >> failures, 1)
        dropped = np.argsort(_removal_losses(problem, cover), kind="stable")[:count]
        result = descend(problem, np.delete(cover.centres, dropped, axis=0), aim)
        if result.protrusion <= aim:
            cover = result
        elif count == 1:
            break
        else:
            failures += 1
    return cover


def _removal_losses(problem: _Problem, cover: FittedSpheres) -> Floats:
    """Return for each sphere the protrusion (N,) that the others would need for its points."""
    depths = problem.region.depths(cover.centres)
    points = problem.find_critical(cover.centres, depths + cover.protrusion)[0]
    needs = distances(points, cover.centres) - depths
    rows, owners = np.arange(len(points)), needs.argmin(axis=1)
    needs[rows, owners] = np.inf
    losses = np.full(len(depths), -np.inf)
    np.maximum.at(losses, owners, needs.min(axis=1))
    return losses


def prove(region: CoverRegion, cover: FittedSpheres) -> tuple[FittedSpheres, Floats]:
    """Grow radii as far as the proof by subdivision needs; also return points (n, 3) uncovered before."""
    tolerance = _PROOF * cover.protrusion
    radii = cover.radii + tolerance
    uncovered = find_uncovered(region, cover.centres, radii, tolerance)
    radii = (radii + uncovered.growth) * (1.0 + _ROUNDING)
    protrusion = float((radii - region.depths(cover.centres)).max())
    return FittedSpheres(cover.centres, radii, protrusion), uncovered.points
