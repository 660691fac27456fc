"""Experiments by name, and their options."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from kineverse.errors import InvalidValueError, UnknownNameError, suggest

from .report import Report


@dataclass(frozen=True)
class Options:
    """Options of experiments; each takes some of these.

    Attributes
    ----------
    quick
        A part of it, in seconds.
    data
        The folder of the recordings that it is about.
    model
        The model that it is about, a name or path.
    """

    quick: bool = False
    data: Path | None = None
    model: str | None = None

    def check(self, name: str, taken: Sequence[str]) -> None:
        """Look whether an experiment takes what was given.

        Raises
        ------
        InvalidValueError
            If not, with what it takes.
        """
        given = [field.name for field in fields(self) if getattr(self, field.name) != field.default]
        for option in given:
            if option not in taken:
                takes = ", ".join(f"--{known}" for known in taken) or "none"
                raise InvalidValueError(f"The experiment '{name}' takes no --{option}. It takes {takes}.")


Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]

EXPERIMENTS: Mapping[str, str] = MappingProxyType(
    {
        "fig3": "the garage door and its lock (2022 paper, Fig. 3 and Eqs. 11-13)",
        "fig4": "a kitchen tracked from poses of its parts (2022 paper, Fig. 4; 2020 paper, IV-A)",
        "sturm": "hinges and sliders learned from recordings of doors and drawers (--data FOLDER)",
        "estimation-grid": "hinges and sliders learned from noisy poses, against the Cramér-Rao bound",
    }
)
"""Names of experiments: the modules of this package, with a dash for an underscore."""


def reproduce(name: str, progress: Progress | None = None, options: Options | None = None) -> Report:
    """Run an experiment.

    Parameters
    ----------
    name
        One of :data:`EXPERIMENTS`.
    progress
        Wraps what is worked on, like :func:`kineverse.cli.output.show_progress`; None for silence.
    options
        How it is made; None for the defaults.

    Raises
    ------
    UnknownNameError
        If there is no such experiment, with similar names.
    InvalidValueError
        If it does not take an option.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError(
            f"There is no experiment {name!r}. {suggest(name, EXPERIMENTS, 'experiment')} "
            "'kineverse reproduce --list' says what each is about."
        )
    module = importlib.import_module(f"{__package__}.{name.replace('-', '_')}")
    options = options or Options()
    options.check(name, module.OPTIONS)
    report: Report = module.run(progress or _no_progress, options)
    return report


def _no_progress(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items
