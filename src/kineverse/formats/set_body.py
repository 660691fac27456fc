"""The operation that gives a frame what descriptions attach to it."""

from __future__ import annotations

from dataclasses import dataclass

from kineverse.model.body import Body
from kineverse.model.frame import WORLD
from kineverse.model.operation import Effects, Operation
from kineverse.model.reader import Reader


@dataclass(frozen=True)
class SetBody(Operation):
    """Gives a frame its body: what of it is seen and touched, and its inertia."""

    name: str
    body: Body

    def apply(self, model: Reader) -> Effects:
        """Write the body."""
        if self.name != WORLD and self.name not in model.frames:
            model.frames[self.name]  # raises, with similar names
        return Effects(bodies={self.name: self.body})

    def default_tag(self) -> str:
        """Return ``body`` and the name of the frame."""
        return f"body {self.name}"


def is_empty(body: Body) -> bool:
    """Return whether there is nothing to give."""
    return not body.visuals and not body.collisions and body.inertia is None
