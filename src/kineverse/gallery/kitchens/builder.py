"""Builder of a kitchen: frames with bodies, and joints, in the style of one kitchen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from kineverse.articulations import Joint
from kineverse.articulations.mechanisms import Mechanism
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation
from kineverse.model.operations import AddFrame, Override, SetBody

from .solids import Material, MaterialShape, furniture_body


@dataclass(frozen=True, slots=True)
class Style:
    """Materials and handles of a kitchen."""

    front: Material
    tall_front: Material
    carcass: Material
    counter_material: Material
    bar: Material  # material of the handles
    round_bar: bool  # True for round bars, False for square ones
    thickness: float  # thickness of a bar, and the free space between bar and front [m]
    clearance: float
    length: float  # largest length of a bar [m]; fronts that are narrower have shorter ones
    travel: float  # travel of the drawers [m]
    plinth: float  # [m]
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
        self.operations.append(
            kind(name=full, parent=self.full_name(parent), child=full, origin=origin, **fields)
        )
        self.operations.append(SetBody(full, furniture_body(solids)))

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
