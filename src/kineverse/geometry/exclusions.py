"""Excluded shapes and pairs of bodies, with the reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.util import find_spec

from kineverse._names import matches_pattern
from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError, summarize_error
from kineverse.model.basic_operations import Override, SetBody
from kineverse.model.body import Body, Geometry, Mesh
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView

from .broadphase import Flags
from .collision_filter import Rule, adjacent_pairs, allowed_pairs, read_rules
from .objects import collision_shapes
from .shapes import solid_from_geometry

RIGID = "rigidly connected"
JOINED = "joined by an articulation"


def is_installed() -> bool:
    """Return True if the extra ``geometry`` is installed, without importing it."""
    return find_spec("coal") is not None


def find_unusable_shapes(model: ModelView) -> dict[tuple[str, int], str]:
    """Return the shapes whose distances cannot be computed, with the reason in one line.

    The keys are body and index of the shape. A scene without these shapes answers for all others:
    ``Scene(model, leave_out=find_unusable_shapes(model))``.
    """
    known: dict[Geometry, str] = {}
    result: dict[tuple[str, int], str] = {}
    for name, body in model.bodies.items():
        for number, shape in enumerate(collision_shapes(body)):
            if shape.geometry not in known:
                known[shape.geometry] = _find_problem(shape.geometry)
            if known[shape.geometry]:
                result[name, number] = known[shape.geometry]
    return result


def label_unusable_shapes(model: ModelView, problems: Mapping[tuple[str, int], str]) -> dict[str, str]:
    """Label excluded shapes, with the reasons; by the body's name if all its shapes are excluded."""
    count = Counter(name for name, _ in problems)
    result: dict[str, str] = {}
    for (name, number), why in problems.items():
        stays = count[name] < len(collision_shapes(model.bodies[name]))
        result.setdefault(f"shape {number} of {name}" if stays else name, why)
    return result


def remove_unusable_shapes(model: Model) -> tuple[str, ...]:
    """Remove shapes whose files are missing, and return their labels with the reasons."""
    unusable = find_unusable_shapes(model)
    with model.edit() as edit:
        for name in dict.fromkeys(name for name, _ in unusable):
            body = model.bodies[name]
            # The shapes that collide are those for the eye if there are no others.
            left = tuple(s for k, s in enumerate(collision_shapes(body)) if (name, k) not in unusable)
            edit.apply(Override(SetBody(name, Body(left, left, body.inertia))))
    return tuple(f"{name}: {why}" for name, why in label_unusable_shapes(model, unusable).items())


def _find_problem(geometry: Geometry) -> str:
    try:
        solid_from_geometry(geometry)
    except MissingDependencyError:
        raise
    except (FormatError, InvalidValueError, OSError) as error:
        reason = summarize_error(error, advice=False)
        return f"mesh {geometry.uri}: {reason}" if isinstance(geometry, Mesh) else reason
    return ""


class ExcludedPairs:
    """Pairs of a model's bodies that its collision filter excludes, with the reasons."""

    def __init__(self, model: ModelView, bodies: Sequence[str]) -> None:
        self._model = model
        self._rules = read_rules(model)
        self._number = {name: k for k, name in enumerate(bodies)}
        self._allowed = allowed_pairs(model, bodies, self._rules)
        self._adjacent = adjacent_pairs(model, bodies)

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of checked pairs and of excluded pairs."""
        looked_at, bodies = int(self._allowed.sum()) // 2, len(self._number)
        return looked_at, bodies * (bodies - 1) // 2 - looked_at

    def reason(self, a: str, b: str) -> str:
        """Return the reason for which a pair of bodies is excluded; empty if it is checked."""
        if self._is_set(self._allowed, a, b):
            return ""
        if not self._is_set(self._adjacent, a, b):
            return self._rule_reason(a, b)
        return JOINED if self._model.fk(a, b).symbols else RIGID

    def _is_set(self, table: Flags, a: str, b: str) -> bool:
        return bool(table[self._number[a], self._number[b]])

    def _rule_reason(self, a: str, b: str) -> str:
        for rule in reversed(self._rules):
            if _rule_applies(rule, a, b) or _rule_applies(rule, b, a):
                return f"excepted: {rule.why}" if rule.why else "excepted by a rule"
        return ""


def _rule_applies(rule: Rule, one: str, other: str) -> bool:
    return matches_pattern(one, (rule.a,)) and matches_pattern(other, (rule.b,))
