"""What works with all extras, without a C compiler and with the core alone: commands, programs, examples."""

from __future__ import annotations

import json
import os
import re
import sys
import sysconfig
import tempfile
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from inventory.bounded import CACHE, ROOT, Ended, import_path, neutral, run
from inventory.programs import COMMANDS, PROGRAMS


def without(data: Path | None) -> dict[str, Any]:
    """Return outcomes by circumstance and program: ``ok``, or the status and the last line printed."""
    with tempfile.TemporaryDirectory() as folder:
        return dict(_outcomes(Path(folder)))


def _outcomes(place: Path) -> Iterator[tuple[str, Any]]:
    core = place / "core"
    core.mkdir()
    _link_core(core)
    compiler = {CACHE: str(place / "compiled")}
    none = {CACHE: str(place / "interpreted"), "PATH": str(place / "none"), "CC": ""}
    alone = {"PYTHONPATH": os.pathsep.join([*import_path(), str(core)])}
    circumstances: dict[str, tuple[list[str], dict[str, str]]] = {
        "all extras": ([sys.executable], compiler),
        "no compiler": ([sys.executable], none),
        "core alone": ([sys.executable, "-S"], compiler | alone),
    }
    programs: dict[str, list[str]] = {
        f"kineverse {line}": ["-m", "kineverse", *line.split()] for line in COMMANDS
    }
    programs |= {name: ["-c", text] for name, text in PROGRAMS.items()}
    examples = sorted((ROOT / "examples").glob("[0-9]*.py"))
    programs |= {f"examples/{file.name}": [str(file), "--headless"] for file in examples}
    for circumstance, (python, changes) in circumstances.items():
        for name, words in programs.items():
            with tempfile.TemporaryDirectory(dir=place) as here:
                ended = run([*python, *words], 120, Path(here), changes)
                key = neutral(f"{circumstance} | {name}").replace(":", "")
                yield key, {**_entry(ended, Path(here), place), "seconds": ended.seconds}


def _entry(ended: Ended, *folders: Path) -> dict[str, Any]:
    entry: dict[str, Any] = {"outcome": "ok"}
    said = ended.err if ended.out.startswith("{") else ended.err.strip() or ended.out
    if ended.status != 0:
        last = (neutral(said.strip(), *folders).splitlines() or [""])[-1]
        last = re.sub(r"\d+\.\d+ (?=m?s\b)", "", last)  # times differ
        entry["outcome"] = f"{ended.status} {last}".strip()
    if ended.out.startswith("{"):
        entry["keys"] = sorted(json.loads(ended.out))
    return entry


def _link_core(folder: Path) -> None:
    """Link the distributions that the core needs, and what they need, into a folder."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    ours = [found.metadata["Name"] for found in metadata.distributions(path=[sysconfig.get_path("purelib")])]
    pending, seen = [*project["dependencies"], *(n for n in ours if n.startswith("kineverse"))], set[str]()
    site = Path(sysconfig.get_path("purelib"))
    while pending:
        requirement = pending.pop()
        name = re.split(r"[\s<>=!~;\[(]", requirement, maxsplit=1)[0].lower()
        if name in seen or "extra ==" in requirement:
            continue
        seen.add(name)
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        pending += distribution.requires or [] if "kineverse" not in name else []
        tops = {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__", "bin"}
        for top in tops:
            if not top.endswith(".pth") and (site / top).exists() and not (folder / top).exists():
                (folder / top).symlink_to(site / top)
