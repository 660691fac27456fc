"""Background queue of C builds: one compiler at a time, at low priority, but for jobs that are waited for.

A :class:`BuildJob` is a requested library. Jobs whose listeners are all deleted are dropped, and urgent jobs
are compiled first. A job that is waited for has a thread and a compiler of its own, unless it has begun: the
processor of the thread that waits is free. All these threads are daemons: they end with the process, together
with their compilers.
Sources are piped to the compiler; all other files are in one folder that is always removed.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
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

from .cache import avoid_full_cache, library_cache
from .toolchain import Toolchain

logger = logging.getLogger("kineverse.compile")

MAXIMUM_WAITING = 256
# Time of the processor for each program that the compiler starts [s]; what else runs makes no difference.
TIME_LIMIT = 120
_WALL_LIMIT = 3600.0  # for a compiler that waits for something [s]

# What the system says where a file cannot be written for lack of room.
_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_SIGNALLED = "File size limit exceeded"
_NO_ROOM_TEXTS = (*map(os.strerror, _ROOM), _SIGNALLED)

# Compiles within the limit of time. When this process ends, by whatever, the other end of the pipe "$1" is
# closed, and so ends the "read": then the compiler is ended, and its folder removed.
_GUARD = """
ulimit -S -t "$2" 2>/dev/null
(if [ -e "$1" ]; then
    trap '' TERM; read -r nothing < "$1"; kill -TERM 0; rm -rf "$TMPDIR"; kill -KILL 0
fi) > /dev/null 2>&1 &
guard=$!
shift 2
"$@"
status=$?
kill -KILL $guard
exit $status
"""

BuildCallback: TypeAlias = Callable[["BuildJob"], object]


class NoRoomError(Exception):
    """Failure to write a file for lack of room; ``reason`` is what the system says."""

    def __init__(self, reason: str) -> None:
        self.reason = (
            f"{reason}, by 'ulimit -f'" if reason in (_SIGNALLED, os.strerror(errno.EFBIG)) else reason
        )
        super().__init__(f"there is no room to compile in: {self.reason}")

    def __reduce__(self) -> tuple[object, ...]:
        return NoRoomError, (self.reason,)


class _Waits(threading.local):
    seconds = 0.0


_waits = _Waits()


def working_seconds() -> float:
    """Return the time of a clock that stands still while this thread waits for the compiler [s].

    Limits of a search are measured by it: what is compiled once is no part of the search.
    """
    return time.perf_counter() - _waits.seconds


class BuildJob:
    """A library to be compiled."""

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
        self.listeners: list[WeakMethod[BuildCallback]] = []
        self._done = threading.Event()

    @property
    def done(self) -> bool:
        """True if the library was built, or the job failed or was dropped."""
        return self._done.is_set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the job is done, ahead of jobs that are not urgent, and return True if it is."""
        _worker.prioritise(self)
        begin = time.perf_counter()
        try:
            if not self.started:
                _start_thread(_worker.serve, self)
            return self._done.wait(timeout)
        finally:
            _waits.seconds += time.perf_counter() - begin

    def finish(self, path: str | None = None, error: str | None = None) -> None:
        """Set the result and notify the listeners, in the thread that has done the job."""
        self.path, self.error = path, error
        # Listeners first, so that functions have changed when :meth:`wait` returns.
        for listener in self.listeners:
            notify = listener()
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
    listener: BuildCallback,
    urgent: bool = False,
) -> BuildJob | None:
    """Request the compilation of a library in the background."""
    return _worker.request(BuildJob(key, compiler, source, flags), listener, urgent)


