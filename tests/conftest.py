"""What holds for every test: where models are found, a cache of its own, and what is skipped where.

A test that drives a browser carries the marker ``browser`` and asks for the fixture ``chromium``, the path of
the system's Chromium. Without one it is skipped, or with ``KINEVERSE_REQUIRE_BROWSER=1`` it fails. A test of
real ROS 2 carries the marker ``ros`` and asks for the fixture ``ros_python``, the Python that ``make ros``
makes; ``KINEVERSE_REQUIRE_ROS=1`` likewise. A test that needs compiled code carries the marker ``compiler``;
without a C compiler it is skipped as well. A test of zig as compiler runs if ziglang is installed, or if
``KINEVERSE_TEST_ZIG`` is a folder that holds it. A test that reads data of other people asks for the fixture
``published``, a function from a path below ``KINEVERSE_TEST_DATA``, which gives it the marker ``data``; without
the data it is skipped. The summary has a line for each cause. What is slow for what it checks carries the
marker ``long``: it runs with ``--long``, or if it is asked for by its name. So do most cases of a test with the
marker ``sampled(n)``, all but every n-th.
"""

from __future__ import annotations

import atexit
import gc
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import hypothesis_profiles
import published_data
from native_libraries import compile_native_libraries

ROOT = Path(__file__).parents[1]
sys.path += [str(ROOT / "examples"), str(ROOT / "tools")]  # living_kitchen; what tools and tests share
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ROS_PYTHON = Path(sys.prefix, "ros", "bin", "python")  # of wheels, with the packages of this environment

# No test depends on the load of the machine.
settings.register_profile(
    "kineverse",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=36,
    derandomize=bool(os.environ.get("CI")),
)
settings.register_profile(
    "thorough", settings.get_profile("kineverse"), max_examples=10 * hypothesis_profiles.USUAL
)
settings.load_profile("kineverse")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--long", action="store_true", help="also run the tests that are slow for what they check"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Set the environment, once: the workers of xdist inherit it."""
    hypothesis_profiles.is_long = config.getoption("long")
    if hasattr(config, "workerinput"):
        return
    if published_data.FOLDER and not published_data.FOLDER.is_dir():
        raise pytest.UsageError(f"{published_data.VARIABLE} is {published_data.FOLDER}, which is no folder")
    # Nothing is found but what ships, what is installed, and what a test asks for.
    for name in ("KINEVERSE_MODEL_PATH", "KINEVERSE_PACKAGE_PATH", "KINEVERSE_ROOT", "ROS_PACKAGE_PATH"):
        os.environ.pop(name, None)
    folder = tempfile.mkdtemp(prefix="kineverse-tests-")
    os.environ["KINEVERSE_CACHE_DIR"] = folder
    # Tests with a cache of their own share zig's runtime, which takes seconds to build.
    os.environ["ZIG_GLOBAL_CACHE_DIR"] = os.path.join(folder, "zig")
    # A worker has one core. BLAS would take all of them for small matrices, and have them wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # At the very end, when the compilers in the background are gone; they were started after this.
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if config.getoption("numprocesses", None) and not config.getoption("collectonly"):
        compile_native_libraries()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Read the tests without a collector of garbage, which would go over all of them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()  # nor later, when it looks for the garbage of a test
        gc.enable()


