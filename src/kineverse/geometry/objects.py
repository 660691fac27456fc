"""Collision objects: the shapes of a model's bodies with their poses."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from kineverse._names import matches_pattern
from kineverse.errors import FormatError, InvalidValueError, summarize_error
from kineverse.expressions.expression import Expression
from kineverse.model.body import Body, Mesh, Shape
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model_view import ModelView

from . import decomposition
from .mesh_files import Floats
from .shapes import Solid, solid_from_geometry, solid_from_points

_MAX_LISTED = 12

logger = logging.getLogger("kineverse.geometry")

Exclusion: TypeAlias = str | tuple[str, int]
"""Excluded bodies, by a name or pattern, or one shape of a body, by the body's name and the shape's index."""


def parse_exclusions(entries: Any) -> tuple[Exclusion, ...]:
    """Return the entries of ``leave_out=``: bodies, patterns, and single shapes (body, number)."""
    if isinstance(entries, str):
        return (entries,)
    result = tuple(entries) if isinstance(entries, Iterable) else (entries,)
    for entry in result:
        body, number = entry if isinstance(entry, tuple) and len(entry) == 2 else (entry, 0)
        if not isinstance(body, str) or not hasattr(number, "__index__"):
            raise InvalidValueError(
                f"leave_out= takes bodies, patterns, or shapes (body, number), not {entry!r:.80}."
            )
    return result


@dataclass(frozen=True, slots=True, eq=False)
class CollisionObject:
    """Shape of a body, or one of the convex hulls that a mesh is decomposed into."""

    body: str
    number: int  # of the shape, among the shapes of the body
    shape: Shape
    triangles: bool  # True if a mesh stays a triangle mesh rather than its convex hull
    body_pose: Expression  # world_T_body, (4, 4)
    moves: bool  # True if the pose depends on any symbol
    hull: Floats | None = None  # (n, 3) corners in the frame of the shape [m]; None for the shape itself

    def make_solid(self) -> Solid:
        """Make the solid of the object, for distance computation."""
        try:
            if self.hull is not None:
                return solid_from_points(self.hull)
            return solid_from_geometry(self.shape.geometry, self.triangles)
        except OSError as error:
            raise FormatError(f"{self._describe()}: {error}") from error
        except (FormatError, InvalidValueError) as error:
            raise type(error)(f"{self._describe()}: {error}") from error

    def _describe(self) -> str:
        geometry = self.shape.geometry
        what = f"mesh {geometry.uri}" if isinstance(geometry, Mesh) else geometry.kind
        return f"Shape {self.number} of body '{self.body}', {what}"


def collision_shapes(body: Body) -> tuple[Shape, ...]:
    """Return the collision shapes of a body, or its visual shapes if it has none."""
    return body.collisions or body.visuals


def bodies_with_visual_collision(model: ModelView) -> list[str]:
    """Return the bodies without collision shapes, which are represented by their visual shapes."""
    return [name for name, body in model.bodies.items() if body.visuals and not body.collisions]


class CollisionObjects:
    """Collision objects of a model, updated from version to version."""

    def __init__(
        self, triangles: tuple[str, ...], decomposed: tuple[str, ...], leave_out: tuple[Exclusion, ...]
    ) -> None:
        self._triangles, self._decomposed = triangles, decomposed
        self._excluded_bodies = tuple(name for name in leave_out if isinstance(name, str))
        self._excluded_shapes = frozenset(leave_out) - frozenset(self._excluded_bodies)
        self._frames: Mapping[str, Frame] = {}
        self._bodies: Mapping[str, Body] = {}
        self._rates = b""
        self.by_body: dict[str, tuple[CollisionObject, ...]] = {}

    def clear(self) -> None:
        """Forget all objects, as if newly constructed."""
        self._frames, self._bodies, self._rates, self.by_body = {}, {}, b"", {}

    def synchronize(self, model: ModelView) -> bool:
        """Rebuild the objects of bodies that have changed; return True if any has.

        A body that is unchanged, and whose frames up to the world are unchanged, keeps its objects.
        """
        frames, bodies, rates = dict(model.frames), dict(model.bodies), model.rates.key
        same = _UnchangedPoses(self._frames, frames) if rates == self._rates else None
        result: dict[str, tuple[CollisionObject, ...]] = {}
        for name, body in bodies.items():
            if matches_pattern(name, self._excluded_bodies) or not collision_shapes(body):
                continue
            kept = self.by_body.get(name)
            if kept is None or self._bodies[name] is not body or same is None or not same.contains(name):
                kept = tuple(self._make_objects(model, name, body))
            if kept:
                result[name] = kept
        changed = list(result.items()) != list(self.by_body.items())
        self._frames, self._bodies, self._rates, self.by_body = frames, bodies, rates, result
        return changed

    def _make_objects(self, model: ModelView, name: str, body: Body) -> Iterator[CollisionObject]:
        world_T_body = model.fk(name)
        moves = bool(world_T_body.symbols)
        triangles = matches_pattern(name, self._triangles)
        decomposed = not triangles and matches_pattern(name, self._decomposed)
        for number, shape in enumerate(collision_shapes(body)):
            if (name, number) in self._excluded_shapes:
                continue
            for hull in _decomposed_hulls(name, shape) if decomposed else (None,):
                yield CollisionObject(name, number, shape, triangles, world_T_body, moves, hull)


def _decomposed_hulls(name: str, shape: Shape) -> tuple[Floats | None, ...]:
    """Return the cached convex hulls of a mesh; None stands for the shape itself."""
    if not isinstance(shape.geometry, Mesh):
        return (None,)
    try:
        hulls = decomposition.find_hulls(shape.geometry)
    except (FormatError, InvalidValueError):  # The error is raised when the shape itself is needed.
        return (None,)
    if hulls is None:
        uri = shape.geometry.uri
        logger.warning(
            "Body '%s' has its convex hull for mesh %s: kineverse decompose has not seen it.", name, uri
        )
        return (None,)
    return hulls


class _UnchangedPoses:
    """Set of frames whose pose is unchanged: all frames up to the world are identical."""

    def __init__(self, before: Mapping[str, Frame], after: Mapping[str, Frame]) -> None:
        self._before, self._after = before, after
        self._known = {WORLD: True}

    def contains(self, name: str) -> bool:
        path = []
        while name not in self._known:
            path.append(name)
            frame = self._after[name]
            if self._before.get(name) is not frame:
                self._known[name] = False
                break
            name = frame.parent
        answer = self._known[name]
        self._known.update(dict.fromkeys(path, answer))
        return answer


def load_solids(objects: Iterable[CollisionObject]) -> list[Solid]:
    """Make the solids of collision objects."""
    solids, errors = [], []
    for item in objects:
        try:
            solids.append(item.make_solid())
        except (FormatError, InvalidValueError) as error:
            errors.append(error)
    if not errors:
        return solids
    advice = "Correct the model, or leave such bodies out: Scene(model, leave_out=[...])."
    if len(errors) == 1:
        raise type(errors[0])(f"{errors[0]} {advice}") from errors[0]
    lines = "\n".join(f"  {summarize_error(error, advice=False)}" for error in errors[:_MAX_LISTED])
    if len(errors) > _MAX_LISTED:
        lines += f"\n  and {len(errors) - _MAX_LISTED} more"
    raise FormatError(f"{len(errors)} shapes cannot be used. {advice}\n{lines}") from errors[0]
