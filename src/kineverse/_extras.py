"""Optional extras of the package and the commands that install them."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

DISTRIBUTION = "kineverse-articulation"

_EXTRA = re.compile(r"""(?:\s*and\s*)?extra\s*==\s*["'](?P<name>[^"']+)["']""")


def install_command(extra: str) -> str:
    """Return the command that adds an extra to the installation that is running.

    The package is on no index, so its name says nothing to pip. A checkout is installed again, editable, with
    the extra; beside anything else goes what the extra consists of.

    Parameters
    ----------
    extra
        One of ``[project.optional-dependencies]``, such as ``figures``.
    """
    here = checkout(Path(__file__))
    if here is not None:
        return f"{_pip()} install -e {shlex.quote(f'{_relative_to_cwd(here)}[{extra}]')}"
    wanted = requirements(extra, _declared())
    if not wanted:  # a folder that somebody put on the path
        return f"{_pip()} install -e '.[{extra}]' in a checkout"
    return f"{_pip()} install {' '.join(map(shlex.quote, wanted))}"


def checkout(module: Path) -> Path | None:
    """Return the root of the checkout from which a module of this package runs; None if it was copied."""
    root = module.resolve().parents[2]
    return root if (root / "src" / "kineverse").is_dir() and (root / "pyproject.toml").is_file() else None


def requirements(extra: str, declared: Iterable[str]) -> list[str]:
    """Return what an extra consists of, by the lines of metadata (``coal>=3.0; extra == "geometry"``)."""
    found = []
    for line in declared:
        match = _EXTRA.search(line)
        if match is not None and match["name"] == extra:
            requirement, _, marker = (line[: match.start()] + line[match.end() :]).partition(";")
            found.append(
                f"{requirement.strip()}; {marker.strip()}" if marker.strip() else requirement.strip()
            )
    return found


def _declared() -> list[str]:
    try:
        return metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return []


def _pip() -> str:
    """Return how the pip of this interpreter is called, whichever environment the shell is in."""
    pip = Path(sys.executable).with_name("pip")
    return (
        shlex.quote(_relative_to_cwd(pip))
        if pip.is_file()
        else f"{shlex.quote(_relative_to_cwd(Path(sys.executable)))} -m pip"
    )


def _relative_to_cwd(path: Path) -> str:
    """Return a path as short as it can be typed here."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # somebody removed the folder
        return str(path)
    return os.path.relpath(path, here) if path.is_relative_to(here) else str(path)
