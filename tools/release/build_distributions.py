"""Source distributions and wheels: built from what git knows, and checked."""

from __future__ import annotations

import email
import os
import runpy
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGES = {".": "kineverse", "studies": "kineverse_studies", "ros/kineverse_ros": "kineverse_ros"}
"""The folder of each distribution, and its package."""


@dataclass(frozen=True)
class Archives:
    """Distribution: its package, both archives, and the unpacked source distribution."""

    package: str
    sdist: Path
    wheel: Path
    unpacked: Path


def build(root: Path, into: Path, scratch: Path, clean: Path) -> list[Archives]:
    """Build all distributions of a checkout into a folder; each wheel from its source distribution.

    Two folders are filled: one for scratch, and one with a clean copy of the checkout.
    """
    for name in tracked(root):
        (clean / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(root / name, clean / name)
    # Files in archives have one time, so that two builds of a commit are equal.
    os.environ["SOURCE_DATE_EPOCH"] = _git(root, "log", "-1", "--format=%ct").strip()
    built = []
    for folder, package in PACKAGES.items():
        print(f"build   {package}", flush=True)
        sdist = _build("--sdist", _copy(clean / folder, scratch / "sdist" / package), into)
        unpacked = scratch / "unpacked" / package
        with tarfile.open(sdist) as opened:
            opened.extractall(unpacked, filter="data")
        (inside,) = unpacked.iterdir()
        wheel = _build("--wheel", inside, into)
        direct = _build(
            "--wheel", _copy(clean / folder, scratch / "wheel" / package), scratch / "direct" / package
        )
        same = dict(contents(wheel)), dict(contents(direct))
        assert same[0] == same[1], f"{wheel.name} differs from what the checkout gives: {_names(*same)}"
        # The build has left its folders there, which trials must not see.
        shutil.rmtree(inside)
        with tarfile.open(sdist) as opened:
            opened.extractall(unpacked, filter="data")
        built.append(Archives(package, sdist, wheel, inside))
    return built


def check(root: Path, built: list[Archives], clean: Path) -> None:
    """Check archives that were built from a clean copy of a checkout.

    Raise CalledProcessError or AssertionError if something is wrong with the archives."""
    files = [str(path) for archives in built for path in (archives.sdist, archives.wheel)]
    python = [sys.executable, "-m"]
    _run([*python, "twine", "check", "--strict", *files])
    _run([*python, "check_wheel_contents", *(file for file in files if file.endswith(".whl"))])
    version = runpy.run_path(str(root / "src" / "kineverse" / "_version.py"))["__version__"]
    for archives in built:
        print(f"check   {archives.package} {version}", flush=True)
        inside = dict(contents(archives.wheel))
        (metadata,) = (name for name in inside if name.endswith(".dist-info/METADATA"))
        facts = email.message_from_bytes(inside[metadata])
        assert facts["Version"] == version, f"{archives.wheel.name} is not of version {version}"
        assert f"{archives.package}/py.typed" in inside, f"{archives.wheel.name} has no py.typed"
        license_file = f"{Path(metadata).parent}/licenses/LICENSE"
        assert inside.get(license_file) == (root / "LICENSE").read_bytes(), f"{license_file} is missing"
        own = [line for line in facts.get_all("Requires-Dist", []) if line.startswith("kineverse")]
        pinned = [f"kineverse-articulation=={version}"]
        assert archives.package == "kineverse" or own == pinned, f"{archives.wheel.name} needs {own}"
        for path in (archives.sdist, archives.wheel):
            for name, content in contents(path):
                assert os.fsencode(root) not in content, f"{name} in {path.name} names {root}"
    everything = dict(contents(built[0].sdist))
    files = {path.relative_to(clean).as_posix(): path for path in clean.rglob("*") if path.is_file()}
    inside = f"{built[0].unpacked.name}/"
    lacking = [name for name, path in files.items() if everything.get(inside + name) != path.read_bytes()]
    assert not lacking, f"{built[0].sdist.name} lacks {lacking}"


def tracked(root: Path) -> list[str]:
    """Return the files that git knows of, as they are now."""
    names = _git(root, "ls-files", "--cached", "--others", "--exclude-standard").splitlines()
    return [name for name in names if (root / name).is_file()]


def contents(archive: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the names and the contents of the files in an archive."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            yield from ((name, wheel.read(name)) for name in wheel.namelist())
        return
    with tarfile.open(archive) as sdist:
        for member in sdist:
            if (file := sdist.extractfile(member)) is not None:
                yield member.name, file.read()


def _copy(source: Path, target: Path) -> Path:
    """Return a copy of a folder, for a build, which leaves files there."""
    shutil.copytree(source, target)
    return target


def _build(kind: str, source: Path, into: Path) -> Path:
    before = {*into.glob("*")}
    # What builds is pinned in requirements/release.txt.
    _run([sys.executable, "-m", "build", kind, "--no-isolation", "--outdir", str(into), str(source)])
    (archive,) = {*into.glob("*")} - before
    return archive


def _run(command: list[str]) -> None:
    subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8", check=True
    )


def _git(root: Path, *words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=root, stdout=subprocess.PIPE, text=True, check=True, encoding="utf-8"
    ).stdout


def _names(one: dict[str, bytes], other: dict[str, bytes]) -> list[str]:
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
