"""Summary of a model: frames, degrees of freedom, constraints, extent, mass, contacts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.errors import KineverseError
from kineverse.expressions.printing import format_number
from kineverse.formats.document import document_hash
from kineverse.formats.validate import ModelProblem
from kineverse.geometry import DistanceResult, Scene
from kineverse.geometry.exclusions import find_unusable_shapes, is_installed
from kineverse.geometry.objects import bodies_with_visual_collision
from kineverse.geometry.shapes import import_coal
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView
from kineverse.reasoning import Interlocks, interlocks
from kineverse.symbols import Symbol
from kineverse.view.drawables import collect_drawables
from kineverse.view.poses import FramePoses, complete
from kineverse.view.rasterizer import TriangleSoup
from kineverse.view.sliders import infer_units

CONTACT_DEPTH = 1e-5
"""Depth below which bodies only touch, such as a drawer on its rail [m]."""


def find_contacts(model: ModelView) -> Sequence[DistanceResult] | None:
    """Return the touching or penetrating pairs at the default state, deepest first.

    Unusable shapes are left out. The result is None if the extra ``geometry`` is not installed, or poses at
    the default state are not finite.
    """
    if not is_installed():
        return None
    try:
        return _touching_pairs(model)
    except KineverseError:  # Poses that are not finite are reported separately.
        return None


def find_penetrations(model: ModelView) -> Iterator[ModelProblem]:
    """Yield the pairs of bodies that penetrate each other at the default state."""
    import_coal()
    for pair in find_contacts(model) or ():
        if pair.distance < -CONTACT_DEPTH:
            text = f"in {pair.b} by {format_number(-pair.distance, 3)} m at the default state"
            yield ModelProblem("contact", pair.a, text)


def _touching_pairs(model: ModelView) -> Sequence[DistanceResult]:
    scene = Scene(model, leave_out=find_unusable_shapes(model))
    scene.update(model.default_state())
    return scene.pairs_within(0.0)


@dataclass(frozen=True, slots=True)
class DofSummary:
    """Degree of freedom: limits and default value [unit], and largest speed [unit/s]."""

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    speed: float


@dataclass(frozen=True, slots=True)
class ConstraintSummary:
    """Constraint as text; ``simple`` is True if it bounds a single symbol by numbers."""

    name: str
    text: str
    symbols: list[str]
    simple: bool


@dataclass(frozen=True, slots=True)
class ModelSummary:
    """Contents of a model, for printing and JSON."""

    name: str  # name or path of the model, as given
    frames: dict[str, str]  # parents of the frames, by name
    freedoms: list[DofSummary]  # degrees of freedom
    constraints: list[ConstraintSummary]
    low: list[float]  # bounding box of all shapes at the default state [m]
    high: list[float]
    extent: list[float]
    mass: float  # mass of all bodies [kg]
    shapes: int  # number of visual shapes
    problems: list[str]  # frames of shapes that cannot be loaded
    unplaced: list[str]  # frames whose poses at the default state are not finite; the box leaves them out
    interlocks: Interlocks  # interlocks between coordinates
    touched_as_seen: list[str]  # bodies without collision shapes
    contacts: Sequence[DistanceResult] | None  # pairs that touch at the default state, deepest first
    sha256: str  # hash of the content if the model is a document, else empty


def summarize_model(name: str, model: ModelView) -> ModelSummary:
    """Return the summary of a model; meshes are read for their size."""
    values = complete(model)
    poses = FramePoses(model)
    matrices = poses.evaluate(values)
    unplaced = poses.unplaced(matrices)
    pose_of = dict(zip(poses.names, matrices, strict=True))
    for frame in unplaced:
        del pose_of[frame]
    drawables = collect_drawables(model)
    loaded = [part for part in drawables if not part.placeholder and part.frame in pose_of]
    corners = TriangleSoup.from_drawables(loaded, pose_of).corners.reshape(-1, 3)
    if not len(corners):
        corners = np.array([pose[:3, 3] for pose in pose_of.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    free = model.degrees_of_freedom
    unit = infer_units(model, values, [str(symbol) for symbol in free])
    masses = (body.inertia.mass for body in model.bodies.values() if body.inertia is not None)
    return ModelSummary(
        name=name,
        frames={frame: model.frames[frame].parent for frame in model.frames},
        freedoms=[_summarize_dof(model, symbol, unit[str(symbol)], values[str(symbol)]) for symbol in free],
        constraints=[_summarize_constraint(key, constraint) for key, constraint in model.constraints.items()],
        low=low.tolist(),
        high=high.tolist(),
        extent=(high - low).tolist(),
        mass=float(sum(masses)),
        shapes=len(drawables),
        problems=sorted(part.frame for part in drawables if part.problem),
        unplaced=unplaced,
        interlocks=interlocks(model),
        touched_as_seen=bodies_with_visual_collision(model),
        contacts=find_contacts(model),
        sha256=document_hash(model) if name.endswith((".kv.json", ".kv.msgpack")) else "",
    )


def _summarize_dof(model: ModelView, symbol: Symbol, unit: str, default: float) -> DofSummary:
    lower, upper = model.limits(symbol)
    slowest, fastest = model.limits(symbol.derivative())
    return DofSummary(str(symbol), unit, lower, upper, default, max(abs(slowest), abs(fastest)))


def _summarize_constraint(name: str, constraint: Constraint) -> ConstraintSummary:
    bounds_are_numbers = not (constraint.lower.symbols or constraint.upper.symbols)
    only = constraint.expression.symbols[0] if len(constraint.expression.symbols) == 1 else None
    simple = bounds_are_numbers and only is not None and bool(constraint.expression == only)
    return ConstraintSummary(
        name=name,
        text=(
            f"{_format_bound(constraint.lower)} <= {constraint.expression!r} <= "
            f"{_format_bound(constraint.upper)}"
        ),
        symbols=[str(symbol) for symbol in constraint.symbols],
        simple=simple,
    )


def _format_bound(expression: object) -> str:
    text = repr(expression)
    try:
        return f"{float(text):.4g}"
    except ValueError:
        return text
