"""The shared library of one program: from the cache at once, else from the compiler when it is done."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakMethod

from .cache import library_cache
from .program import Program
from .toolchain import CLOSED, Toolchain, toolchain
from .worker import Build, request

Code = TypeVar("Code")

NO_COMPILER = "there is no C compiler (cc, gcc or clang) on the PATH"


class Library(Generic[Code]):
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
        self._build: Build | None = None
        self._toolchain: Toolchain | None = toolchain()
        level = optimisation(program.instructions)
        self._flags = (level or "", *CLOSED)
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

    def _built(self, build: Build) -> None:
        if build.path is not None and self.code is None:
            self.code = build.cache.load(self._key, self._load)
        if self.code is None and not build.forgotten:
            self.error = build.error or "its library cannot be loaded"
        notify = self._ready() if self._ready is not None else None
        if notify is not None:
            notify()


def optimisation(instructions: int) -> str | None:
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
