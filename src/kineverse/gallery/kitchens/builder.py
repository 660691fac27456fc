"""Builder of a kitchen: materials and solids, style drawn from a seed, operations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.articulations import Joint
from kineverse.articulations.mechanisms import Mechanism
from kineverse.articulations.mechanisms.mechanism import box_shape, rod_shape, shift
from kineverse.model.basic_operations import AddFrame, Override, SetBody
from kineverse.model.body import Body, Box, Cylinder, Inertia, Pose, Rgba, Shape, Vector3
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation

Span: TypeAlias = tuple[float, float]  # ends of a range along an axis [m]


@dataclass(frozen=True, slots=True)
class Material:
    """Colour and density [kg/m³]."""

    color: Rgba
    density: float


STEEL = Material((0.74, 0.76, 0.78, 1.0), 450.0)
BAR = Material((0.62, 0.64, 0.66, 1.0), 2700.0)
BLACK_BAR = Material((0.13, 0.13, 0.14, 1.0), 2700.0)
BRASS_BAR = Material((0.78, 0.63, 0.36, 1.0), 2700.0)
GLASS = Material((0.06, 0.07, 0.09, 1.0), 1200.0)
ENAMEL = Material((0.16, 0.17, 0.19, 1.0), 900.0)
FOAM = Material((0.95, 0.97, 0.98, 1.0), 60.0)
PLINTH = Material((0.23, 0.24, 0.26, 1.0), 680.0)
BOARD = Material((0.93, 0.92, 0.89, 1.0), 680.0)
BIRCH = Material((0.87, 0.77, 0.62, 1.0), 620.0)
PLASTER = Material((0.90, 0.88, 0.84, 1.0), 900.0)
CLEAR = Material((0.80, 0.86, 0.90, 0.25), 2500.0)
TILE = Material((0.78, 0.84, 0.81, 1.0), 2000.0)
FLOOR = Material((0.66, 0.60, 0.53, 1.0), 1500.0)


@dataclass(frozen=True, slots=True)
class MaterialShape:
    """Shape of a material."""

    shape: Shape
    density: float


def slab(x: Span, y: Span, z: Span, material: Material) -> MaterialShape:
    """Return a box between the ends of three ranges [m]."""
    ends = (x, y, z)
    # Micrometres: equal dimensions are equal numbers, whatever was added to get them.
    a, b, c = (round(high - low, 6) for low, high in ends)
    p, q, r = (round((low + high) / 2, 7) for low, high in ends)
    return MaterialShape(box_shape((a, b, c), (p, q, r), material.color), material.density)


def cylinder_between(start: Vector3, end: Vector3, radius: float, material: Material) -> MaterialShape:
    """Return a cylinder from one point to another [m]."""
    return MaterialShape(rod_shape(start, end, radius, material.color), material.density)


def open_box(x: Span, y: Span, z: Span, wall: float, material: Material, opening: str) -> list[MaterialShape]:
    """Return the five walls of a box that is open towards ``"+x"`` or ``"+z"`` [m]."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    inner = (y0 + wall, y1 - wall)
    walls = [slab(x, (y0, y0 + wall), z, material), slab(x, (y1 - wall, y1), z, material)]
    walls.append(slab((x0, x0 + wall), inner, z, material))
    if opening == "+z":
        walls.append(slab((x1 - wall, x1), inner, z, material))
        walls.append(slab((x0 + wall, x1 - wall), inner, (z0, z0 + wall), material))
    else:
        walls += [slab((x0 + wall, x1), inner, ends, material) for ends in ((z0, z0 + wall), (z1 - wall, z1))]
    return walls


def furniture_body(solids: Iterable[MaterialShape], decoration: Iterable[MaterialShape] = ()) -> Body:
    """Return the body of solids: shapes for the eye and for collisions, and the inertia."""
    solids = tuple(solids)
    return Body(
        visuals=tuple(s.shape for s in (*solids, *decoration)),
        collisions=tuple(Shape(s.shape.geometry, s.shape.origin) for s in solids),
        inertia=compute_inertia(solids),
    )


def compute_inertia(solids: Iterable[MaterialShape]) -> Inertia:
    """Return mass and inertia of solids by the parallel axis theorem, ``Σ I + m (|d|² E - d dᵀ)``."""
    parts = [(*_mass_and_tensor(s), s.shape.origin.matrix) for s in solids]
    mass = sum(m for m, _, _ in parts)
    center: npt.NDArray[np.float64] = np.sum([m * pose[:3, 3] for m, _, pose in parts], axis=0) / mass
    tensor = np.zeros((3, 3))
    for m, own, pose in parts:
        d = pose[:3, 3] - center
        tensor += pose[:3, :3] @ own @ pose[:3, :3].T + m * (d @ d * np.eye(3) - np.outer(d, d))
    xx, xy, xz, yy, yz, zz = (float(f"{tensor[i, j]:.6g}") for i in range(3) for j in range(i, 3))
    x, y, z = (round(float(c), 6) for c in center)
    return Inertia(float(f"{mass:.6g}"), (xx, xy, xz, yy, yz, zz), shift(x, y, z))


