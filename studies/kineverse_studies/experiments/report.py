"""Report of an experiment: tables, figures, JSON data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from kineverse.view.plots import Figure

Item = TypeVar("Item")
Cell = float | str


@dataclass(frozen=True)
class ReportTable:
    title: str
    head: tuple[str, ...]  # titles of the columns, with units
    rows: tuple[tuple[Cell, ...], ...]  # numbers or texts


@dataclass(frozen=True)
class Report:
    name: str
    title: str
    tables: tuple[ReportTable, ...]
    numbers: Mapping[str, Any]  # results as JSON data
    figure: Figure
    pictures: Mapping[str, Figure] = field(default_factory=dict)  # further pictures by name

    def __post_init__(self) -> None:
        object.__setattr__(self, "numbers", as_json(self.numbers))


def make_table(
    title: str, items: Iterable[Item], columns: Mapping[str, Callable[[Item], Cell]]
) -> ReportTable:
    rows = tuple(tuple(cell(item) for cell in columns.values()) for item in items)
    return ReportTable(title, tuple(columns), rows)


def format_fixed(value: float, digits: int = 2, scale: float = 1.0) -> str:
    return "-" if math.isnan(value) else f"{scale * value:.{digits}f}"


def format_yes(condition: bool) -> str:
    return "yes" if condition else "no"


def as_json(value: Any) -> Any:
    """Return a value as JSON data: numbers that are not finite are null, what is no data is its text."""
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: as_json(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [as_json(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, str) else str(value)
