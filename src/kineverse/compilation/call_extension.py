"""Loader of the CPython extension ``call_extension.c``, which calls compiled functions.

The extension does in C the same as :mod:`.evaluator` in Python, and saves four fifths of the time of a call.
Without Python's headers or a compiler, calls go through CasADi's buffers instead, with the same results.
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

from .build_queue import BuildJob, request
from .c_source import read_source
from .cache import LibraryCache, library_cache
from .evaluator import Evaluator
from .toolchain import toolchain

MOST_OUTPUTS = 256  # largest number of outputs of a function
_EXTENSION_NAME = "kineverse_native"


class CallExtension:
    """The extension module, loaded when it is ready."""

    def __init__(self) -> None:
        self.module: Any = None
        self._state: Literal["unknown", "awaited", "settled"] = "unknown"
        self._listeners: list[WeakMethod[Callable[[], object]]] = []
        self._build: BuildJob | None = None
        self._lock = threading.Lock()

    def prepare(self, listener: Callable[[], object], urgent: bool = False) -> None:
        """Load the extension from the cache, or request its compilation in the background, once."""
        if self._state == "settled":
            return
        with self._lock:
            if self._state == "unknown":
                self._state = "awaited" if self._find_or_request(urgent) else "settled"
            if self._state == "awaited":
                self._listeners.append(WeakMethod(listener))

    def _find_or_request(self, urgent: bool) -> bool:
        """Load the extension or request its compilation, and return True if it is requested."""
        compiler = toolchain()
        if compiler is None:
            return False
        source = read_source("call_extension.c")
        version = (source, compiler.identity, sys.version, sys.base_prefix, np.__version__)
        key = hashlib.sha256(repr(version).encode()).hexdigest()[:40]
        if self._take(library_cache(), key):
            return False
        headers = sysconfig.get_path("include")
        if not os.path.exists(os.path.join(headers, "Python.h")):
            return False
        flags = ("-O2", f"-DMOST_OUTPUTS={MOST_OUTPUTS}", f"-I{headers}", f"-I{np.get_include()}")
        self._build = request(key, compiler, lambda: source, flags, self._built, urgent)
        return self._build is not None

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the extension is loaded or has failed, at most some time [s]; None for no limit."""
        if self._state == "awaited" and self._build is not None:
            self._build.wait(timeout)

    def _built(self, build: BuildJob) -> None:
        if build.path is not None:
            self._take(build.cache, build.key)
        with self._lock:
            self._state = "settled"
            listeners, self._listeners = self._listeners, []
        for listener in listeners:
            notify = listener()
            if notify is not None:
                notify()

    def _take(self, cache: LibraryCache, key: str) -> bool:
        module = cache.load(key, _import_extension)
        if module is None:
            return False
        Evaluator.register(module.Evaluator)
        self.module = module
        return True


def _import_extension(path: str) -> Any:
    loader = importlib.machinery.ExtensionFileLoader(_EXTENSION_NAME, path)
    specification = importlib.util.spec_from_file_location(_EXTENSION_NAME, path, loader=loader)
    if specification is None:
        raise ImportError("it is no extension")
    module = importlib.util.module_from_spec(specification)
    loader.exec_module(module)
    if not (hasattr(module, "Call") and hasattr(module, "Evaluator")):
        raise ImportError("it has no Call and Evaluator")
    return module


call_extension = CallExtension()
