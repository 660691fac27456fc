"""Shared libraries of C, compiled in the background, and calls of them over rows in several threads."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakMethod

from .build_queue import BuildJob, request
from .c_source import read_source
from .cache import library_cache
from .interruption import watch_signals
from .program import Program
from .toolchain import (
    FLOATING_POINT_FLAGS,
    NO_UNDEFINED_FLAGS,
    Toolchain,
    no_compiler,
    optimisation_level,
    toolchain,
)

Code = TypeVar("Code")
_KINDS = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double}


def struct_fields(groups: str) -> list[tuple[str, Any]]:
    """Return the fields of a structure, such as ``"i count room; p pairs lows; d reach"``.

    Each group has a kind, of pointers, 64-bit integers and doubles, and names.
    """
    parts = (group.split() for group in groups.split(";"))
    return [(name, _KINDS[kind]) for kind, *names in parts for name in names]


def open_library(path: str) -> ctypes.CDLL:
    """Return a library, which is unloaded with the last reference to it or to one of its functions.

    Not so what was made of the address of a function.
    """
    library = ctypes.CDLL(path)
    with contextlib.suppress(
        ImportError
    ):  # ctypes itself never unloads; on Windows the call has another name
        from _ctypes import dlclose

        weakref.finalize(library, dlclose, library._handle).atexit = False
    return library


class ProgramLibrary(Generic[Code]):
    """The compiled library of one program, loaded when it is ready."""

    def __init__(
        self,
        program: Program,
        kind: str,
        source: Callable[[], str],
        load: Callable[[str], Code],
        level: str | None,
        flags: tuple[str, ...] = (),
        ready: Callable[[], object] | None = None,
    ) -> None:
        self.code: Code | None = None
        self.error: str | None = None
        self._program = program
        self._source = source
        self._load = load
        self._ready = WeakMethod(ready) if ready is not None else None
        self._build: BuildJob | None = None
        self._toolchain: Toolchain | None = toolchain()
        self._flags = (level or "", *flags, *NO_UNDEFINED_FLAGS)
        if self._toolchain is None:
            self.error = no_compiler()
        elif level is None:
            self.error = f"{program.instructions} operations are too many for a C compiler"
        else:
            self.key = program.key(kind, self._toolchain.identity, level)

    def find(self) -> bool:
        """Load the library from the cache, and return True if it is loaded."""
        if self.code is None and self.error is None:
            self.code = library_cache().load(self.key, self._load)
        return self.code is not None

    def request(self, urgent: bool = False) -> None:
        """Request compilation in the background, unless the library is loaded or cannot be compiled."""
        if self.code is not None or self.error is not None or self._toolchain is None:
            return
        if self._build is None or self._build.done:
            self._build = request(self.key, self._toolchain, self._source, self._flags, self._built, urgent)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the library is loaded or has failed, and return True if it is loaded."""
        end = None if timeout is None else time.monotonic() + timeout
        while self.code is None and self.error is None:
            self.request(urgent=True)
            left = None if end is None else max(end - time.monotonic(), 0.0)
            if self._build is None or not self._build.wait(left):
                break
        return self.code is not None

    def _built(self, build: BuildJob) -> None:
        if build.path is not None and self.code is None:
            self.code = build.cache.load(self.key, self._load)
        if self.code is None and not build.forgotten:
            self.error = build.error or "its library cannot be loaded"
        notify = self._ready() if self._ready is not None else None
        if notify is not None:
            notify()


