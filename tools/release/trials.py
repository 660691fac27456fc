"""Trials of a release: wheels in new environments, and what README and docs promise there."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from build_distributions import Archives

PAGES_OF_THE_CORE = (
    *("models", "editing", "expressions", "gradients", "articulations", "mechanisms", "interlocks"),
    *("evaluation", "documents", "files", "identification", "calibration"),
)
"""The pages that run to their ends without an extra."""

PICTURE = b"\x89PNG"


@dataclass(frozen=True)
class Environment:
    """Environment with the wheels, and the unpacked source distribution that commands run in."""

    folder: Path
    source: Path
    variables: Mapping[str, str]

    def run(
        self, *words: str, status: tuple[int, ...] = (0,), path: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment; it must end with one of the statuses, without a traceback."""
        program = self.folder / "bin" / words[0]
        # Where PATH has the environment alone there is no compiler.
        variables = self.variables if path is None else {**self.variables, "PATH": path}
        done = subprocess.run(
            [str(program), *words[1:]],
            cwd=self.source,
            env=variables,
            capture_output=True,
            text=True,
            encoding="utf-8",
            check=False,
        )
        told = f"{' '.join(words)} ends with status {done.returncode}:\n{done.stdout}{done.stderr}"
        assert done.returncode in status, told
        assert "Traceback" not in done.stderr, told
        return done

    def command(self, line: str, **options: tuple[int, ...]) -> subprocess.CompletedProcess[str]:
        """Run a command of Kineverse, whose words are separated by spaces."""
        return self.run("kineverse", *line.split(), **options)

    def pages(self, *words: str) -> None:
        """Run the Python of pages: ``run_pages.py`` in this environment."""
        print(self.run("python", "tools/release/run_pages.py", *words).stdout, end="", flush=True)


def try_core(environment: Environment) -> None:
    """Run what needs no extra; what needs one has to name it."""
    environment.command("--help")
    environment.pages("README.md", "CONTRIBUTING.md", "docs")
    environment.pages(*(f"docs/{name}.md" for name in PAGES_OF_THE_CORE), "--whole")
    for name in _examples_of_the_core(environment.source):
        environment.run("python", f"examples/{name}", "--headless")
    for line in (
        "info kitchen",
        "info pr2 --json",
        "fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg",
        *(f"convert kitchen made.{ending}" for ending in ("kv.json", "urdf", "sdf", "xml")),
        "info made.urdf",
        "info made.sdf",
        "validate kitchen examples/door.urdf",
        "fit examples/poses.csv --parent cupboard --child door",
        "unlock lockboxes/thesis --goal lockbox/a=1.2",
        "view kitchen --picture kitchen.png",
        "cache",
    ):
        environment.command(line)
    environment.command("diff examples/door.urdf examples/door_new.urdf", status=(1,))
    assert (environment.source / "kitchen.png").read_bytes().startswith(PICTURE), "kitchen.png is no picture"
    environment.run(
        "python", "tools/release/run_pages.py", "docs/models.md", path=str(environment.folder / "bin")
    )
    commands = environment.run(
        "python", "-c", "from kineverse.cli.command_line import *; print(*COMMANDS, *BESIDE)"
    ).stdout.split()
    for name in commands:
        environment.command(f"{name} --help", status=(0, 2))
    _run_documented(environment)


def try_view(environment: Environment) -> None:
    """Fetch the page of a model, and end it as Ctrl-C does."""
    words = [environment.folder / "bin" / "kineverse", "view", "kitchen", "--no-browser"]
    with subprocess.Popen(
        words, env=environment.variables, stdout=subprocess.PIPE, text=True, encoding="utf-8"
    ) as page:
        try:
            assert page.stdout is not None
            said = page.stdout.readline()
            found = re.search(r"https?://\S+", said)
            assert found, f"kineverse view names no address: {said}"
            with urllib.request.urlopen(found[0], timeout=60) as answer:
                assert b"<html" in answer.read().lower(), f"{found[0]} is no page"
        finally:
            page.send_signal(signal.SIGINT)
    assert page.returncode == 0, f"kineverse view ends with status {page.returncode}"


