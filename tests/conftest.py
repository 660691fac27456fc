"""What holds for every test: where models are found, a cache of its own, and what becomes of browser tests.

A test that drives a browser carries the marker ``browser`` and asks for the fixture ``chromium``, the path of
the system's Chromium. Without one it is skipped and the summary names it, or with
``KINEVERSE_REQUIRE_BROWSER=1`` it fails.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")

settings.register_profile("kineverse", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("kineverse")

_cache = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    """Set the environment, once: the workers of xdist inherit it."""
    if hasattr(config, "workerinput"):
        return
    places = os.environ.get("KINEVERSE_MODEL_PATH", "").split(os.pathsep)
    if SHARED.is_dir() and str(SHARED) not in places:
        os.environ["KINEVERSE_MODEL_PATH"] = os.pathsep.join([*filter(None, places), str(SHARED)])
    folder = config.stash[_cache] = tempfile.mkdtemp(prefix="kineverse-tests-")
    os.environ["KINEVERSE_CACHE_DIR"] = folder


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the cache of this run."""
    folder = config.stash.get(_cache, None)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip, or fail, what needs a browser where there is none."""
    if item.get_closest_marker("browser") is None or _browser() is not None:
        return
    message = f"{item.name} needs a Chromium, and there is none: install the package 'chromium'."
    if os.environ.get("KINEVERSE_REQUIRE_BROWSER"):
        pytest.fail(message, pytrace=False)
    pytest.skip(message)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say loudly which browser tests did not run."""
    skipped = [r.nodeid for r in terminalreporter.stats.get("skipped", []) if "browser" in r.keywords]
    if skipped:
        terminalreporter.section("NOT TESTED, FOR WANT OF A CHROMIUM", sep="!", red=True, bold=True)
        for name in sorted(skipped):
            terminalreporter.line(name, red=True)


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the system's Chromium."""
    path = _browser()
    if path is None:
        pytest.skip("There is no Chromium: install the package 'chromium'.")
    return path


def _browser() -> str | None:
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)
