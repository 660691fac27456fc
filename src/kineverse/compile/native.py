"""The extension that calls compiled functions, compiled and kept like them.

It saves four fifths of the time of a call. Where Python's headers or a compiler are missing, calls go through
CasADi's buffers instead and give the same.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import os
import sys
import sysconfig
import threading
from collections.abc import Callable
from typing import Any, Literal
from weakref import WeakMethod

import numpy as np

from .cache import LibraryCache, library_cache
from .evaluator import Evaluator
from .native_source import NATIVE
from .toolchain import toolchain
from .worker import Build, request

# The extension has room for so many results.
MOST_OUTPUTS = 256
_NAME = "kineverse_native"


class Native:
    """The extension, once there is one.

    Attributes
    ----------
    module
        The extension module; None until it is loaded.
    """

    def __init__(self) -> None:
        self.module: Any = None
        self._state: Literal["unknown", "awaited", "settled"] = "unknown"
        self._watchers: list[WeakMethod[Callable[[], object]]] = []
        self._lock = threading.Lock()

    def prepare(self, watcher: Callable[[], object], urgent: bool = False) -> None:
        """Load the extension from the cache, or have it compiled in the background; it is tried once.

        Parameters
        ----------
        watcher
            A method that is called if it is loaded later, in another thread; held weakly.
        urgent
            Whether somebody waits for something that will use it.
        """
        if self._state == "settled":
            return
        with self._lock:
            if self._state == "unknown":
                self._state = "awaited" if self._seek(urgent) else "settled"
            if self._state == "awaited":
                self._watchers.append(WeakMethod(watcher))

    def _seek(self, urgent: bool) -> bool:
        """Load it or have it compiled; return whether it is still to come."""
        compiler = toolchain()
        if compiler is None:
            return False
        version = (NATIVE, compiler.identity, sys.version, sys.base_prefix, np.__version__)
        key = hashlib.sha256(repr(version).encode()).hexdigest()[:40]
        if self._take(library_cache(), key):
            return False
        headers = sysconfig.get_path("include")
        if not os.path.exists(os.path.join(headers, "Python.h")):
            return False
        flags = ("-O2", f"-I{headers}", f"-I{np.get_include()}")
        return request(key, compiler, lambda: NATIVE, flags, self._built, urgent) is not None

    def _built(self, build: Build) -> None:
        if build.path is not None:
            self._take(build.cache, build.key)
        with self._lock:
            self._state = "settled"
            watchers, self._watchers = self._watchers, []
        for watcher in watchers:
            notify = watcher()
            if notify is not None:
                notify()

    def _take(self, cache: LibraryCache, key: str) -> bool:
        module = cache.load(key, _module)
        if module is None:
            return False
        Evaluator.register(module.Evaluator)
        self.module = module
        return True


def _module(path: str) -> Any:
    loader = importlib.machinery.ExtensionFileLoader(_NAME, path)
    specification = importlib.util.spec_from_file_location(_NAME, path, loader=loader)
    if specification is None:
        raise ImportError("it is no extension")
    module = importlib.util.module_from_spec(specification)
    loader.exec_module(module)
    if not (hasattr(module, "Call") and hasattr(module, "Evaluator")):
        raise ImportError("it has no Call and Evaluator")
    return module


native = Native()
