"""What the tests of model servers share: a folder of sockets of their own, and processes that they end."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Generator[Path]:
    """Folder of sockets; its path is short, as a socket's has to be."""
    with tempfile.TemporaryDirectory(prefix="kv-") as folder:
        monkeypatch.setenv("KINEVERSE_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
def start() -> Generator[Start]:
    """Function that starts a program of Python, and returns when it has printed a first line, ``ready``."""
    running: list[subprocess.Popen[str]] = []

    def run(program: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", program, *arguments]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        running.append(process)
        assert process.stdout is not None
        line = process.stdout.readline()
        if line != "ready\n":
            process.kill()
            pytest.fail(f"{line}{process.communicate()[1]}")
        return process

    yield run
    for process in running:
        process.kill()
        process.communicate()
