"""Report of an experiment: tables, figures, JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kineverse.view.plots import Figure


@dataclass(frozen=True)
class ReportTable:
    """Table of a report.

    Attributes
    ----------
    title
        Title of the table.
    head
        Titles of the columns, with units.
    rows
        Rows of cells, numbers or texts.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[float | str, ...], ...]


@dataclass(frozen=True)
class Report:
    """Measurements of an experiment.

    Attributes
    ----------
    name, title
        Name and title of the experiment.
    tables
        Tables to print.
    numbers
        Results as JSON data.
    figure
        Picture of the results.
    pictures
        Further pictures by name.
    """

    name: str
    title: str
    tables: tuple[ReportTable, ...]
    numbers: Mapping[str, Any]
    figure: Figure
    pictures: Mapping[str, Figure] = field(default_factory=dict)
