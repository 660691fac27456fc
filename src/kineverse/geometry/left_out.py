"""What a scene does not look at, and why: shapes that cannot be used, pairs that are ignored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.util import find_spec

from kineverse.errors import FormatError, MissingExtraError, ValueRejectedError
from kineverse.model.body import Geometry, Mesh
from kineverse.model.view import ModelView

from .pieces import in_short, matches, touchable
from .rules import Rule, adjacent, allowed, rules_in
from .solids import solid_of
from .table import Flags

RIGID = "rigidly connected"
JOINED = "joined by an articulation"


def is_installed() -> bool:
    """Return whether the extra ``geometry`` is there; nothing is imported to find out."""
    return find_spec("coal") is not None


def unusable(model: ModelView) -> dict[tuple[str, int], str]:
    """Return the shapes that distances cannot be computed to, with the reason in one line.

    They are known by their body and number. A scene without them answers for all the others:
    ``Scene(model, leave_out=unusable(model))``.

    Raises
    ------
    MissingExtraError
        If coal is not installed.
    """
    known: dict[Geometry, str] = {}
    found: dict[tuple[str, int], str] = {}
    for name, body in model.bodies.items():
        for number, shape in enumerate(touchable(body)):
            if shape.geometry not in known:
                known[shape.geometry] = _problem(shape.geometry)
            if known[shape.geometry]:
                found[name, number] = known[shape.geometry]
    return found


def remarks(model: ModelView, problems: Mapping[tuple[str, int], str]) -> dict[str, str]:
    """Return what to call shapes that are left out, with the reason; without a number if no other is left."""
    count = Counter(name for name, _ in problems)
    found: dict[str, str] = {}
    for (name, number), why in problems.items():
        stays = count[name] < len(touchable(model.bodies[name]))
        found.setdefault(f"shape {number} of {name}" if stays else name, why)
    return found


def _problem(geometry: Geometry) -> str:
    try:
        solid_of(geometry)
    except MissingExtraError:
        raise
    except (FormatError, ValueRejectedError, OSError) as error:
        reason = in_short(error)
        return f"mesh {geometry.uri}: {reason}" if isinstance(geometry, Mesh) else reason
    return ""


class Ignored:
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
        self._rules = rules_in(model)
        self._number = {name: k for k, name in enumerate(bodies)}
        self._allowed = allowed(model, bodies, self._rules)
        self._adjacent = adjacent(model, bodies)

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
            if _is_about(rule, a, b) or _is_about(rule, b, a):
                return f"excepted: {rule.why}" if rule.why else "excepted by a rule"
        return ""


def _is_about(rule: Rule, one: str, other: str) -> bool:
    return matches(one, (rule.a,)) and matches(other, (rule.b,))