class SourceLibrary:
    """The compiled functions of a hand-written file, see :func:`.read_source`, loaded when they are ready.

    Until then, and without a compiler, the callers compute the same in numpy. The source is compiled with the
    constants as macros.
    """

    def __init__(
        self,
        file: str,
        declare: Callable[[Any], None],
        flags: tuple[str, ...] = ("-O3",),
        **constants: float,
    ) -> None:
        self.file, self._declare = file, declare
        self.flags = (
            *flags,
            *(f"-D{name}={value}" for name, value in constants.items()),
            *NO_UNDEFINED_FLAGS,
        )
        self._code: Any = None
        self._build: BuildJob | None = None
        self.error: str | None = None
        self._lock = threading.Lock()

    @property
    def is_native(self) -> bool:
        """True if the compiled functions are loaded."""
        return self._code is not None

    @property
    def code(self) -> Any:
        """The compiled functions, or None."""
        return self._code

    def prepare(self, wait: bool = False) -> bool:
        """Load the library from the cache or request its compilation, and return True if it is loaded."""
        if self._code is not None:
            return True
        with self._lock:
            if self._build is None and self._code is None:
                self._build = self._find_or_request()
            build = self._build
        if wait and build is not None:
            build.wait(None)
            self._built(build)
        return self.is_native

    def _find_or_request(self) -> BuildJob | None:
        if self.error is not None:
            return None
        compiler = toolchain()
        if compiler is None:
            self.error = no_compiler()
            return None
        source = read_source(self.file)
        version = (source, self.flags, compiler.identity)
        key = hashlib.sha256(repr(version).encode()).hexdigest()[:40]
        self._code = library_cache().load(key, self._load)
        if self._code is not None:
            return None
        # There are few of them, and without one its callers take up to a hundred times as long.
        return request(key, compiler, lambda: source, self.flags, self._built, urgent=True)

    def _built(self, build: BuildJob) -> None:
        if build.path is not None and self._code is None:
            self._code = build.cache.load(build.key, self._load)
        if self._code is None and not build.forgotten:
            self.error = build.error or "its library cannot be loaded"
        self._build = None

    def _load(self, path: str) -> Any:
        code = ctypes.CDLL(path)
        watch_signals(code)
        self._declare(code)
        return code


@dataclass(frozen=True, slots=True)
class CompilerInformation:
    """Compiler, vector instructions, cores and cache of this machine.

    Attributes
    ----------
    compiler
        The path of the C compiler; None if there is none and all functions are interpreted.
    flags
        Flags for optimisation and arithmetic, for functions of moderate size.
    vector_unit
        The widest vector instructions of batches: ``avx512``, ``avx2``, ``avx``, ``sse2``, ``neon``,
        ``none``.
    cores
        The number of cores for batches.

    See Also
    --------
    kineverse.compilation.compiler_information
    """

    compiler: str | None
    version: str | None
    flags: tuple[str, ...]
    vector_unit: str
    cores: int
    cache_folder: str


def compiler_information() -> CompilerInformation:
    """Return information on the compiler of this machine; running it takes some milliseconds.

    Examples
    --------
    >>> information = kv.compilation.compiler_information()
    >>> information.compiler is None or information.version is not None
    True
    """
    found = toolchain()
    return CompilerInformation(
        compiler=found.command[0] if found else None,
        version=found.version() if found else None,
        flags=(optimisation_level(0) or "", *FLOATING_POINT_FLAGS) if found else (),
        vector_unit=found.vector_unit() if found else "none",
        cores=cores(),
        cache_folder=str(library_cache().folder),
    )


_PIECES = 4  # pieces per thread on average, so that the other threads take over from a delayed one
# A piece has at most so many times the smallest number of rows that is worth a thread: some 20 ms.
_LARGEST = 200

_threads: ThreadPoolExecutor | None = None


def cores() -> int:
    """Return the number of cores for this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parallel_rows(work: Callable[[int, int], object], rows: int, smallest: int, align: int = 8) -> None:
    """Call ``work(first, end)`` for pieces of all rows, in several threads if there are enough rows.

    Notes
    -----
    A signal, such as Ctrl-C, ends the call between two pieces. No thread works on when it has ended, since
    memory of the rows may be gone then.
    """
    threads = max(min(cores(), rows // max(smallest, 1)), 1)
    piece = _LARGEST * max(smallest, 1)
    if threads > 1:
        piece = min(piece, max(-(-rows // (threads * _PIECES)), smallest))
    piece = -(-piece // align) * align
    starts = iter(range(0, rows, piece))
    if threads == 1:
        for first in starts:
            work(first, min(first + piece, rows))
        return

    def take() -> None:
        # Advancing a range iterator is atomic; every thread takes the next piece after finishing one.
        for first in starts:
            work(first, min(first + piece, rows))

    helpers = [_pool().submit(take) for _ in range(threads - 1)]
    try:
        take()
    finally:
        for _ in starts:  # none are left for the others, if an exception ends this
            pass
        wait(helpers)
    for helper in helpers:
        helper.result()


def _pool() -> ThreadPoolExecutor:
    global _threads
    if _threads is None:
        _threads = ThreadPoolExecutor(max(cores() - 1, 1), thread_name_prefix="kineverse-batch")
    return _threads


def _forked() -> None:
    global _threads
    _threads = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
