"""Measure many random pairs of convex solids, and check each answer against the plane that its normal makes.

    python tools/distances.py --pairs 100000 cone hull
    python tools/distances.py --pairs 10000 --case flat --case far

For two convex bodies apart, the distance is the gap between the planes at right angles to the normal, and no
direction shows a wider one; in each other, moving them by the depth along the normal separates them. So an
answer that is off shows it by itself. Both ways of measuring are checked: C, and coal with what mends it. Of
pairs in each other, the two have to agree as well. The exit status is 1 if anything is off.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.geometry import broadphase
from kineverse.geometry.bindings import collision_library
from kineverse.geometry.broadphase import ObjectTable
from kineverse.geometry.narrowphase import Narrowphase
from kineverse.geometry.shapes import Solid, solid_from_geometry, solid_from_points
from kineverse.geometry.support import directional_gaps
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
CASES = (*HULLS, "small", "far", "touching", "deep")


@dataclass
class Count:
    """What came of the pairs of two kinds."""

    apart: int = 0
    inside: int = 0
    unsolved: int = 0
    off: int = 0
    worst: float = 0.0


def random_solid(kind: str, case: str, rng: np.random.Generator) -> Solid:
    """Return a solid with sizes of 0.1 m to 1.2 m; of 1 mm in the case ``small``."""
    size = 1e-3 if case == "small" else 1.0
    x, y, z = (size * rng.uniform(0.1, 1.2, 3)).tolist()
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
    return poses


def by_coal(solids: list[Solid], poses: Floats) -> tuple[float, Floats]:
    """Return the distance and the normal by coal, and what mends it."""
    narrow = Narrowphase(solids, poses)
    distance = narrow.distance(0, 1)
    return distance, narrow.witness()[2]


def by_c(solids: list[Solid], poses: Floats) -> tuple[float, Floats]:
    """Return the distance and the normal by C; NaN for what is left to coal."""
    table = ObjectTable(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
    for k, solid in enumerate(solids):
        table.set_solid(k, solid.centre, solid.half, solid.radius, solid.core)
    broadphase.place_objects(table, poses)
    distances, witnesses = collision_library.measure(table, np.array([[0, 1]], dtype=np.int32), np.inf)
    return float(distances[0]), witnesses[0, 6:]


def check(kinds: tuple[str, str], case: str, pairs: int, seed: int) -> dict[str, Count]:
    """Measure pairs, and count what is off."""
    rng = np.random.default_rng([seed, *map(KINDS.index, kinds), CASES.index(case)])
    counts = {"C": Count(), "coal": Count()}
    for _ in range(pairs):
        solids = [random_solid(kind, case, rng) for kind in kinds]
        poses = random_poses(case, rng)
        if case == "touching":
            distance, normal = by_c(solids, poses)
            if np.isnan(distance):
                continue
            poses[1, :, 3] -= (distance - rng.choice([0.0, 1e-12, 1e-9, 1e-7, -1e-9, -1e-7])) * normal
        answers = {"C": by_c(solids, poses), "coal": by_coal(solids, poses)}
        shown: dict[str, float] = {}
        for name, (distance, normal) in answers.items():
            count = counts[name]
            if np.isnan(distance):
                count.unsolved += 1
                continue
            count.apart += distance > 0.0
            count.inside += distance <= 0.0
            placed = [(s, pose[:, :3], pose[:, 3]) for s, pose in zip(solids, poses, strict=True)]
            shown[name] = float(directional_gaps(placed[0], placed[1], normal[None])[0])
        widest = max(shown.values())
        for name, gap in shown.items():
            error = max(abs(gap - answers[name][0]), widest - gap)
            counts[name].worst = max(counts[name].worst, error)
            counts[name].off += not error <= LIMIT
    return counts


def main() -> int:
    """Check what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=(*KINDS, []), help="two kinds; all pairs if none")
    parser.add_argument("--pairs", type=int, default=1000, help="how many of each (%(default)s)")
    parser.add_argument("--case", action="append", choices=CASES, help="which; 'any' if not given")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if len(given.kinds) not in (0, 2):
        parser.error("two kinds make a pair")
    if not collision_library.prepare(wait=True):
        parser.error("this needs a C compiler")
    chosen = [tuple(given.kinds)] if given.kinds else list(itertools.combinations_with_replacement(KINDS, 2))
    off = 0
    print(
        f"{'pair':24}{'case':10}{'by':6}{'apart':>8}{'inside':>8}{'unsolved':>9}{'off':>6}{'worst [m]':>11}"
    )
    for case in given.case or ["any"]:
        for one, other in chosen:
            for name, count in check((one, other), case, given.pairs, given.seed).items():
                off += count.off
                print(
                    f"{one + ', ' + other:24}{case:10}{name:6}{count.apart:8}{count.inside:8}"
                    f"{count.unsolved:9}{count.off:6}{count.worst:11.1e}",
                    flush=True,
                )
    print("all right" if not off else f"{off} answers are off by more than {LIMIT:g} m")
    return 1 if off else 0


if __name__ == "__main__":
    sys.exit(main())
