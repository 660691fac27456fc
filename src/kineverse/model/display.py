"""One-line text and HTML tables of model data, and the display of a whole model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from kineverse.errors import KineverseError
from kineverse.expressions.expression import Expression

from .articulation import Articulation
from .body import Body, Pose
from .constraint import Constraint
from .frame import WORLD, Frame

if TYPE_CHECKING:
    from kineverse._rich_display import Html

    from .model_view import ModelView

_ROWS = 20
_WIDTH = 100


def format_line(value: object) -> str:
    """Return a value of a model as one line of text."""
    if isinstance(value, Frame):
        moving = {str(s) for f in value.factors if isinstance(f, Expression) for s in f.symbols}
        return f"in {value.parent}" + (f", moved by {', '.join(sorted(moving))}" if moving else ", fixed")
    if isinstance(value, Constraint):
        return f"{_text(value.lower)} <= {_text(value.expression)} <= {_text(value.upper)}"
    if isinstance(value, Articulation):
        ends = f"{value.kind} from {value.parent} to {value.child}"
        return ends + (f", {', '.join(map(str, value.coordinates))}" if value.coordinates else "")
    if isinstance(value, Body):
        parts = [
            count_values(len(value.visuals), "visuals"),
            count_values(len(value.collisions), "collisions"),
        ]
        return ", ".join(parts + ([] if value.inertia is None else [f"{value.inertia.mass:g} kg"]))
    if isinstance(value, Mapping):
        return " + ".join(f"{_factor(factor)} · {speed}" for speed, factor in value.items()) or "0"
    return " ".join(_text(value).split())


def count_values(count: int, kind: str) -> str:
    """Return a number with the noun of a kind of values: ``1 constraint``, ``2 bodies``."""
    noun = {"bodies": "body", "data": "datum"}.get(kind, kind.removesuffix("s"))
    return f"{count} {noun if count == 1 else kind}"


def _text(value: object) -> str:
    if isinstance(value, Expression) and not value.symbols and not value.shape:
        return f"{float(value):g}"
    return repr(value) if not isinstance(value, Expression | Pose) else str(value)


def _factor(factor: object) -> str:
    text = _text(factor)
    return text if text.isidentifier() or text.replace(".", "").isdigit() else f"({text})"


def as_lines(title: str, rows: Iterable[tuple[str, object]], count: int) -> str:
    """Return a title and the first rows as lines of bounded width."""
    lines = [f"{title}{':' if count else ''}"]
    for name, value in islice(rows, _ROWS):
        line = f"  {name}: {format_line(value)}"
        lines.append(line if len(line) <= _WIDTH else f"{line[: _WIDTH - 1]}…")
    if count > _ROWS:
        lines.append(f"  ... {count - _ROWS} more")
    return "\n".join(lines)


def as_html(title: str, rows: Iterable[tuple[str, object]], count: int) -> Html:
    """Return the first rows as an HTML table."""
    from kineverse._rich_display import ROWS, html_table  # for start-up time

    shown = [(name, format_line(value)) for name, value in islice(rows, ROWS)]
    return html_table(title, ("name", "value"), shown, count)


class DofSummary(NamedTuple):
    """Degree of freedom: limits and default value [unit], and largest speed [unit/s]."""

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    speed: float


def summarize_freedoms(model: ModelView) -> list[DofSummary]:
    """Return the degrees of freedom with their units, limits and default values."""
    from .kinematics import infer_units  # for start-up time

    default = {str(symbol): value for symbol, value in model.default_state().items()}
    free = model.degrees_of_freedom
    units = infer_units(model, default, map(str, free))
    found = []
    for symbol in free:
        slowest, fastest = model.limits(symbol.derivative())
        name = str(symbol)
        numbers = (*model.limits(symbol), default[name], max(abs(slowest), abs(fastest)))
        found.append(DofSummary(name, units[name], *numbers))
    return found


def order_depth_first(frames: Mapping[str, str]) -> list[tuple[str, int]]:
    """Return frames, given with their parents, in depth-first order, each with its depth below the world."""
    children: dict[str, list[str]] = {}
    for name, parent in frames.items():
        children.setdefault(parent, []).append(name)
    found, stack = [], [(name, 0) for name in reversed(children.get(WORLD, []))]
    while stack:
        name, depth = stack.pop()
        found.append((name, depth))
        stack.extend((child, depth + 1) for child in reversed(children.get(name, [])))
    return found


_INDENTATION = "\u2003"  # a space that HTML keeps


def model_html(model: ModelView) -> Html:
    """Return the display of a model: its degrees of freedom, and, folded, the tree of frames and all data."""
    from kineverse._rich_display import element, folded, html_table  # for start-up time
    from kineverse.expressions.printing import format_number

    parts = [element("p", str(model))]
    if model.degrees_of_freedom:
        try:
            rows = [
                (name, unit, *map(format_number, rest)) for name, unit, *rest in summarize_freedoms(model)
            ]
            table = html_table("", ("DoF", *DofSummary._fields[1:]), rows)
        except KineverseError as error:  # such as a loop that does not close at the default state
            table = element("p", str(error))
        parts.append(folded(f"{len(model.degrees_of_freedom)} DoF", table))
    tree = order_depth_first({name: frame.parent for name, frame in model.frames.items() if name != WORLD})
    if tree:
        lines = [(_INDENTATION * depth + name, format_line(model.frames[name])) for name, depth in tree]
        parts.append(folded(count_values(len(tree), "frames"), html_table("", ("frame", ""), lines)))
    for kind in ("constraints", "articulations", "bodies", "data", "rates"):
        values = getattr(model, kind)
        if values:
            parts.append(folded(count_values(len(values), kind), values._repr_html_()))
    return element("div", *parts)
