"""A scene in the making: joints, frames and loops with the bodies that show them, below a prefix."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from kineverse.articulations import Joint
from kineverse.articulations.mechanisms import Mechanism
from kineverse.expressions.expression import Expression
from kineverse.loops import CloseLoop
from kineverse.model.body import Body, Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation
from kineverse.model.operations import AddFrame, SetBody
from kineverse.spatial import translation
from kineverse.symbols import Symbol, position

from .shapes import Shapes


class SceneBuilder:
    """Collects operations whose names it puts below a prefix.

    Attributes
    ----------
    operations
        What was put into it, in order.
    """

    def __init__(self, prefix: str | None = None) -> None:
        self._prefix = prefix
        self.operations: list[Operation] = []

    def named(self, name: str) -> str:
        """Return the full name of something; the world is the world."""
        return f"{self._prefix}/{name}" if self._prefix and name != WORLD else name

    def position(self, name: str) -> Symbol:
        """Return the coordinate of a name."""
        return position(self.named(name))

    def joint(
        self,
        kind: type[Joint],
        name: str,
        *shapes: Shapes,
        parent: str = WORLD,
        at: Sequence[float] | Expression = (0.0, 0.0, 0.0),
        **fields: Any,
    ) -> None:
        """Put a joint into the scene, whose child has its name and carries shapes.

        ``at`` is where it is in its parent: a point [m], or a transform.
        """
        origin = Pose.of(at if isinstance(at, Expression) else translation(*at))
        for field in ("driver", "left", "right"):
            if isinstance(fields.get(field), str):
                fields[field] = self.named(fields[field])
        full = self.named(name)
        self.operations.append(
            kind(name=full, parent=self.named(parent), child=full, origin=origin, **fields)
        )
        if shapes:
            self.operations.append(SetBody(full, Body(visuals=sum(shapes, ()))))

    def mechanism(self, kind: type[Mechanism], name: str, **fields: Any) -> None:
        """Put a mechanism into the scene, which brings its frames and bodies."""
        self.operations.append(kind(name=self.named(name), parent=WORLD, **fields))

    def frame(
        self,
        name: str,
        *shapes: Shapes,
        parent: str = WORLD,
        at: Sequence[float] | Expression = (0.0, 0.0, 0.0),
    ) -> None:
        """Put a frame into the scene that is fixed in its parent, with shapes."""
        where = at if isinstance(at, Expression) else translation(*at)
        body = Body(visuals=sum(shapes, ())) if shapes else None
        self.operations.append(AddFrame(self.named(name), Frame.of(self.named(parent), where), body))

    def loop(
        self,
        name: str,
        frame: str,
        to: str,
        mask: tuple[str, ...] = ("x", "y", "z"),
        *,
        home: Mapping[str, float] | None = None,
        dependent: Sequence[str] | None = None,
        more: Sequence[tuple[str, str]] = (),
        **options: Any,
    ) -> None:
        """Let two frames coincide, see :class:`kineverse.CloseLoop`."""
        loop = CloseLoop(
            name=self.named(name),
            frame=self.named(frame),
            to=self.named(to),
            mask=mask,
            home=tuple((self.named(n), value) for n, value in (home or {}).items()),
            dependent=None if dependent is None else tuple(map(self.named, dependent)),
            more=tuple((self.named(a), self.named(b)) for a, b in more),
            **options,
        )
        self.operations.append(loop)


Build: TypeAlias = Callable[[SceneBuilder], None]
"""What puts everything into a scene; its name is that of the scene."""
