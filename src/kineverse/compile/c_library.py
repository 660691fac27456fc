"""Shared libraries of generated and hand-written C, from the cache or the build queue."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakMethod

from .build_queue import BuildJob, request
from .cache import library_cache
from .interruption import watch_signals
from .parallel import cores
from .program import Program
from .toolchain import (
    FLOATING_POINT_FLAGS,
    NO_COMPILER,
    NO_UNDEFINED_FLAGS,
    Toolchain,
    optimisation_level,
    toolchain,
)

Code = TypeVar("Code")


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
            self.error = NO_COMPILER
        elif level is None:
            self.error = f"{program.instructions} operations are too many for a C compiler"
        else:
            self._key = program.key(kind, self._toolchain.identity, level)

    def find(self) -> bool:
        """Load the library from the cache, and return True if it is loaded."""
        if self.code is None and self.error is None:
            self.code = library_cache().load(self._key, self._load)
        return self.code is not None

    def request(self, urgent: bool = False) -> None:
        """Request compilation in the background, unless the library is loaded or cannot be compiled."""
        if self.code is not None or self.error is not None or self._toolchain is None:
            return
        if self._build is None or self._build.done:
            self._build = request(self._key, self._toolchain, self._source, self._flags, self._built, urgent)

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
            self.code = build.cache.load(self._key, self._load)
        if self.code is None and not build.forgotten:
            self.error = build.error or "its library cannot be loaded"
        notify = self._ready() if self._ready is not None else None
        if notify is not None:
            notify()


class SourceLibrary:
    """The compiled functions of a hand-written C source, loaded when they are ready.

    Until then, and without a compiler, the callers compute the same in numpy.
    """

    def __init__(
        self,
        source: str,
        declare: Callable[[Any], None],
        flags: tuple[str, ...] = ("-O3", *NO_UNDEFINED_FLAGS),
    ) -> None:
        self._source, self._declare, self._flags = source, declare, flags
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
            self.error = NO_COMPILER
            return None
        version = (self._source, self._flags, compiler.identity)
        key = hashlib.sha256(repr(version).encode()).hexdigest()[:40]
        self._code = library_cache().load(key, self._load)
        if self._code is not None:
            return None
        # There are few of them, and without one its callers take up to a hundred times as long.
        return request(key, compiler, lambda: self._source, self._flags, self._built, urgent=True)

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
    version
        The compiler's version text.
    flags
        Flags for optimisation and arithmetic, for functions of moderate size.
    vector_unit
        The widest vector instructions of batches: ``avx512``, ``avx2``, ``avx``, ``sse2``, ``neon``,
        ``none``.
    cores
        The number of cores for batches.
    cache_folder
        The folder of compiled libraries.
    """

    compiler: str | None
    version: str | None
    flags: tuple[str, ...]
    vector_unit: str
    cores: int
    cache_folder: str


def compiler_information() -> CompilerInformation:
    """Return information on the compiler of this machine; running it takes some milliseconds."""
    found = toolchain()
    return CompilerInformation(
        compiler=found.command[0] if found else None,
        version=found.version() if found else None,
        flags=(optimisation_level(0) or "", *FLOATING_POINT_FLAGS) if found else (),
        vector_unit=found.vector_unit() if found else "none",
        cores=cores(),
        cache_folder=str(library_cache().folder),
    )