def _mass_and_tensor(solid: MaterialShape) -> tuple[float, npt.NDArray[np.float64]]:
    """Return the mass [kg], and the inertia about the centre in axes of the shape [kg m²]."""
    geometry = solid.shape.geometry
    if isinstance(geometry, Cylinder):
        r, length = geometry.radius, geometry.length
        mass = solid.density * np.pi * r**2 * length
        across = mass * (3 * r**2 + length**2) / 12
        return mass, np.diag([across, across, mass * r**2 / 2])
    assert isinstance(geometry, Box)
    a, b, c = geometry.size
    mass = solid.density * a * b * c
    return mass, mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])


@dataclass(frozen=True, slots=True)
class Style:
    """Materials and handles of a kitchen."""

    front: Material
    tall_front: Material
    carcass: Material
    counter_material: Material
    bar: Material  # material of the handles
    round_bar: bool  # True for round bars, False for square ones
    thickness: float  # of a bar [m]
    clearance: float  # between bar and front [m]
    length: float  # largest length of a bar [m]; fronts that are narrower have shorter ones
    travel: float  # travel of the drawers [m]
    plinth: float  # height [m]
    counter: float
    worktop: float
    top: float
    wall_cupboards: float  # height of the lower edge of wall cupboards [m]


class KitchenBuilder:
    """Builder of a kitchen whose names are below a prefix."""

    def __init__(self, prefix: str | None, style: Style) -> None:
        self._prefix = prefix
        self.style = style
        self.operations: list[Operation] = []

    def full_name(self, name: str) -> str:
        """Return a name with the prefix; the world has none."""
        return f"{self._prefix}/{name}" if self._prefix and name != WORLD else name

    def fixed(
        self,
        name: str,
        parent: str,
        pose: Pose,
        solids: Iterable[MaterialShape] = (),
        decoration: Iterable[MaterialShape] = (),
    ) -> None:
        """Add a frame that is fixed in its parent, with the body of solids if there are some."""
        solids = tuple(solids)
        body = furniture_body(solids, decoration) if solids else None
        self.operations.append(AddFrame(self.full_name(name), Frame(self.full_name(parent), (pose,)), body))

    def joint(
        self,
        kind: type[Joint],
        name: str,
        parent: str,
        origin: Pose,
        solids: Iterable[MaterialShape],
        **fields: Any,
    ) -> None:
        """Add a joint, whose child frame has its name and carries the body of solids."""
        full = self.full_name(name)
        joint = kind(name=full, parent=self.full_name(parent), child=full, origin=origin, **fields)
        self.operations += [joint, SetBody(full, furniture_body(solids))]

    def mechanism(
        self, kind: type[Mechanism], name: str, parent: str, origin: Pose, density: float, **fields: Any
    ) -> None:
        """Add a mechanism whose bodies have the mass of their shapes at a density [kg/m³]."""
        mechanism = kind(name=self.full_name(name), parent=self.full_name(parent), origin=origin, **fields)
        self.operations.append(mechanism)
        for part, made in mechanism.parts().items():
            if made.shapes:
                body = furniture_body(MaterialShape(shape, density) for shape in made.shapes)
                self.operations.append(Override(SetBody(mechanism.path(part), body)))


_WHITE, _CREAM = Material((0.94, 0.94, 0.92, 1.0), 680.0), Material((0.91, 0.88, 0.80, 1.0), 680.0)
_SAGE, _NAVY = Material((0.55, 0.64, 0.57, 1.0), 680.0), Material((0.22, 0.30, 0.42, 1.0), 680.0)
_GREY, _OAK = Material((0.50, 0.52, 0.54, 1.0), 680.0), Material((0.76, 0.60, 0.42, 1.0), 620.0)
_CLAY, _WALNUT = Material((0.70, 0.47, 0.38, 1.0), 680.0), Material((0.46, 0.32, 0.23, 1.0), 640.0)
_STONE, _SLATE = Material((0.72, 0.71, 0.69, 1.0), 1500.0), Material((0.28, 0.29, 0.31, 1.0), 1500.0)
_FRONTS = ((_WHITE, _OAK), (_SAGE, _CREAM), (_NAVY, _WHITE), (_GREY, _WHITE), (_OAK, _WHITE), (_CLAY, _CREAM))
_COUNTERS = (_OAK, _WALNUT, _STONE, _SLATE)
_BARS = (BAR, BLACK_BAR, BRASS_BAR)


def draw_style(rng: np.random.Generator) -> Style:
    """Return a style; handles are 8 to 16 mm thick, 25 to 45 mm off the front, and at most .4 m long."""
    front, tall = _FRONTS[int(rng.integers(len(_FRONTS)))]
    counter = round(float(rng.uniform(0.84, 0.89)), 3)
    worktop = round(counter + float(rng.choice((0.02, 0.03, 0.04))), 3)
    return Style(
        front=front,
        tall_front=front if rng.random() < 0.6 else tall,
        carcass=_CREAM,
        counter_material=_COUNTERS[int(rng.integers(len(_COUNTERS)))],
        bar=_BARS[int(rng.integers(len(_BARS)))],
        round_bar=bool(rng.random() < 0.5),
        thickness=round(float(rng.uniform(0.008, 0.016)), 4),
        clearance=round(float(rng.uniform(0.025, 0.045)), 4),
        length=round(float(rng.uniform(0.12, 0.4)), 3),
        travel=round(float(rng.uniform(0.35, 0.5)), 2),
        plinth=round(float(rng.uniform(0.08, 0.12)), 3),
        counter=counter,
        worktop=worktop,
        top=round(float(rng.uniform(2.0, 2.2)), 3),
        wall_cupboards=round(worktop + float(rng.uniform(0.45, 0.55)), 3),
    )