@pytest.hookimpl(tryfirst=True)  # before -m is applied
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is slow for what it checks, unless it is asked for."""
    _mark_samples(items)
    for item in items:
        if "published" in getattr(item, "fixturenames", ()):
            item.add_marker("data")
    option = config.option
    asked = option.long or option.keyword or "long" in option.markexpr or getattr(option, "lf", False)
    if asked or any("::" in argument for argument in config.args):
        return
    left_out = [item for item in items if item.get_closest_marker("long")]
    if left_out:
        items[:] = [item for item in items if not item.get_closest_marker("long")]
        config.hook.pytest_deselected(items=left_out)


def _mark_samples(items: list[pytest.Item]) -> None:
    """Mark as long all but every n-th case of the tests that are marked ``sampled(n)``."""
    cases: Counter[str] = Counter()
    for item in items:
        sampled = item.get_closest_marker("sampled")
        if sampled is not None:
            name = item.nodeid.partition("[")[0]
            if cases[name] % sampled.args[0]:
                item.add_marker("long")
            cases[name] += 1


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep MuJoCo from leaving its warnings in a file in the current folder."""
    if session.items and importlib.util.find_spec("mujoco"):
        import mujoco

        mujoco.set_mju_user_warning(lambda warning: None)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip, or fail, what needs a browser, ROS or a compiler where there is none."""
    if item.get_closest_marker("browser") and _browser() is None:
        _leave_out(
            f"{item.name} needs a Chromium, and there is none: install the package 'chromium'.", "BROWSER"
        )
    if item.get_closest_marker("ros") and not ROS_PYTHON.is_file():
        _leave_out(
            f"{item.name} needs ROS 2, and there is none: make ros, with the packages 'cmake' and 'g++'.",
            "ROS",
        )
    if item.get_closest_marker("compiler") and not _has_compiler():
        pytest.skip(f"{item.name} needs a C compiler, and there is none: install the package 'gcc'.")


def _leave_out(message: str, what: str) -> None:
    """Skip a test, or fail where what it needs is required."""
    if os.environ.get(f"KINEVERSE_REQUIRE_{what}"):
        pytest.fail(message, pytrace=False)
    pytest.skip(message)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what did not run, in a line for each cause; ``-rs`` names the tests."""
    causes = Counter(_cause(report) for report in terminalreporter.stats.get("skipped", []))
    for cause, count in causes.most_common():
        tests = "1 test was" if count == 1 else f"{count} tests were"
        terminalreporter.write_line(f"{tests} skipped: {cause}", yellow=True)


def _cause(report: pytest.TestReport) -> str:
    """Return why a test did not run, and how to have it run."""
    why = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
    if "data" in report.keywords and published_data.VARIABLE in why:
        return f"what they read is not ours; {published_data.VARIABLE} names its folder, see tests/DATA.md"
    for marker, cause in (
        ("browser", "there is no Chromium; install the package 'chromium'"),
        ("ros", "there is no ROS 2; on Linux x86-64: make ros, with the packages 'cmake' and 'g++'"),
        ("compiler", "there is no C compiler; install the package 'gcc'"),
    ):
        if marker in report.keywords and "and there is none" in why:
            return cause
    return why.removeprefix("Skipped: ")


@pytest.fixture(scope="session", autouse=True)
def _models_are_remembered() -> Generator[None]:
    """What one test has loaded is there for the next one: linkages take seconds to be closed."""
    from kineverse.formats import loader

    before, loader.MOST_REMEMBERED = loader.MOST_REMEMBERED, 100
    yield
    loader.MOST_REMEMBERED = before


@pytest.fixture(scope="session", autouse=True)
def _usual_samples() -> Generator[int]:
    """Pictures have a computed pixel for each of their own, a quarter of the usual work; return the usual number."""
    from kineverse.view import pictures

    before, pictures.SAMPLES = pictures.SAMPLES, 1
    yield before
    pictures.SAMPLES = before


@pytest.fixture(scope="module")
def fine_pictures(_usual_samples: int) -> Generator[None]:
    """Pictures are as fine as those of users."""
    from kineverse.view import pictures

    pictures.SAMPLES = _usual_samples
    yield
    pictures.SAMPLES = 1


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the system's Chromium."""
    path = _browser()
    if path is None:
        pytest.skip("There is no Chromium: install the package 'chromium'.")
    return path


@pytest.fixture
def ros_python(monkeypatch: pytest.MonkeyPatch) -> str:
    """Python with ROS 2, for programs that start in this test: in a domain of this process, on this computer."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", os.path.join(os.environ["KINEVERSE_CACHE_DIR"], "ros_logs"))
    # The wheels start Python anew, unless they find in the environment that they have.
    monkeypatch.delenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", raising=False)
    return str(ROS_PYTHON)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Hide every C compiler, that of an installed package too."""
    from kineverse.compilation.build_queue import _worker

    for build in [*_worker._wanted.values()]:  # those of earlier tests would lack the assembler
        build.wait(60.0)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "no programs"))
    monkeypatch.setitem(sys.modules, "ziglang", None)


@pytest.fixture
def hears_ctrl_c() -> Generator[None]:
    """Restore the default handler of SIGINT, which child processes lack if this one was started with ``&``."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Generator[Path]:
    """Folder of sockets; its path is short, as a socket's has to be."""
    with tempfile.TemporaryDirectory(prefix="kv-") as folder:
        monkeypatch.setenv("KINEVERSE_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Function to a file or folder of the published data, whose models are found by name in this test."""
    if published_data.FOLDER:
        monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(published_data.FOLDER))
    return published_data.published_path


def _has_compiler() -> bool:
    from kineverse.compilation.toolchain import toolchain

    return toolchain() is not None


def _browser() -> str | None:
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)
