"""The peers: other people's libraries, which may be missing."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from kineverse.installation import install_command

from .timing import Contender

DISTRIBUTIONS: Mapping[str, str] = MappingProxyType(
    {"pinocchio": "pin", "ripl_articulation": "ripl-articulation"}
)
"""What brings a module that is called otherwise."""

IN_THE_EXTRA = ("pinocchio", "mujoco", "pybullet")
"""The modules that the extra ``bench`` brings."""


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
        with _ungreeted() if module == "pybullet" else contextlib.nullcontext():
            peer = importlib.import_module(module)
    except ImportError:
        return False
    if module == "mujoco" and peer.get_mju_user_warning() is None:
        peer.set_mju_user_warning(_unheard)
    return True


def _unheard(warning: str) -> None:
    """Take a warning of MuJoCo, which would leave it in a file in the current folder."""


def advice(module: str) -> str:
    """Return how to get a peer."""
    distribution = DISTRIBUTIONS.get(module, module)
    if module in IN_THE_EXTRA:
        called = "" if distribution == module else f" (the package {distribution!r})"
        return f"{module} is not installed: {install_command('bench')} brings it{called}"
    return f"{module} is not installed: it is the package {distribution!r}"


@contextlib.contextmanager
def _ungreeted() -> Iterator[None]:
    """Keep what C code prints off standard error: Bullet greets whoever imports it."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
