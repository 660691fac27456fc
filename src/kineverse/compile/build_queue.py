"""Background queue of C builds: one compiler at a time, at low priority.

A :class:`BuildJob` is one library that is wanted. Builds nobody is interested in any more when their turn comes
are dropped, and builds somebody waits for go first. The thread is a daemon and ends with the process, and the
compiler with it; sources go through a pipe and everything else lives in one folder that is always removed.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import logging
import os
import queue
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias
from weakref import WeakMethod

from .cache import library_cache
from .toolchain import Toolchain

logger = logging.getLogger("kineverse.compile")

MAXIMUM_WAITING = 256
TIME_LIMIT = 120.0


BuildCallback: TypeAlias = Callable[["BuildJob"], object]


class BuildJob:
    """A library to be compiled.

    Attributes
    ----------
    path
        The library, when it is done.
    error
        Why there is none, when that failed.
    forgotten
        Whether it was given up although nothing is wrong with it.
    """

    def __init__(
        self, key: str, compiler: Toolchain, source: Callable[[], str], flags: Sequence[str]
    ) -> None:
        self.key = key
        self.compiler = compiler
        self.source = source
        self.flags = flags
        self.cache = library_cache()
        self.path: str | None = None
        self.error: str | None = None
        self.forgotten = False
        self.urgent = False
        self.started = False
        self.watchers: list[WeakMethod[BuildCallback]] = []
        self._done = threading.Event()

    @property
    def done(self) -> bool:
        """Whether it was built, failed or was given up."""
        return self._done.is_set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is done, ahead of all builds nobody waits for; return whether it is.

        Parameters
        ----------
        timeout
            In seconds; forever if None.
        """
        _worker.hurry(self)
        return self._done.wait(timeout)

    def finish(self, path: str | None = None, error: str | None = None) -> None:
        """Say how it went to whoever is interested; in the worker's thread."""
        self.path, self.error = path, error
        # The functions first: whoever waits shall find them changed.
        for watcher in self.watchers:
            notify = watcher()
            if notify is not None:
                try:
                    notify(self)
                except Exception:
                    logger.exception("A compiled function could not be put to use.")
        self._done.set()


def request(
    key: str,
    compiler: Toolchain,
    source: Callable[[], str],
    flags: Sequence[str],
    watcher: BuildCallback,
    urgent: bool = False,
) -> BuildJob | None:
    """Have a library compiled in the background.

    Parameters
    ----------
    key
        What it will be found by in the cache.
    compiler
        The compiler.
    source
        Returns the C source; called in the worker's thread.
    flags
        Of the compiler.
    watcher
        A method that is called when it is done, in the worker's thread. It is held weakly: a build whose
        watchers are all gone is not begun.
    urgent
        Whether somebody waits for it.

    Returns
    -------
    Build or None
        None if too many are waiting already.
    """
    return _worker.request(BuildJob(key, compiler, source, flags), watcher, urgent)


