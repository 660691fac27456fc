"""Collision objects: the shapes of a model's bodies with their poses."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TypeAlias

from kineverse.errors import FormatError, InvalidValueError
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
"""What is left out: bodies by a name or pattern, or the shape of a body that has a number."""


@dataclass(frozen=True, slots=True, eq=False)
class CollisionObject:
    """One shape of a body, or one of the hulls that a mesh is decomposed into.

    Attributes
    ----------
    body
        The frame it moves with.
    number
        Its place among the shapes of the body.
    shape
        What it is, and where in the frame.
    triangles
        Whether a mesh is kept as triangles rather than as its convex hull.
    pose
        world_T_piece, the first three rows: a (3, 4) expression.
    hull
        The corners of the hull, (n, 3) in the frame of the shape [m]; None if it is the shape itself.
    """

    body: str
    number: int
    shape: Shape
    triangles: bool
    pose: Expression
    hull: Floats | None = None

    @property
    def moves(self) -> bool:
        """Whether its pose depends on any symbol."""
        return bool(self.pose.symbols)

    def solid(self) -> Solid:
        """Make what distances are computed to.

        Raises
        ------
        KineverseError
            Of the kind that the cause has, naming the body and the file.
        """
        try:
            if self.hull is not None:
                return solid_from_points(self.hull)
            return solid_from_geometry(self.shape.geometry, self.triangles)
        except OSError as error:
            raise FormatError(f"{self._described()}: {error}") from error
        except (FormatError, InvalidValueError) as error:
            raise type(error)(f"{self._described()}: {error}") from error

    def _described(self) -> str:
        geometry = self.shape.geometry
        what = f"mesh {geometry.uri}" if isinstance(geometry, Mesh) else geometry.kind
        return f"Shape {self.number} of body '{self.body}', {what}"


def collision_shapes(body: Body) -> tuple[Shape, ...]:
    """Return the shapes that stand for a body: the collision shapes, or else what is seen of it."""
    return body.collisions or body.visuals


def bodies_with_visual_collision(model: ModelView) -> list[str]:
    """Return the bodies without collision shapes, for which hulls of what is seen of them are taken."""
    return [name for name, body in model.bodies.items() if body.visuals and not body.collisions]


def matches_pattern(name: str, patterns: Iterable[str]) -> bool:
    """Return whether a name is, or matches, one of some patterns, in which ``*`` is any text."""
    return any(name == pattern or fnmatchcase(name, pattern) for pattern in patterns)


class CollisionObjects:
    """The pieces of a model at one version, and how to get to those of the next.

    Parameters
    ----------
    triangles, decomposed, leave_out
        Patterns of bodies whose meshes stay triangles, of those whose meshes are the hulls that they were
        decomposed into, and of those that have no pieces, or bodies with the number of a shape that has none.
    """

    def __init__(
        self, triangles: tuple[str, ...], decomposed: tuple[str, ...], leave_out: tuple[Exclusion, ...]
    ) -> None:
        self._triangles, self._decomposed = triangles, decomposed
        self._leave_out = tuple(name for name in leave_out if isinstance(name, str))
        self._without = frozenset(leave_out) - frozenset(self._leave_out)
        self._frames: Mapping[str, Frame] = {}
        self._bodies: Mapping[str, Body] = {}
        self._rates = b""
        self.by_body: dict[str, tuple[CollisionObject, ...]] = {}

    def forget(self) -> None:
        """Know nothing, as at the beginning."""
        self._frames, self._bodies, self._rates, self.by_body = {}, {}, b"", {}

    def follow(self, model: ModelView) -> bool:
        """Take over what is different in the model; return whether anything was.

        Pieces of bodies that are the same and that hang on the same frames stay the same objects.
        """
        frames, bodies, rates = dict(model.frames), dict(model.bodies), model.rates.key
        same = _UnchangedPoses(self._frames, frames) if rates == self._rates else None
        found: dict[str, tuple[CollisionObject, ...]] = {}
        for name, body in bodies.items():
            if matches_pattern(name, self._leave_out) or not collision_shapes(body):
                continue
            kept = self.by_body.get(name)
            if kept is None or self._bodies[name] is not body or same is None or not same.pose_of(name):
                kept = tuple(self._made(model, name, body))
            if kept:
                found[name] = kept
        changed = list(found.items()) != list(self.by_body.items())
        self._frames, self._bodies, self._rates, self.by_body = frames, bodies, rates, found
        return changed

    def _made(self, model: ModelView, name: str, body: Body) -> Iterator[CollisionObject]:
        world_T_body = model.fk(name)
        triangles = matches_pattern(name, self._triangles)
        decomposed = not triangles and matches_pattern(name, self._decomposed)
        for number, shape in enumerate(collision_shapes(body)):
            if (name, number) in self._without:
                continue
            pose = (world_T_body @ shape.origin.matrix)[:3]
            for hull in _decomposed_hulls(name, shape) if decomposed else (None,):
                yield CollisionObject(name, number, shape, triangles, pose, hull)


def _decomposed_hulls(name: str, shape: Shape) -> tuple[Floats | None, ...]:
    """Return the hulls that a mesh was decomposed into; None stands for the shape itself."""
    if not isinstance(shape.geometry, Mesh):
        return (None,)
    try:
        hulls = decomposition.find_hulls(shape.geometry)
    except (FormatError, InvalidValueError):  # It is said when the shape itself is needed.
        return (None,)
    if hulls is None:
        uri = shape.geometry.uri
        logger.warning(
            "Body '%s' has its convex hull for mesh %s: kineverse decompose has not seen it.", name, uri
        )
        return (None,)
    return hulls


class _UnchangedPoses:
    """Which frames are where they were: all up to the world are the very same."""

    def __init__(self, before: Mapping[str, Frame], after: Mapping[str, Frame]) -> None:
        self._before, self._after = before, after
        self._known = {WORLD: True}

    def pose_of(self, name: str) -> bool:
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


def summarize_error(error: Exception) -> str:
    """Return what an error says in one line, without where a file was looked for and what makes it found."""
    text = re.split(r" (?:Looked|Set) ", str(error), maxsplit=1)[0]
    first = (text.splitlines() or [type(error).__name__])[0]
    return " ".join(first.split())


def load_solids(pieces: Iterable[CollisionObject]) -> list[Solid]:
    """Make the solids of pieces.

    Raises
    ------
    KineverseError
        The one that is wrong, or if several are, one that lists them.
    """
    solids, errors = [], []
    for piece in pieces:
        try:
            solids.append(piece.solid())
        except (FormatError, InvalidValueError) as error:
            errors.append(error)
    if not errors:
        return solids
    advice = "Mend the model, or leave such bodies out: Scene(model, leave_out=[...])."
    if len(errors) == 1:
        raise type(errors[0])(f"{errors[0]} {advice}") from errors[0]
    lines = "\n".join(f"  {summarize_error(error)}" for error in errors[:_MAX_LISTED])
    if len(errors) > _MAX_LISTED:
        lines += f"\n  and {len(errors) - _MAX_LISTED} more"
    raise FormatError(f"{len(errors)} shapes cannot be used. {advice}\n{lines}") from errors[0]
