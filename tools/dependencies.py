"""Ask the package index about what Kineverse depends on, by uv.

python tools/dependencies.py hashes            compare the hashes in requirements/ with those of the index
python tools/dependencies.py hashes --write    write them: of all files of each pinned version
python tools/dependencies.py wheels            print which extras have wheels for which Python and platform
python tools/dependencies.py wheels --write    put this table into docs/release.md

A pin is changed by hand: write NAME==VERSION, without hashes, and run the second line. The index is that of
pip's settings. ``make release`` makes the environment with uv, ``.venv/release``.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "release.md"
TABLE = re.compile(r"(?<=<!-- wheels -->\n).*?(?=<!-- end of wheels -->)", re.DOTALL)

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = {
    "Linux x86-64": "x86_64-manylinux_2_34",
    "Linux ARM": "aarch64-manylinux_2_34",
    "macOS ARM": "aarch64-apple-darwin",
    "Windows": "x86_64-pc-windows-msvc",
}
CORE = "the core"
LEAST = "3.11.14"  # some pins refuse the first versions of 3.11
MACOS = "14.0"  # the oldest macOS of the wheels that are counted


def main() -> int:
    """Compare or write what the arguments name, and return 1 if something differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("hashes", "wheels"))
    parser.add_argument("--write", action="store_true", help="write the files instead of comparing them")
    arguments = parser.parse_args()
    if arguments.what == "hashes":
        wanted = {file: pin(file) for file in sorted((ROOT / "requirements").glob("*.txt"))}
    else:
        table = make_table()
        print(table, end="")
        wanted = {PAGE: TABLE.sub(lambda _: table, PAGE.read_text("utf-8"))}
    different = [file for file, text in wanted.items() if file.read_text("utf-8") != text]
    for file in different:
        print(f"{file.relative_to(ROOT)} {'is written' if arguments.write else 'differs from the index'}")
        if arguments.write:
            file.write_text(wanted[file], "utf-8")
    return int(bool(different) and not arguments.write)


def pin(file: Path) -> str:
    """Return the text of a file of requirements with the hashes of all files of each version."""
    lines = file.read_text("utf-8").splitlines()
    head = [line for line in lines if line.startswith("#")]
    versions = [line.removesuffix("\\").strip() for line in lines if "==" in line]
    whole = ("--no-deps", "--universal", "--python-version", LEAST, "--generate-hashes")
    pinned = ask(*whole, "-", said="\n".join(versions))
    if pinned.returncode:
        sys.exit(f"{file.relative_to(ROOT)}: {pinned.stderr.strip()}")
    return "\n".join([*head, pinned.stdout])


def make_table() -> str:
    """Return the table of extras that can be installed from wheels alone, by Python and platform."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = [CORE, *(extra for extra in project["optional-dependencies"] if extra != "all")]
    cases = [(platform, python) for platform in PLATFORMS for python in PYTHONS]
    with ThreadPoolExecutor(4) as pool:  # the index answers slowly, and uv waits
        found = dict(zip(cases, pool.map(lambda case: find_with_wheels(extras, *case), cases), strict=True))
    rows = [["extra", *PLATFORMS], ["---"] * (1 + len(PLATFORMS))]
    for extra in extras:
        cells = [_span([p for p in PYTHONS if extra in found[platform, p]]) for platform in PLATFORMS]
        rows.append([CORE if extra == CORE else f"`{extra}`", *cells])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def find_with_wheels(extras: Sequence[str], platform: str, python: str) -> set[str]:
    """Return the extras whose newest versions that fit each other have wheels, with all that they need.

    Extras that can be installed together can be installed alone.
    """
    where = ["--only-binary", ":all:", "--python-platform", PLATFORMS[platform], "--python-version", python]
    named = [word for extra in extras if extra != CORE for word in ("--extra", extra)]
    answer = ask("pyproject.toml", *where, *named)
    if not answer.returncode:
        return {*extras}
    if "No solution found" not in answer.stderr:
        sys.exit(answer.stderr.strip())
    half = len(extras) // 2
    parts = (extras[:half], extras[half:]) if half else ()
    return set().union(*(find_with_wheels(part, platform, python) for part in parts))


def ask(*words: str, said: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``uv pip compile`` with the index of pip."""
    command = [_uv(), "pip", "compile", "--quiet", "--no-header", "--no-annotate", *_index(), *words]
    environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": MACOS}
    if certificates := _pip("cert"):
        environment.setdefault("SSL_CERT_FILE", certificates)
    return subprocess.run(
        command,
        input=said,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        cwd=ROOT,
        env=environment,
    )


def _span(pythons: list[str]) -> str:
    """Return the first and the last of some versions, without gaps."""
    if not pythons:
        return "–"
    first, last = PYTHONS.index(pythons[0]), PYTHONS.index(pythons[-1])
    if list(PYTHONS[first : last + 1]) != pythons or first == last:
        return ", ".join(pythons)
    return f"{pythons[0]} to {pythons[-1]}"


@cache
def _uv() -> str:
    found = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if found is None:
        sys.exit("There is no uv. Run this by the Python of .venv/release, which 'make release' makes.")
    return found


@cache
def _index() -> list[str]:
    index = _pip("index-url")
    return ["--default-index", index] if index else []


@cache
def _pip(setting: str) -> str:
    """Return a setting of pip, from its variables or else its files; "" if there is none."""
    command = [sys.executable, "-m", "pip", "config", "list"]
    listed = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=True).stdout
    found = dict(line.split("=", 1) for line in listed.splitlines() if "=" in line)
    values = (found.get(f"{source}.{setting}", "") for source in (":env:", "global", "user", "site"))
    return next((value.strip("'\"") for value in values if value.strip("'\"")), "")


if __name__ == "__main__":
    sys.exit(main())
