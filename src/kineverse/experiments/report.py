"""Report of an experiment: tables, figures, JSON."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError
from kineverse.formats.files import replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


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
class Figure:
    """Picture that is drawn on demand.

    Attributes
    ----------
    draw
        Function that draws on an empty matplotlib figure.
    size
        Width and height [inch].
    """

    draw: Callable[[Canvas], None]
    size: tuple[float, float]

    def save(self, path: str | Path) -> None:
        """Write the picture to a file, in the format of its suffix.

        Raises
        ------
        MissingDependencyError
            If matplotlib is not installed.
        FormatError
            If the file cannot be written, or its suffix is unknown.
        """
        # Not with pyplot, which would search for a display and keep a reference to the figure.
        canvas = _matplotlib("matplotlib.figure").Figure(figsize=self.size, layout="constrained")
        self.draw(canvas)
        content = io.BytesIO()
        try:
            canvas.savefig(content, format=Path(path).suffix.removeprefix(".") or "png", dpi=150)
        except ValueError as error:
            raise FormatError(f"The figure cannot be written to '{path}': {error}") from None
        replace_file(Path(path), content.getvalue())


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


def _matplotlib(module: str) -> ModuleType:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingDependencyError(f"Figures need matplotlib: {install_command('figures')}") from None
