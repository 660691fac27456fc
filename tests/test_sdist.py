"""A source distribution has all that the repository has, and a wheel all that the package has."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def tracked():
    """The files that git knows of."""
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("this is no clone of the repository, to compare a source distribution with")
    said = subprocess.run([git, "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name for name in said.stdout.splitlines() if (ROOT / name).exists()}


@pytest.fixture
def tree(tracked, tmp_path):
    """A copy of the repository with empty files."""
    for name in tracked:
        target = tmp_path / "tree" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Contents do not matter, but where setuptools reads them.
        if name in ("pyproject.toml", "MANIFEST.in", "README.md", "src/kineverse/_version.py"):
            shutil.copy(ROOT / name, target)
        else:
            target.touch()
    return tmp_path / "tree"


def build(tree, kind):
    program = f"from setuptools.build_meta import build_{kind}; build_{kind}('dist')"
    subprocess.run([sys.executable, "-c", program], cwd=tree, capture_output=True, check=True)
    (archive,) = (tree / "dist").iterdir()
    return archive


def test_the_source_distribution_is_complete(tracked, tree):
    with tarfile.open(build(tree, "sdist")) as opened:
        found = {member.name.partition("/")[2] for member in opened.getmembers() if member.isfile()}
    assert tracked - found == set()
    made = {"PKG-INFO", "setup.cfg"}
    assert {name for name in found - tracked - made if ".egg-info/" not in name} == set()


def test_a_wheel_has_all_files_of_the_package_and_no_compiled_ones(tracked, tree):
    archive = build(tree, "wheel")
    assert archive.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(archive) as opened:
        found = {name for name in opened.namelist() if name.startswith("kineverse/")}
    assert found == {name.removeprefix("src/") for name in tracked if name.startswith("src/kineverse/")}