def try_control(environment: Environment) -> None:
    """Solve inverse kinematics, plan, and let a robot open a fridge."""
    environment.command("reach pr2 pr2/r_gripper_tool_frame --pose 0.7 -0.3 0.9")
    environment.command("plan examples/arm.urdf --from j0=1 --to j0=-1 --move j0 j1 j2")
    environment.command("open kitchen --robot hsr --what kitchen/fridge_door")
    environment.pages("docs/control.md", "docs/geometry.md", "--whole")


def try_all(environment: Environment) -> None:
    """Import every extra, run the demo, and the commands of the other distributions."""
    program = (
        "import importlib; from kineverse.cli.arguments import MODULES\n"
        "[importlib.import_module(module) for extra, module in MODULES.items() if extra != 'check']"
    )
    environment.run("python", "-c", program)
    environment.command("live --headless")
    assert (environment.source / "live.png").read_bytes().startswith(PICTURE), "live.png is no picture"
    environment.command("bench --list")
    environment.command("reproduce --list")
    environment.command("reproduce fig3")
    environment.command("ros --help")
    environment.pages("docs/mjcf.md", "docs/usd.md", "docs/live_models.md", "docs/recordings.md", "--whole")


@dataclass(frozen=True)
class Trial:
    """Extras of the first wheel, whether the other wheels are installed too, and what is run."""

    extras: str
    others: bool
    run: Callable[[Environment], None]


TRIALS: Mapping[str, Trial] = MappingProxyType(
    {
        "core": Trial("", False, try_core),
        "view": Trial("[view]", False, try_view),
        "control": Trial("[geometry,control]", False, try_control),
        "all": Trial("[all]", True, try_all),
    }
)
"""The trials by name."""


def try_out(name: str, archives: list[Archives], scratch: Path) -> None:
    """Install wheels into a new environment, and run a trial there."""
    trial, first = TRIALS[name], archives[0]
    print(f"install {name}", flush=True)
    folder, home = scratch / "environment", scratch / "home"
    home.mkdir(parents=True)
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    wheels = [f"{first.wheel}{trial.extras}", *(str(a.wheel) for a in archives[1:] if trial.others)]
    install = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", *wheels]
    subprocess.run(
        install, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8", check=True
    )
    print(f"try     {name}", flush=True)
    with tempfile.TemporaryDirectory(prefix="kv-") as runtime:  # a socket has a short path
        # As on the first day: no cache, no settings, no packages from elsewhere.
        kept = {
            key: value for key, value in os.environ.items() if not key.startswith(("KINEVERSE_", "PYTHON"))
        }
        own = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), "KINEVERSE_RUNTIME_DIR": runtime}
        path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
        environment = Environment(
            folder, first.unpacked, {**kept, **own, "PATH": path, "PYTHONNOUSERSITE": "1"}
        )
        imported = environment.run("python", "-c", "import kineverse; print(kineverse.__file__)").stdout
        assert imported.startswith(str(folder)), f"kineverse is imported from {imported}"
        trial.run(environment)


def _run_documented(environment: Environment) -> None:
    """Run the commands of a page: each works, or says in one line what to install."""
    program = "import json, sys; sys.path.append('tests'); import markdown_examples as m\n" + (
        "print(json.dumps([e.code for e in m.examples(m.ROOT / 'docs' / 'command_line.md', 'console')]))"
    )
    blocks: list[str] = json.loads(environment.run("python", "-c", program).stdout)
    lines = [line for block in blocks for line in re.findall(r"^\$ kineverse (.*)$", block, re.MULTILINE)]
    assert lines, "docs/command_line.md has no commands"
    for line in lines:
        done = environment.run("kineverse", *shlex.split(line, comments=True), status=(0, 1, 2))
        told = f"kineverse {line} does not say what to install:\n{done.stderr}"
        assert done.returncode < 2 or (done.stderr.count("\n") == 1 and "pip install " in done.stderr), told


def _examples_of_the_core(source: Path) -> list[str]:
    """Return the scripts for which the list of the examples names no extra, and no compiler."""
    rows = (source / "examples" / "README.md").read_text("utf-8").splitlines()
    scripts = [(row, re.match(r"\| \[(\d\d_\w+\.py)\]", row)) for row in rows]
    return [
        found[1]
        for row, found in scripts
        if found and "C compiler" not in row and ("--headless" in row or not re.search(r"\(`\w+`", row))
    ]
