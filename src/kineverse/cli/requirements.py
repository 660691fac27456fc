"""Requirements of commands beyond the core, checked before a command starts: extras and a C compiler."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from types import MappingProxyType

from kineverse._extras import install_command
from kineverse.errors import CompileError, MissingDependencyError

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "control": "daqp",
        "decomposition": "coacd",
        "figures": "matplotlib",
        "geometry": "coal",
        "mjcf": "mujoco",
        "recording": "mcap",
        "view": "viser",
    }
)
"""The module of each extra that is not in the core, and without which the extra is of no use."""

_HEAD = 1 << 16  # of a file, in which its root element begins [byte]


def require(what: str, extras: Mapping[str, bool], compiler: bool = False) -> None:
    """Raise if something is missing, and name all of it with how to install it."""
    from kineverse.compile.toolchain import NO_COMPILER, toolchain

    missing = [extra for extra, needed in extras.items() if needed and not _is_installed(extra)]
    sentences = []
    if missing:
        names = " and ".join(filter(None, [", ".join(map(repr, missing[:-1])), repr(missing[-1])]))
        noun = "extras" if len(missing) > 1 else "extra"
        modules = ", ".join(MODULES[extra] for extra in missing)
        sentences.append(f"{what} needs the {noun} {names} ({modules}): {install_command(*missing)}")
    if compiler and toolchain() is None:
        sentences.append(f"{what} needs a C compiler, and {NO_COMPILER}")
    if sentences:
        raise (MissingDependencyError if missing else CompileError)(". ".join(sentences))


def needs_mujoco(model: str) -> bool:
    """Return True for the path of a file that only MuJoCo reads."""
    from kineverse.formats.file_formats import is_mjcf

    try:
        with open(model, "rb") as file:
            return is_mjcf(model, file.read(_HEAD))
    except (OSError, ValueError):
        return False


def _is_installed(extra: str) -> bool:
    return importlib.util.find_spec(MODULES[extra]) is not None
