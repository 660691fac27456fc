"""C written by hand: compiled in the background, once for the process, and kept like compiled functions."""

from __future__ import annotations

import ctypes
import hashlib
import threading
from collections.abc import Callable
from typing import Any

from .cache import library_cache
from .toolchain import CLOSED, toolchain
from .worker import Build, request


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
        self, source: str, declare: Callable[[Any], None], flags: tuple[str, ...] = ("-O3", *CLOSED)
    ) -> None:
        self._source, self._declare, self._flags = source, declare, flags
        self._code: Any = None
        self._build: Build | None = None
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

    def _seek(self) -> Build | None:
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

    def _built(self, build: Build) -> None:
        if build.path is not None and self._code is None:
            self._code = build.cache.load(build.key, self._loaded)
        self._hopeless = self._code is None and not build.forgotten
        self._build = None

    def _loaded(self, path: str) -> Any:
        code = ctypes.CDLL(path)
        self._declare(code)
        return code
