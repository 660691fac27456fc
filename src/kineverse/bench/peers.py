"""The peers: other people's libraries, which may be missing."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from .timing import Contender

DISTRIBUTIONS: Mapping[str, str] = MappingProxyType(
    {"pinocchio": "pin", "mujoco": "mujoco", "casadi": "casadi", "packaging": "packaging"}
)
"""What brings each module."""

EXTRA = "pip install 'kineverse-articulation[bench]'"


@dataclass(slots=True)
class Field:
    """Who takes part in a race, and who is missing.

    Attributes
    ----------
    contenders
        Who takes part.
    missing
        A line for everybody else.
    """

    contenders: list[Contender] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def admit(self, module: str, contenders: Callable[[], Iterable[Contender]]) -> None:
        """Add the contenders of a peer, or the line that says that it is missing."""
        if installed(module):
            self.contenders += contenders()
        else:
            self.missing.append(advice(module))


def installed(module: str) -> bool:
    """Whether a peer can be imported."""
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def advice(module: str) -> str:
    """Return how to get a peer."""
    distribution = DISTRIBUTIONS.get(module, module)
    called = "" if distribution == module else f" (the package {distribution!r})"
    return f"{module} is missing: {EXTRA} brings it{called}"
