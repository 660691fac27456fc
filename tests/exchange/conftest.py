"""What the tests of model servers share: processes that they end, and models that they close."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

import kineverse as kv

Start = Callable[..., "subprocess.Popen[str]"]


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


@pytest.fixture
def load(sockets: Path) -> Generator[Callable[..., Any]]:
    """Function that loads a live model, by default that of the server ``home``."""
    opened: list[Any] = []

    def load_one(address: str = "live:home", **part: Any) -> Any:
        opened.append(kv.load(address, **part))
        return opened[-1]

    yield load_one
    for model in opened:
        model.close()
