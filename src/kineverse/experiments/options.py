"""What can be said about how an experiment is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from kineverse.errors import ValueRejectedError


@dataclass(frozen=True)
class Options:
    """What is asked of an experiment beside its name; each takes some of these.

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
        ValueRejectedError
            If not, with what it takes.
        """
        given = [field.name for field in fields(self) if getattr(self, field.name) != field.default]
        for option in given:
            if option not in taken:
                takes = ", ".join(f"--{known}" for known in taken) or "none"
                raise ValueRejectedError(f"The experiment '{name}' takes no --{option}. It takes {takes}.")
