"""The operation that says where an articulation is when nothing else is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kineverse.model.operation import Effects, Operation
from kineverse.model.reader import Reader


@dataclass(frozen=True)
class SetHome(Operation):
    """Gives the coordinates of an articulation the values they have at home [m], [rad]."""

    name: str
    home: tuple[float, ...]

    def apply(self, model: Reader) -> Effects:
        """Write the record of the articulation anew."""
        return Effects(articulations={self.name: replace(model.articulations[self.name], home=self.home)})

    def default_tag(self) -> str:
        """Return ``home`` and the name of the articulation."""
        return f"home {self.name}"
