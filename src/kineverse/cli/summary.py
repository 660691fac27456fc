"""A model in numbers and names, for people and for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.cli.contacts import contacts
from kineverse.formats.document import document_hash
from kineverse.geometry import Closest
from kineverse.geometry.pieces import touched_by_what_is_seen
from kineverse.model.constraint import Constraint
from kineverse.model.view import ModelView
from kineverse.reasoning import Interlocks, interlocks
from kineverse.symbols import Symbol
from kineverse.view.parts import parts
from kineverse.view.poses import Poses, complete
from kineverse.view.surfaces import Surfaces
from kineverse.view.units import units


@dataclass(frozen=True, slots=True)
class Freedom:
    """A degree of freedom: its limits and default [unit], and the limit of its speed [unit/s]."""

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    speed: float


@dataclass(frozen=True, slots=True)
class Condition:
    """A constraint as text; ``simple`` if it bounds a single symbol by numbers."""

    name: str
    text: str
    symbols: list[str]
    simple: bool


@dataclass(frozen=True, slots=True)
class Summary:
    """What a model consists of.

    ``frames`` are the parents by name; ``low``, ``high`` and ``extent`` the box around all shapes at the
    default state [m]; ``mass`` that of all bodies [kg]; ``problems`` what could not be loaded; ``unplaced``
    the frames whose pose there is not finite, which the box leaves out; ``interlocks`` what locks what;
    ``touched_as_seen`` the bodies without collision shapes, for which distances are to hulls of what is seen;
    ``contacts`` the pairs that touch at the default state, deepest first, None if nobody can say;
    ``sha256`` the hash of the content if the model is from a document, else empty.
    """

    name: str
    frames: dict[str, str]
    freedoms: list[Freedom]
    constraints: list[Condition]
    low: list[float]
    high: list[float]
    extent: list[float]
    mass: float
    shapes: int
    problems: list[str]
    unplaced: list[str]
    interlocks: Interlocks
    touched_as_seen: list[str]
    contacts: Sequence[Closest] | None
    sha256: str


def summarise(name: str, model: ModelView) -> Summary:
    """Return the summary of a model; reads its meshes for the size."""
    values = complete(model)
    poses = Poses(model)
    places = poses.at(values)
    unplaced = poses.unplaced(places)
    at = dict(zip(poses.names, places, strict=True))
    for frame in unplaced:
        del at[frame]
    shown = parts(model)
    loaded = [part for part in shown if not part.placeholder and part.frame in at]
    corners = Surfaces.of(loaded, at).corners.reshape(-1, 3)
    if not len(corners):
        corners = np.array([pose[:3, 3] for pose in at.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    free = model.degrees_of_freedom
    unit = units(model, values, [str(symbol) for symbol in free])
    masses = (body.inertia.mass for body in model.bodies.values() if body.inertia is not None)
    return Summary(
        name=name,
        frames={frame: model.frames[frame].parent for frame in model.frames},
        freedoms=[_freedom(model, symbol, unit[str(symbol)], values[str(symbol)]) for symbol in free],
        constraints=[_condition(key, constraint) for key, constraint in model.constraints.items()],
        low=low.tolist(),
        high=high.tolist(),
        extent=(high - low).tolist(),
        mass=float(sum(masses)),
        shapes=len(shown),
        problems=sorted(part.frame for part in shown if part.problem),
        unplaced=unplaced,
        interlocks=interlocks(model),
        touched_as_seen=touched_by_what_is_seen(model),
        contacts=contacts(model),
        sha256=document_hash(model) if name.endswith((".kv.json", ".kv.msgpack")) else "",
    )


def _freedom(model: ModelView, symbol: Symbol, unit: str, default: float) -> Freedom:
    lower, upper = model.limits(symbol)
    slowest, fastest = model.limits(symbol.derivative())
    return Freedom(str(symbol), unit, lower, upper, default, max(abs(slowest), abs(fastest)))


def _condition(name: str, constraint: Constraint) -> Condition:
    bounds_are_numbers = not (constraint.lower.symbols or constraint.upper.symbols)
    only = constraint.expression.symbols[0] if len(constraint.expression.symbols) == 1 else None
    simple = bounds_are_numbers and only is not None and bool(constraint.expression == only)
    return Condition(
        name=name,
        text=f"{_bound(constraint.lower)} <= {constraint.expression!r} <= {_bound(constraint.upper)}",
        symbols=[str(symbol) for symbol in constraint.symbols],
        simple=simple,
    )


def _bound(expression: object) -> str:
    text = repr(expression)
    try:
        return f"{float(text):.4g}"
    except ValueError:
        return text
