"""Background queue of C builds: what is waited for is built beside what is being built."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path

import pytest

from kineverse.compilation import build_queue
from kineverse.compilation.build_queue import BuildJob, request
from kineverse.compilation.toolchain import Toolchain, toolchain

pytestmark = pytest.mark.compiler
FLAGS = ("-O0",)
PATIENCE = 100.0


class Listener:
    """Receives jobs that are done."""

    def __init__(self) -> None:
        self.jobs: list[BuildJob] = []

    def note(self, build: BuildJob) -> None:
        self.jobs.append(build)


def ask(listener: Listener, name: str, until: threading.Event | None = None) -> BuildJob:
    """Request a library with a variable of a name, whose source is there after an event."""

    def write_source() -> str:
        if until is not None:
            until.wait(PATIENCE)
        return f"int {name};\n"

    compiler = toolchain()
    assert compiler is not None
    key = hashlib.sha256(f"test {name}".encode()).hexdigest()[:40]
    job = request(key, compiler, write_source, FLAGS, listener.note)
    assert job is not None
    return job


def test_a_job_that_is_waited_for_is_done_beside_the_one_in_work() -> None:
    go, listener = threading.Event(), Listener()
    first, second = ask(listener, "first", go), ask(listener, "second")
    try:
        assert second.wait(PATIENCE)
        assert second.path
        assert not first.done
    finally:
        go.set()
    assert first.wait(PATIENCE)
    assert listener.jobs == [second, first]


def test_all_threads_that_wait_for_a_job_get_its_result() -> None:
    go, listener = threading.Event(), Listener()
    job = ask(listener, "shared", go)
    found: list[bool] = []
    threads = [threading.Thread(target=lambda: found.append(job.wait(PATIENCE))) for _ in range(4)]
    for thread in threads:
        thread.start()
    go.set()
    for thread in threads:
        thread.join(PATIENCE)
    assert found == [True] * 4
    assert listener.jobs == [job]


def test_an_interrupted_wait_leaves_the_job_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    go, listener = threading.Event(), Listener()
    job = ask(listener, "interrupted", go)

    def interrupt(timeout: float | None = None) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(job._done, "wait", interrupt)
        with pytest.raises(KeyboardInterrupt):
            job.wait()
    go.set()
    assert job.wait(PATIENCE)
    assert job.path


def test_the_time_of_the_processor_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\nwhile :; do :; done\n", "utf-8")
    compiler.chmod(0o755)
    monkeypatch.setattr(build_queue, "TIME_LIMIT", 1)
    listener = Listener()
    job = request(tmp_path.name, Toolchain((str(compiler),), "none"), lambda: "", (), listener.note)
    assert job is not None
    assert job.wait(PATIENCE)
    assert job.error == "the C compiler needed more than 1 s of processor time."
