"""The experiments by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

from kineverse.errors import UnknownNameError, suggest

from .options import Options
from .report import Report

Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]

EXPERIMENTS: Mapping[str, str] = MappingProxyType(
    {
        "fig3": "the garage door and its lock (2022 paper, Fig. 3 and Eqs. 11-13)",
        "fig4": "a kitchen tracked from poses of its parts (2022 paper, Fig. 4; 2020 paper, IV-A)",
        "sturm": "hinges and sliders learned from recordings of doors and drawers (--data FOLDER)",
        "estimation-grid": "hinges and sliders learned from noisy poses, against the Cramér-Rao bound",
    }
)
"""What there is; each name is that of a module of this package, with an underscore for a dash."""


def reproduce(name: str, progress: Progress | None = None, options: Options | None = None) -> Report:
    """Run an experiment.

    Parameters
    ----------
    name
        One of :data:`EXPERIMENTS`.
    progress
        Wraps what is worked on, like :func:`kineverse.cli.progress.progress`; None for silence.
    options
        How it is made; None for the defaults.

    Raises
    ------
    UnknownNameError
        If there is no such experiment, with similar names.
    ValueRejectedError
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
    report: Report = module.run(progress or _silent, options)
    return report


def _silent(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items
