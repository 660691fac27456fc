"""Measure many random pairs of convex solids, and check each answer against the plane that its normal makes.

    python tools/distances.py --pairs 100000 cone hull
    python tools/distances.py --pairs 10000 --case flat --case far

For two convex bodies apart, the distance is the gap between the planes at right angles to the normal, and no
direction shows a wider one; in each other, moving them by the depth along the normal separates them. Each
point lies in its own body and on its own plane, and the two face each other along the normal. So an answer
that is off shows it by itself. Both ways of measuring are checked: C, and coal with what mends it. Of pairs
in each other, the two have to agree as well. With ``--slopes``, the distance has to change with small motions
as its expression says: by the normal and the points. The exit status is 1 if anything is off.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from kineverse.geometry import broadphase
from kineverse.geometry.bindings import collision_library
from kineverse.geometry.broadphase import ObjectTable
from kineverse.geometry.gjk import directional_gaps
from kineverse.geometry.narrowphase import Narrowphase
from kineverse.geometry.shapes import Hull, Solid, solid_from_geometry, solid_from_points
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Sphere

Floats = npt.NDArray[np.float64]

KINDS = ("box", "sphere", "capsule", "hull", "cylinder", "ellipsoid", "cone")
LIMIT = 1e-4
"""No distance is further off than this [m]."""

Scales = Callable[[np.random.Generator], Floats]
HULLS: dict[str, Scales] = {
    "any": lambda rng: 10.0 ** rng.uniform(-1.5, 0.2, 3),
    "flat": lambda rng: np.array([0.5, 0.5, 10.0 ** rng.uniform(-7, -3)]),
    "sliver": lambda rng: np.array([0.5, *10.0 ** rng.uniform(-4, -2, 2)]),
}
CASES = (*HULLS, "small", "far", "touching", "deep", "planar", "aligned")
"""In ``planar`` the bodies turn about y and move in the plane of x and z; in ``aligned`` their axes are
parallel, and many of their sizes and places are the same."""

STEP = 1e-4
"""Length of a motion for a difference quotient [m], [rad]."""
SLOPE_LIMIT = 0.05
"""No slope is further off than this, for points about 1 m from the centre of the motion."""

Measure = Callable[[list[Solid], Floats], tuple[float, Floats]]


@dataclass
class Count:
    """What came of the pairs of two kinds."""

    apart: int = 0
    inside: int = 0
    unsolved: int = 0
    off: int = 0
    worst: float = 0.0
    steepest: float = 0.0
    """The largest error of a slope."""


def random_solid(kind: str, case: str, rng: np.random.Generator) -> Solid:
    """Return a solid with sizes of 0.1 m to 1.2 m; of 1 mm in the case ``small``."""
    size = 1e-3 if case == "small" else 1.0
    x, y, z = (size * rng.uniform(0.1, 1.2, 3)).tolist()
    if case == "aligned":
        x, y, z = rng.choice([0.3, 0.6, 0.9], 3).tolist()
    if kind == "hull":
        return solid_from_points(size * rng.normal(size=(9, 3)) * HULLS.get(case, HULLS["any"])(rng))
    return solid_from_geometry(
        {
            "box": Box((x, y, z)),
            "sphere": Sphere(x),
            "capsule": Capsule(x, y),
            "cylinder": Cylinder(x, y),
            "ellipsoid": Ellipsoid((x, y, z)),
            "cone": Cone(x, y),
        }[kind]
    )


def random_poses(case: str, rng: np.random.Generator) -> Floats:
    """Return two poses (2, 3, 4), about 1 m apart unless the case says otherwise."""
    spread = {"small": 1e-3, "far": 1e3, "deep": 0.0}.get(case, 1.0)
    poses = np.empty((2, 3, 4))
    for pose in poses:
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:, :3] = rotation * np.sign(np.linalg.det(rotation))
        pose[:, 3] = spread * rng.normal(size=3)
        if case == "planar":
            pose[:, :3] = rotation_about_y(rng.uniform(-np.pi, np.pi))
            pose[:, 3] *= [0.3, 0.0, 0.3]
        if case == "aligned":
            pose[:, :3] = rotation_about_y(rng.integers(4) * np.pi / 2)
            pose[:, 3] = rng.choice([-0.3, -0.15, 0.0, 0.15, 0.3], 3)
    return poses


def rotation_about_y(angle: float) -> Floats:
    """Return the (3, 3) rotation about y by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def by_coal(solids: list[Solid], poses: Floats) -> tuple[float, Floats]:
    """Return the distance by coal and what mends it, and the points and the normal (3, 3)."""
    narrow = Narrowphase(solids, poses)
    distance = narrow.distance(0, 1)
    return distance, np.array(narrow.witness())


