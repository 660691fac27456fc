"""Builder of scenes: joints, frames and loops with bodies, below a prefix."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from kineverse.articulations import Joint
from kineverse.articulations.mechanisms import Mechanism
from kineverse.expressions.expression import Expression
from kineverse.loops import CloseLoop
from kineverse.model.basic_operations import AddFrame, SetBody
from kineverse.model.body import Body, Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import Operation
from kineverse.spatial import translation
from kineverse.symbols import Symbol, position

from .shapes import Shapes


class SceneBuilder:
    """Builder of a scene, whose names are below a prefix."""

    def __init__(self, prefix: str | None = None) -> None:
        self._prefix = prefix
        self.operations: list[Operation] = []

    def full_name(self, name: str) -> str:
        """Return a name with the prefix; the world has none."""
        return f"{self._prefix}/{name}" if self._prefix and name != WORLD else name

    def position(self, name: str) -> Symbol:
        """Return the coordinate with a name."""
        return position(self.full_name(name))

    def joint(
        self,
        kind: type[Joint],
        name: str,
        *shapes: Shapes,
        parent: str = WORLD,
        at: Sequence[float] | Expression = (0.0, 0.0, 0.0),
        **fields: Any,
    ) -> None:
        """Add a joint, whose child frame has the name of the joint and carries shapes.

        ``at`` is its origin in the parent: a point [m], or a transform.
        """
        origin = Pose.from_matrix(at if isinstance(at, Expression) else translation(*at))
        for field in ("driver", "left", "right"):
            if isinstance(fields.get(field), str):
                fields[field] = self.full_name(fields[field])
        full = self.full_name(name)
        self.operations.append(
            kind(name=full, parent=self.full_name(parent), child=full, origin=origin, **fields)
        )
        if shapes:
            self.operations.append(SetBody(full, Body(visuals=sum(shapes, ()))))

    def mechanism(self, kind: type[Mechanism], name: str, **fields: Any) -> None:
        """Add a mechanism with its frames and bodies."""
        self.operations.append(kind(name=self.full_name(name), parent=WORLD, **fields))

    def frame(
        self,
        name: str,
        *shapes: Shapes,
        parent: str = WORLD,
        at: Sequence[float] | Expression = (0.0, 0.0, 0.0),
    ) -> None:
        """Add a frame with shapes that is fixed in its parent."""
        where = at if isinstance(at, Expression) else translation(*at)
        body = Body(visuals=sum(shapes, ())) if shapes else None
        self.operations.append(
            AddFrame(self.full_name(name), Frame.from_transform(self.full_name(parent), where), body)
        )

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
        """Close a loop: two frames coincide, see :class:`kineverse.CloseLoop`."""
        loop = CloseLoop(
            name=self.full_name(name),
            frame=self.full_name(frame),
            to=self.full_name(to),
            mask=mask,
            home=tuple((self.full_name(n), value) for n, value in (home or {}).items()),
            dependent=None if dependent is None else tuple(map(self.full_name, dependent)),
            more=tuple((self.full_name(a), self.full_name(b)) for a, b in more),
            **options,
        )
        self.operations.append(loop)


Build: TypeAlias = Callable[[SceneBuilder], None]
"""Function that builds a scene; its name is that of the scene."""
