"""The sweep in C, compiled in the background and kept like compiled functions; numpy until then."""

from __future__ import annotations

import ctypes
import hashlib
import threading
from typing import Any

import numpy as np

from kineverse.compile.cache import library_cache
from kineverse.compile.toolchain import CLOSED, toolchain
from kineverse.compile.worker import Build, request

from . import sweep
from .mesh_files import Floats
from .sweep_source import SWEEP
from .table import Indices, Table

_ARRAYS = (
    "body", "allowed", "active", "centre", "half", "radius",
    "poses", "travel", "place", "low", "high", "bounds", "order",
)  # fmt: skip


class _Struct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "moving", "bodies", "axis")),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


class SweepLibrary:
    """The compiled sweep, once there is one; for all scenes of the process."""

    def __init__(self) -> None:
        self._code: Any = None
        self._build: Build | None = None
        self._hopeless = False
        self._lock = threading.Lock()

    @property
    def is_native(self) -> bool:
        """Whether C does the work."""
        return self._code is not None

    def prepare(self, wait: bool = False) -> bool:
        """Take it from the cache or have it compiled in the background; return whether it is there."""
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
        key = hashlib.sha256(repr((SWEEP, compiler.identity)).encode()).hexdigest()[:40]
        path = library_cache().find(key)
        if path is not None:
            self._load(path)
            return None
        return request(key, compiler, lambda: SWEEP, ("-O3", *CLOSED), self._built)

    def _built(self, build: Build) -> None:
        if build.path is not None and self._code is None:
            self._load(build.path)
        self._hopeless = self._code is None and not build.forgotten
        self._build = None

    def _load(self, path: str) -> None:
        try:
            code = ctypes.CDLL(path)
        except OSError:
            self._hopeless = True
            return
        pointer = ctypes.c_void_p
        code.place.argtypes, code.place.restype = (pointer, pointer), ctypes.c_int64
        code.near.argtypes = (pointer, ctypes.c_double, pointer, pointer, ctypes.c_int64)
        code.near.restype = ctypes.c_int64
        self._code = code

    def place(self, table: Table, fresh: Floats) -> int:
        """Do what :func:`.sweep.place` does; ``fresh`` is contiguous."""
        if self._code is None:
            return sweep.place(table, fresh)
        return int(self._code.place(_native(table).address, fresh.ctypes.data))

    def near(self, table: Table, reach: float) -> tuple[Indices, Floats]:
        """Do what :func:`.sweep.near` does."""
        if self._code is None:
            return sweep.near(table, reach)
        native = _native(table)
        while True:
            found = self._code.near(native.address, reach, *native.results)
            if found <= len(native.lows):
                return native.pairs[:found], native.lows[:found]
            native.room(2 * found)


class _Native:
    """A table as C sees it, and where the pairs go."""

    def __init__(self, table: Table) -> None:
        self.struct = _Struct()
        for name in _ARRAYS:
            array = getattr(table, name)
            setattr(self.struct, name, None if array is None else array.ctypes.data)
        self.struct.count, self.struct.moving = table.count, table.moving
        self.struct.bodies = len(table.allowed)
        self.address = ctypes.addressof(self.struct)
        self.room(256)

    def room(self, count: int) -> None:
        """Make room for so many pairs."""
        self.pairs = np.empty((count, 2), dtype=np.int32)
        self.lows = np.empty(count)
        self.results = self.pairs.ctypes.data, self.lows.ctypes.data, count


def _native(table: Table) -> _Native:
    native: _Native | None = table.native
    if native is None:
        native = table.native = _Native(table)
    native.struct.axis = table.axis
    return native


sweep_library = SweepLibrary()
