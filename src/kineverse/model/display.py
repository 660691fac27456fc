"""One-line text and HTML tables of model data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice

from kineverse.expressions.expression import Expression

from .articulation import Articulation
from .body import Body, Pose
from .constraint import Constraint
from .frame import Frame

_ROWS = 20
_WIDTH = 100
_HTML_ROWS = 50


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
        parts = [_several(len(value.visuals), "visual"), _several(len(value.collisions), "collision")]
        return ", ".join(parts + ([] if value.inertia is None else [f"{value.inertia.mass:g} kg"]))
    if isinstance(value, Mapping):
        return " + ".join(f"{_factor(factor)} · {speed}" for speed, factor in value.items()) or "0"
    return " ".join(_text(value).split())


def count_values(count: int, kind: str) -> str:
    """Return a number with the noun of a kind of values: ``1 constraint``, ``2 bodies``."""
    noun = {"bodies": "body", "data": "datum"}.get(kind, kind.removesuffix("s"))
    return f"{count} {noun if count == 1 else kind}"


def _several(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


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


def as_html(title: str, rows: Iterable[tuple[str, object]], count: int) -> str:
    """Return the first rows as an HTML table."""
    shown = [(name, format_line(value)) for name, value in islice(rows, _HTML_ROWS)]
    more = f", the first {_HTML_ROWS}" if count > _HTML_ROWS else ""
    from kineverse.expressions.printing import html_table  # for start-up time

    return html_table(f"{title}{more}", ("name", "value"), shown)
