"""Optional extras of the package and the commands that install them."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

DISTRIBUTION = "kineverse-articulation"

STUDIES, ROS = "kineverse-studies", "kineverse_ros"
"""Distributions beside the package: benchmarks and experiments, and nodes of ROS 2."""

_FOLDERS = {STUDIES: "studies", ROS: "ros/kineverse_ros"}  # where they are in a checkout

_EXTRA = re.compile(r"""(?:\s*and\s*)?extra\s*==\s*["'](?P<name>[^"']+)["']""")


def install_command(*extras: str) -> str:
    """Return the command that adds extras to the running installation.

    The package is on no index, so pip cannot find it by name. A checkout is installed again, editable, with
    the extras; for other installations, the requirements of the extras are installed.
    """
    extra = ",".join(extras)
    here = checkout(Path(__file__))
    if here is not None:
        return f"{_pip()} install -e {shlex.quote(f'{_relative_to_cwd(here)}[{extra}]')}"
    declared = _declared()
    wanted = [*dict.fromkeys(line for extra in extras for line in requirements(extra, declared))]
    if not wanted:  # the package is not installed, but on the path
        return f"{_pip()} install -e '.[{extra}]' in a checkout"
    return f"{_pip()} install {' '.join(map(shlex.quote, wanted))}"


def install_distribution(name: str, *extras: str) -> str:
    """Return the command that installs a distribution beside the package, with some of its extras."""
    extra = f"[{','.join(extras)}]" if extras else ""
    here = checkout(Path(__file__))
    if here is None or not (here / _FOLDERS[name]).is_dir():
        return f"{_pip()} install {shlex.quote(name + extra)}"
    folder = _relative_to_cwd(here / _FOLDERS[name])
    return f"{_pip()} install -e {shlex.quote((folder if os.path.isabs(folder) else f'./{folder}') + extra)}"


def checkout(module: Path) -> Path | None:
    """Return the root of the checkout that contains a module of this package; None if it is installed."""
    root = module.resolve().parents[2]
    return root if (root / "src" / "kineverse").is_dir() and (root / "pyproject.toml").is_file() else None


def requirements(extra: str, declared: Iterable[str]) -> list[str]:
    """Return the requirements of an extra, from lines of metadata (``coal>=3.0; extra == "geometry"``)."""
    result = []
    for line in declared:
        match = _EXTRA.search(line)
        if match is not None and match["name"] == extra:
            requirement, _, marker = (line[: match.start()] + line[match.end() :]).partition(";")
            result.append(
                f"{requirement.strip()}; {marker.strip()}" if marker.strip() else requirement.strip()
            )
    return result


def _declared() -> list[str]:
    from importlib import metadata  # for start-up time

    try:
        return metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return []


def _pip() -> str:
    """Return the command of this interpreter's pip, in any environment of the shell."""
    pip = Path(sys.executable).with_name("pip")
    return (
        shlex.quote(_relative_to_cwd(pip))
        if pip.is_file()
        else f"{shlex.quote(_relative_to_cwd(Path(sys.executable)))} -m pip"
    )


def _relative_to_cwd(path: Path) -> str:
    """Return a path relative to the working directory if it is below, else as it is."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # the working directory was removed
        return str(path)
    return os.path.relpath(path, here) if path.is_relative_to(here) else str(path)
