"""Report of an experiment: tables, figures, JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from kineverse._extras import install_command
from kineverse.errors import FormatError, MissingDependencyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True)
class ReportTable:
    """Rows of cells, numbers or texts.

    Attributes
    ----------
    title
        What they are about.
    head
        The titles of the columns, with units.
    rows
        The cells.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[float | str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """A picture that is drawn when it is wanted.

    Attributes
    ----------
    draw
        Draws on an empty canvas of matplotlib.
    size
        Width and height [inch].
    """

    draw: Callable[[Canvas], None]
    size: tuple[float, float]

    def save(self, path: Path) -> None:
        """Write the picture to a file; its suffix says how.

        Raises
        ------
        MissingDependencyError
            Without matplotlib.
        FormatError
            If the file cannot be written, or in no format of that suffix.
        """
        # Without pyplot: it would look for a screen, and keep the figure.
        canvas = _matplotlib("matplotlib.figure").Figure(figsize=self.size, layout="constrained")
        self.draw(canvas)
        try:
            canvas.savefig(path, dpi=150)
        except (OSError, ValueError) as error:
            raise FormatError(f"The figure cannot be written to '{path}': {error}") from None


@dataclass(frozen=True)
class Report:
    """Measurements of an experiment.

    Attributes
    ----------
    name, title
        Its name, and what it is about.
    tables
        For people.
    numbers
        For programs: plain values, lists and mappings of these, as JSON has them.
    figure
        The picture.
    """

    name: str
    title: str
    tables: tuple[ReportTable, ...]
    numbers: Mapping[str, Any]
    figure: Figure


def check_drawing() -> None:
    """Look whether figures can be drawn here.

    Raises
    ------
    MissingDependencyError
        Without matplotlib.
    """
    _matplotlib("matplotlib.figure")


def _matplotlib(module: str) -> ModuleType:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingDependencyError(f"Figures need matplotlib: {install_command('figures')}") from None
