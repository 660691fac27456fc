"""Excluded shapes and pairs of bodies, with the reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.util import find_spec

from kineverse.errors import FormatError, InvalidValueError, MissingDependencyError
from kineverse.model.body import Geometry, Mesh
from kineverse.model.model_view import ModelView

from .broadphase import Flags
from .collision_filter import Rule, adjacent_pairs, allowed_pairs, read_rules
from .objects import collision_shapes, matches_pattern, summarize_error
from .shapes import solid_from_geometry

RIGID = "rigidly connected"
JOINED = "joined by an articulation"


def is_installed() -> bool:
    """Return whether the extra ``geometry`` is there; nothing is imported to find out."""
    return find_spec("coal") is not None


def find_unusable_shapes(model: ModelView) -> dict[tuple[str, int], str]:
    """Return the shapes that distances cannot be computed to, with the reason in one line.

    They are known by their body and number. A scene without them answers for all the others:
    ``Scene(model, leave_out=find_unusable_shapes(model))``.

    Raises
    ------
    MissingDependencyError
        If coal is not installed.
    """
    known: dict[Geometry, str] = {}
    found: dict[tuple[str, int], str] = {}
    for name, body in model.bodies.items():
        for number, shape in enumerate(collision_shapes(body)):
            if shape.geometry not in known:
                known[shape.geometry] = _find_problem(shape.geometry)
            if known[shape.geometry]:
                found[name, number] = known[shape.geometry]
    return found


def label_unusable_shapes(model: ModelView, problems: Mapping[tuple[str, int], str]) -> dict[str, str]:
    """Return what to call shapes that are left out, with the reason; without a number if no other is left."""
    count = Counter(name for name, _ in problems)
    found: dict[str, str] = {}
    for (name, number), why in problems.items():
        stays = count[name] < len(collision_shapes(model.bodies[name]))
        found.setdefault(f"shape {number} of {name}" if stays else name, why)
    return found


def _find_problem(geometry: Geometry) -> str:
    try:
        solid_from_geometry(geometry)
    except MissingDependencyError:
        raise
    except (FormatError, InvalidValueError, OSError) as error:
        reason = summarize_error(error)
        return f"mesh {geometry.uri}: {reason}" if isinstance(geometry, Mesh) else reason
    return ""


class ExcludedPairs:
    """The pairs of a model's bodies that its scenes do not look at.

    Parameters
    ----------
    model
        The model; what is said is about its version now.
    bodies
        The bodies that take part.
    """

    def __init__(self, model: ModelView, bodies: Sequence[str]) -> None:
        self._model = model
        self._rules = read_rules(model)
        self._number = {name: k for k, name in enumerate(bodies)}
        self._allowed = allowed_pairs(model, bodies, self._rules)
        self._adjacent = adjacent_pairs(model, bodies)

    @property
    def counts(self) -> tuple[int, int]:
        """How many pairs are looked at, and how many are not."""
        looked_at, bodies = int(self._allowed.sum()) // 2, len(self._number)
        return looked_at, bodies * (bodies - 1) // 2 - looked_at

    def why(self, a: str, b: str) -> str:
        """Return why a pair of bodies is not looked at; empty if it is."""
        if self._of(self._allowed, a, b):
            return ""
        if not self._of(self._adjacent, a, b):
            return self._rule(a, b)
        return JOINED if self._model.fk(a, b).symbols else RIGID

    def _of(self, table: Flags, a: str, b: str) -> bool:
        return bool(table[self._number[a], self._number[b]])

    def _rule(self, a: str, b: str) -> str:
        for rule in reversed(self._rules):
            if _rule_applies(rule, a, b) or _rule_applies(rule, b, a):
                return f"excepted: {rule.why}" if rule.why else "excepted by a rule"
        return ""


def _rule_applies(rule: Rule, one: str, other: str) -> bool:
    return matches_pattern(one, (rule.a,)) and matches_pattern(other, (rule.b,))