class _Worker:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: queue.PriorityQueue[tuple[int, int, BuildJob]] = queue.PriorityQueue()
        self._count = itertools.count()
        self._wanted: dict[str, BuildJob] = {}
        self._thread: threading.Thread | None = None
        self._compilers: dict[BuildJob, subprocess.Popen[bytes]] = {}
        self._build_folders: set[str] = set()
        # Acquired to start a compiler and to end the process, which therefore ends all started compilers.
        self._starting = threading.Lock()
        self._closing = False
        self._warned = False

    def request(self, build: BuildJob, listener: BuildCallback, urgent: bool) -> BuildJob | None:
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
                    self._thread = _start_thread(self._run)
            known.listeners.append(WeakMethod(listener))
        if urgent:
            self.prioritise(known)
        return known

    def prioritise(self, build: BuildJob) -> None:
        with self._lock:
            if build.urgent or build.done:
                return
            build.urgent = True
            if not build.started:
                self._queue.put((False, next(self._count), build))
            elif build in self._compilers:
                _set_session_niceness(self._compilers[build].pid, 0)

    def _run(self) -> None:
        while not self._closing:
            self.serve(self._queue.get()[-1])

    def serve(self, build: BuildJob) -> None:
        """Do a job in this thread, unless it has begun."""
        with self._lock:
            # A job that became urgent is in the queue twice, and one that is waited for has a thread.
            if build.started or build.done:
                return
            build.started = True
            build.forgotten = not build.urgent and all(listener() is None for listener in build.listeners)
            if build.forgotten:
                # Later requests get a new job.
                del self._wanted[build.key]
        path, error = None, None
        try:
            # Another process may have compiled it meanwhile.
            path = None if build.forgotten else build.cache.find(build.key) or self._compile_somewhere(build)
        except Exception as problem:
            error = getattr(problem, "strerror", None) or str(problem)
            self._log_failure(error)
        with self._lock:
            if self._wanted.get(build.key) is build:
                del self._wanted[build.key]
        build.finish(path, error)

    def _compile_somewhere(self, build: BuildJob) -> str:
        """Compile a library in the cache, or where there is room, and return its path."""
        try:
            return self._compile(build)
        except NoRoomError as error:
            try:
                build.cache = avoid_full_cache(build.cache, error.reason)
            except OSError:
                raise error from None
            return self._compile(build)

    def _compile(self, build: BuildJob) -> str:
        try:
            return self._run_compiler(build)
        except OSError as error:
            if error.errno in _ROOM:
                raise NoRoomError(os.strerror(error.errno)) from None
            raise

    def _run_compiler(self, build: BuildJob) -> str:
        source, build_folder = build.source().encode(), ""
        ends: tuple[int, ...] = ()
        try:
            with self._starting:
                if self._closing:
                    raise RuntimeError("the process ends.")
                build_folder = build.cache.create_build_folder()
                self._build_folders.add(build_folder)
                output = os.path.join(build_folder, "library.so")
                ends = alive, _ = os.pipe()
                compiler = subprocess.Popen(
                    _guarded(build.compiler.arguments(build.flags, output), alive),
                    pass_fds=(alive,) if os.name == "posix" else (),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    env=build.compiler.environment(build_folder),
                    # The compiler starts processes of its own; in a session of their own they can be ended
                    # together, and do not receive the user's Ctrl-C.
                    start_new_session=True,
                )
                with self._lock:
                    self._compilers[build] = compiler
                    if not build.urgent:
                        _lower_priority(compiler.pid)
            began = time.monotonic()
            try:
                _, messages = compiler.communicate(source, timeout=_WALL_LIMIT)
            except subprocess.TimeoutExpired:
                raise RuntimeError(f"the C compiler needed more than {_WALL_LIMIT:.0f} s.") from None
            finally:
                _end(compiler)
                with self._lock:
                    del self._compilers[build]
            if compiler.returncode or not os.path.exists(output):
                text = messages.decode(errors="replace").strip()
                for words in _NO_ROOM_TEXTS:
                    if words in text:
                        raise NoRoomError(words)
                if "CPU time limit" in text or compiler.returncode - 128 == signal.SIGXCPU:
                    raise RuntimeError(f"the C compiler needed more than {TIME_LIMIT} s of processor time.")
                raise RuntimeError(f"the C compiler failed ({compiler.returncode}): {text[:500]}")
            logger.debug("Compiled %s in %.2f s.", build.key[:12], time.monotonic() - began)
            return build.cache.store(build.key, output)
        finally:
            for end in ends:
                os.close(end)
            if build_folder:
                shutil.rmtree(build_folder, ignore_errors=True)
                self._build_folders.discard(build_folder)

    def _log_failure(self, error: str) -> None:
        """Log a failure, as a warning only once: a compiler that fails for one function fails for all."""
        if not self._closing:
            level = logging.DEBUG if self._warned else logging.WARNING
            logger.log(level, "A function stays with CasADi's interpreter: %s", error)
            self._warned = True

    def close(self) -> None:
        """End all compilers and remove their folders, when the process ends."""
        with self._starting:
            self._closing = True
            for compiler in [*self._compilers.values()]:
                _end(compiler)
            for folder in [*self._build_folders]:
                shutil.rmtree(folder, ignore_errors=True)

    def abandon(self) -> None:
        """Drop the jobs of the parent process, in a child process without the worker's thread."""
        for build in self._wanted.values():
            # A thread that does not exist here may own the lock inside of the old event.
            build._done = threading.Event()
            build.forgotten = True
            build._done.set()


def _guarded(command: list[str], alive: int) -> list[str]:
    """Return the command line that ends with this process, which has the other end of a pipe."""
    if not os.path.exists("/bin/sh"):
        return command
    return ["/bin/sh", "-c", _GUARD, "sh", f"/dev/fd/{alive}", str(TIME_LIMIT), *command]


def _start_thread(target: Callable[..., object], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=target, args=arguments, name="kineverse-compile", daemon=True)
    thread.start()
    return thread


def _lower_priority(process_group: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PGRP, process_group, 19)
    _set_session_niceness(process_group, 19)


def _set_session_niceness(leader: int, niceness: int) -> None:
    """Set the niceness of a session on Linux, which shares the processor among sessions first.

    There, the niceness of a process counts within its session only, and a compiler has one of its own.
    """
    with contextlib.suppress(OSError), open(f"/proc/{leader}/autogroup", "wb") as file:
        file.write(b"%d" % niceness)


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