def by_c(solids: list[Solid], poses: Floats) -> tuple[float, Floats]:
    """Return the distance by C, and the points and the normal (3, 3); NaN for what is left to coal."""
    table = ObjectTable(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
    for k, solid in enumerate(solids):
        table.set_solid(k, solid.centre, solid.half, solid.radius, solid.core)
    broadphase.place_objects(table, poses)
    distances, witnesses = collision_library.measure(table, np.array([[0, 1]], dtype=np.int32), np.inf)
    return float(distances[0]), witnesses[0].reshape(3, 3)


def outside(solid: Solid, pose: Floats, point: Floats) -> float:
    """Return at least how far a point (3,) is outside of a solid at a (3, 4) pose [m]; 0 inside."""
    x, y, z = own = pose[:, :3].T @ (point - pose[:, 3])
    across, shape = float(np.hypot(x, y)), solid.surface
    if isinstance(shape, Hull):
        # The planes of a thin hull are turned by rounding errors.
        return max(0.0, float((shape.normals @ own - shape.offsets).max()))
    if isinstance(shape, Box):
        return max(0.0, float((np.abs(own) - np.array(shape.size) / 2).max()))
    if isinstance(shape, Sphere):
        return max(0.0, float(np.linalg.norm(own)) - shape.radius)
    if isinstance(shape, Capsule):
        return max(0.0, float(np.hypot(across, max(0.0, abs(z) - shape.length / 2))) - shape.radius)
    if isinstance(shape, Cylinder):
        return max(0.0, abs(z) - shape.length / 2, across - shape.radius)
    if isinstance(shape, Ellipsoid):
        level = float(np.linalg.norm(own / shape.radii))
        return max(
            0.0, (level - 1.0) * level / max(1e-9, float(np.linalg.norm(own / np.square(shape.radii))))
        )
    assert isinstance(shape, Cone)
    slope = shape.radius / shape.length
    side = (across - slope * (shape.length / 2 - z)) / np.hypot(1.0, slope)
    return max(0.0, -shape.length / 2 - z, float(side))


def witness_error(solids: list[Solid], poses: Floats, distance: float, witness: Floats) -> float:
    """Return how far points and normal (3, 3) are from those of a distance [m].

    Each point is in its own body and on its own plane, and the distance along the normal from the other one.
    """
    point_a, point_b, normal = witness
    apart = float(np.linalg.norm(point_b - point_a - distance * normal))
    if not (abs(normal @ normal - 1.0) < 1e-6 and np.isfinite(apart)):
        return np.inf
    ball = solid_from_geometry(Sphere(1e-7))
    errors = [apart]
    for solid, pose, point, way in zip(solids, poses, (point_a, point_b), (normal, -normal), strict=True):
        planes = directional_gaps((solid, pose[:, :3], pose[:, 3]), (ball, np.eye(3), point), way[None])
        errors += [outside(solid, pose, point), abs(float(planes[0]) + 1e-7)]
    return max(errors)


def slope_error(measure: Measure, solids: list[Solid], poses: Floats, witness: Floats) -> float:
    """Return by how much the change of a distance differs from what its expression says.

    Either body moves along and turns about each axis, one way and the other. Where these differ, as at
    parallel faces, any slope between them is right. Motions after which another way out is the shortest are
    left out.
    """
    *points, normal = witness
    start, worst = measure(solids, poses)[0], 0.0
    for k, sign in ((0, -1.0), (1, 1.0)):
        for axis in range(6):
            slopes = []
            for step in (STEP, -STEP):
                moved = poses.copy()
                if axis < 3:
                    moved[k, axis, 3] += step
                    direction = np.eye(3)[axis]
                else:
                    turn = Rotation.from_rotvec(step * np.eye(3)[axis - 3]).as_matrix()
                    moved[k, :, :3] = turn @ poses[k, :, :3]
                    direction = np.cross(np.eye(3)[axis - 3], points[k] - poses[k, :, 3])
                distance, (_, _, way) = measure(solids, moved)
                if normal @ way > 0.99:
                    slopes.append((distance - start) / step)
            said = sign * float(normal @ direction)
            if len(slopes) == 2:
                worst = max(worst, min(slopes) - said, said - max(slopes))
    return worst


def check(kinds: tuple[str, str], case: str, pairs: int, seed: int, slopes: bool = False) -> dict[str, Count]:
    """Measure pairs, and count what is off."""
    rng = np.random.default_rng([seed, *map(KINDS.index, kinds), CASES.index(case)])
    counts = {"C": Count(), "coal": Count()}
    for _ in range(pairs):
        solids = [random_solid(kind, case, rng) for kind in kinds]
        poses = random_poses(case, rng)
        if case == "touching":
            distance, witness = by_c(solids, poses)
            if np.isnan(distance):
                continue
            poses[1, :, 3] -= (distance - rng.choice([0.0, 1e-12, 1e-9, 1e-7, -1e-9, -1e-7])) * witness[2]
        ways: dict[str, Measure] = {"C": by_c, "coal": by_coal}
        answers = {name: way(solids, poses) for name, way in ways.items()}
        shown: dict[str, float] = {}
        for name, (distance, witness) in answers.items():
            count = counts[name]
            if np.isnan(distance):
                count.unsolved += 1
                continue
            count.apart += distance > 0.0
            count.inside += distance <= 0.0
            placed = [(s, pose[:, :3], pose[:, 3]) for s, pose in zip(solids, poses, strict=True)]
            shown[name] = float(directional_gaps(placed[0], placed[1], witness[2][None])[0])
        widest = max(shown.values())
        for name, gap in shown.items():
            error = max(
                abs(gap - answers[name][0]), widest - gap, witness_error(solids, poses, *answers[name])
            )
            steep = slope_error(ways[name], solids, poses, answers[name][1]) if slopes else 0.0
            counts[name].worst = max(counts[name].worst, error)
            counts[name].steepest = max(counts[name].steepest, steep)
            counts[name].off += not (error <= LIMIT and steep <= SLOPE_LIMIT)
    return counts


def main() -> int:
    """Check what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=(*KINDS, []), help="two kinds; all pairs if none")
    parser.add_argument("--pairs", type=int, default=1000, help="how many of each (%(default)s)")
    parser.add_argument("--case", action="append", choices=CASES, help="which; 'any' if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slopes", action="store_true", help="also look how the distances change")
    given = parser.parse_args()
    if len(given.kinds) not in (0, 2):
        parser.error("two kinds make a pair")
    if not collision_library.prepare(wait=True):
        parser.error(f"this needs compiled C, and {collision_library.error}")
    chosen = [tuple(given.kinds)] if given.kinds else list(itertools.combinations_with_replacement(KINDS, 2))
    off = 0
    print(
        f"{'pair':24}{'case':10}{'by':6}{'apart':>8}{'inside':>8}{'unsolved':>9}{'off':>6}{'worst [m]':>11}"
        f"{'slopes':>9}"
    )
    for case in given.case or ["any"]:
        for one, other in chosen:
            for name, count in check((one, other), case, given.pairs, given.seed, given.slopes).items():
                off += count.off
                print(
                    f"{one + ', ' + other:24}{case:10}{name:6}{count.apart:8}{count.inside:8}"
                    f"{count.unsolved:9}{count.off:6}{count.worst:11.1e}{count.steepest:9.0e}",
                    flush=True,
                )
    print("all right" if not off else f"{off} answers are off by more than {LIMIT:g} m")
    return 1 if off else 0


if __name__ == "__main__":
    sys.exit(main())