class _Worker:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: queue.PriorityQueue[tuple[int, int, BuildJob]] = queue.PriorityQueue()
        self._count = itertools.count()
        self._wanted: dict[str, BuildJob] = {}
        self._thread: threading.Thread | None = None
        self._compiler: subprocess.Popen[bytes] | None = None
        self._workplace: str | None = None
        # Held while the compiler is started or the process ends, so that neither misses the other.
        self._starting = threading.Lock()
        self._closing = False
        self._complained = False

    def request(self, build: BuildJob, watcher: BuildCallback, urgent: bool) -> BuildJob | None:
        with self._lock:
            known = self._wanted.get(build.key)
            if known is None:
                if not urgent and len(self._wanted) >= MAXIMUM_WAITING:
                    logger.info(
                        "%d functions wait for the compiler; one more stays interpreted.", MAXIMUM_WAITING
                    )
                    return None
                known = self._wanted[build.key] = build
                known.urgent = urgent
                self._queue.put((not urgent, next(self._count), known))
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name="kineverse-compile", daemon=True)
                    self._thread.start()
            known.watchers.append(WeakMethod(watcher))
        if urgent:
            self.hurry(known)
        return known

    def hurry(self, build: BuildJob) -> None:
        with self._lock:
            if not build.urgent and not build.started and not build.done:
                build.urgent = True
                self._queue.put((False, next(self._count), build))

    def _run(self) -> None:
        while not self._closing:
            self._serve(self._queue.get()[-1])

    def _serve(self, build: BuildJob) -> None:
        with self._lock:
            # A build that somebody began to wait for is in the queue twice.
            if build.started:
                return
            build.started = True
            build.forgotten = not build.urgent and all(watcher() is None for watcher in build.watchers)
            if build.forgotten:
                # Who asks for it from now on gets a new one.
                del self._wanted[build.key]
        path, error = None, None
        try:
            # Another process may have been faster.
            path = None if build.forgotten else build.cache.find(build.key) or self._compile(build)
        except Exception as problem:
            error = str(problem)
            self._complain(error)
        with self._lock:
            if self._wanted.get(build.key) is build:
                del self._wanted[build.key]
        build.finish(path, error)

    def _compile(self, build: BuildJob) -> str:
        source = build.source().encode()
        try:
            with self._starting:
                if self._closing:
                    raise RuntimeError("the process ends.")
                self._workplace = workplace = build.cache.workplace()
                output = os.path.join(workplace, "library.so")
                compiler = self._compiler = subprocess.Popen(
                    build.compiler.arguments(build.flags, output),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    env={**os.environ, "TMPDIR": workplace, "LC_ALL": "C"},
                    # The compiler starts processes of its own; in a session of theirs they can be ended
                    # together, and do not hear of the user's Ctrl-C.
                    start_new_session=True,
                )
            if not build.urgent:
                _lower_priority(compiler.pid)
            began = time.monotonic()
            try:
                _, complaints = compiler.communicate(source, timeout=TIME_LIMIT)
            except subprocess.TimeoutExpired:
                raise RuntimeError(f"the C compiler needed more than {TIME_LIMIT:.0f} s.") from None
            finally:
                _end(compiler)
                self._compiler = None
            if compiler.returncode or not os.path.exists(output):
                text = complaints.decode(errors="replace").strip()
                raise RuntimeError(f"the C compiler failed ({compiler.returncode}): {text[:500]}")
            logger.debug("Compiled %s in %.2f s.", build.key[:12], time.monotonic() - began)
            return build.cache.store(build.key, output)
        finally:
            if self._workplace is not None:
                shutil.rmtree(self._workplace, ignore_errors=True)
            self._workplace = None

    def _complain(self, error: str) -> None:
        """Log loudly once: a compiler that fails for one function will fail for all."""
        if not self._closing:
            level = logging.DEBUG if self._complained else logging.WARNING
            logger.log(level, "A function stays with CasADi's interpreter: %s", error)
            self._complained = True

    def close(self) -> None:
        """End the compiler and remove its folder, when the process ends."""
        with self._starting:
            self._closing = True
            compiler, workplace = self._compiler, self._workplace
            if compiler is not None:
                _end(compiler)
            if workplace is not None:
                shutil.rmtree(workplace, ignore_errors=True)

    def abandon(self) -> None:
        """Give up what the parent process was asked for, in a child process that has no thread of ours."""
        for build in self._wanted.values():
            # The lock inside of the old event may be held by a thread that does not exist here.
            build._done = threading.Event()
            build.forgotten = True
            build._done.set()


def _lower_priority(process_group: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PGRP, process_group, 19)


def _end(compiler: subprocess.Popen[bytes]) -> None:
    """End a compiler with all processes it started, if it still runs, and reap it."""
    if compiler.poll() is None:
        with contextlib.suppress(OSError):
            os.killpg(compiler.pid, signal.SIGKILL)
        compiler.wait()
    for pipe in (compiler.stdin, compiler.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


_worker = _Worker()


def _close() -> None:
    _worker.close()


def _forked() -> None:
    global _worker
    parents, _worker = _worker, _Worker()
    parents.abandon()


atexit.register(_close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
