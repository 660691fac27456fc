"""Shared libraries of generated and hand-written C, from the cache or the build queue; report on the compiler."""

from __future__ import annotations

import ctypes
import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakMethod

from .build_queue import BuildJob, request
from .cache import library_cache
from .parallel import cores
from .program import Program
from .toolchain import FLOATING_POINT_FLAGS, NO_UNDEFINED_FLAGS, Toolchain, toolchain

Code = TypeVar("Code")

NO_COMPILER = "there is no C compiler (cc, gcc or clang) on the PATH"


class ProgramLibrary(Generic[Code]):
    """Code of one program, once there is some.

    Parameters
    ----------
    program
        What it computes.
    kind
        What is generated from the program, and by which version of what generates it.
    source
        Generates the C; called in another thread, if at all.
    load
        Makes of the path of a library what can be called; raises if that fails.
    ready
        A method that is called when the compiler has made it, in another thread. It is held weakly.

    Attributes
    ----------
    code
        What can be called; None until it is there.
    error
        Why it will never be there; None until that is known.
    """

    def __init__(
        self,
        program: Program,
        kind: str,
        source: Callable[[], str],
        load: Callable[[str], Code],
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
        level = optimisation_level(program.instructions)
        self._flags = (level or "", *NO_UNDEFINED_FLAGS)
        if self._toolchain is None:
            self.error = NO_COMPILER
        elif level is None:
            self.error = f"{program.instructions} operations are too many for a C compiler"
        else:
            self._key = program.key(kind, self._toolchain.identity, level)

    def find(self) -> bool:
        """Take it from the cache; return whether it is there now."""
        if self.code is None and self.error is None:
            self.code = library_cache().load(self._key, self._load)
        return self.code is not None

    def request(self, urgent: bool = False) -> None:
        """Have it compiled in the background, unless it is there or there is no hope."""
        if self.code is not None or self.error is not None or self._toolchain is None:
            return
        if self._build is None or self._build.done:
            self._build = request(self._key, self._toolchain, self._source, self._flags, self._built, urgent)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is there or cannot be made; return whether it is there.

        Parameters
        ----------
        timeout
            In seconds; forever if None.
        """
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


def optimisation_level(instructions: int) -> str | None:
    """Return how hard the compiler may try without taking minutes; None if it should not be asked at all.

    gcc 12 takes 0.2 ms an instruction at -O3, 0.12 ms at -O1 (7 % slower code) and 0.06 ms at -O0 (three
    times slower, and four times faster than the interpreter).
    """
    if instructions <= 8_000:
        return "-O3"
    if instructions <= 60_000:
        return "-O1"
    if instructions <= 400_000:
        return "-O0"
    return None


class SourceLibrary:
    """The functions of a C source, once there are any.

    Until then, and without a compiler, who uses them does the same in numpy.

    Parameters
    ----------
    source
        The C.
    declare
        Gives the loaded functions their types.
    flags
        For the compiler.
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
        self._hopeless = False
        self._lock = threading.Lock()

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return self._code is not None

    @property
    def code(self) -> Any:
        """The compiled functions, or None."""
        return self._code

    def prepare(self, wait: bool = False) -> bool:
        """Take it from the cache or have it compiled in the background; return whether it is there."""
        if self._code is not None:
            return True
        with self._lock:
            if self._build is None and self._code is None:
                self._build = self._seek()
            build = self._build
        if wait and build is not None:
            build.wait(None)
            self._built(build)
        return self.is_native

    def _seek(self) -> BuildJob | None:
        compiler = None if self._hopeless else toolchain()
        if compiler is None:
            self._hopeless = True
            return None
        version = (self._source, self._flags, compiler.identity)
        key = hashlib.sha256(repr(version).encode()).hexdigest()[:40]
        self._code = library_cache().load(key, self._loaded)
        if self._code is not None:
            return None
        return request(key, compiler, lambda: self._source, self._flags, self._built)

    def _built(self, build: BuildJob) -> None:
        if build.path is not None and self._code is None:
            self._code = build.cache.load(build.key, self._loaded)
        self._hopeless = self._code is None and not build.forgotten
        self._build = None

    def _loaded(self, path: str) -> Any:
        code = ctypes.CDLL(path)
        self._declare(code)
        return code


@dataclass(frozen=True, slots=True)
class CompilerInformation:
    """What compiles functions on this machine.

    Attributes
    ----------
    compiler
        The path of the C compiler; None if there is none, so that everything stays interpreted.
    version
        What the compiler says it is.
    flags
        What it is told about optimisation and arithmetic, for functions of moderate size.
    vector_unit
        The widest vector instructions that batches use: ``avx512``, ``avx2``, ``avx``, ``sse2``, ``neon``,
        ``none``.
    cores
        How many cores batches are spread over.
    cache_folder
        Where compiled libraries are kept.
    """

    compiler: str | None
    version: str | None
    flags: tuple[str, ...]
    vector_unit: str
    cores: int
    cache_folder: str


def compiler_information() -> CompilerInformation:
    """Return what compiles functions on this machine; it asks the compiler, which takes some milliseconds."""
    found = toolchain()
    return CompilerInformation(
        compiler=found.command[0] if found else None,
        version=found.version() if found else None,
        flags=(optimisation_level(0) or "", *FLOATING_POINT_FLAGS) if found else (),
        vector_unit=found.vector_unit() if found else "none",
        cores=cores(),
        cache_folder=str(library_cache().folder),
    )
