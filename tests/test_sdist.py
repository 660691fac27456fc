"""A source distribution has all that the repository has: documentation, changelog, examples, and tests that run."""

import shutil
import subprocess
import sys
import tarfile
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


def test_the_source_distribution_is_complete(tracked, tmp_path):
    for name in tracked:
        target = tmp_path / "tree" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Contents do not matter, but where setuptools reads them.
        if name in ("pyproject.toml", "MANIFEST.in", "README.md", "src/kineverse/_version.py"):
            shutil.copy(ROOT / name, target)
        else:
            target.touch()
    program = "from setuptools.build_meta import build_sdist; build_sdist('dist')"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path / "tree", capture_output=True, check=True)
    (archive,) = (tmp_path / "tree" / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        found = {member.name.partition("/")[2] for member in opened.getmembers() if member.isfile()}
    assert tracked - found == set()
    made = {"PKG-INFO", "setup.cfg"}
    assert {name for name in found - tracked - made if ".egg-info/" not in name} == set()
