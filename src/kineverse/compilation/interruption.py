"""End of C that lasts: when its time is up, and when a signal such as Ctrl-C arrives.

Python notes a signal and runs its handler when it is back in Python. So C that may last asks Python from
time to time, by ``interruption.h``. What a handler raises is kept until C has returned.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any


class _Signals(ctypes.Structure):
    _functions = ("PyGILState_Ensure", "PyGILState_Release", "PyErr_CheckSignals", "PyErr_Fetch")
    _fields_ = tuple((name, ctypes.c_void_p) for name in (*_functions, "type", "value", "traceback"))


_api = ctypes.pythonapi
# The exception is written and read by the main thread only, which runs all handlers.
_signals = _Signals(*(ctypes.cast(getattr(_api, name), ctypes.c_void_p) for name in _Signals._functions))
_restore = _api.PyErr_Restore
_restore.argtypes, _restore.restype = (ctypes.c_void_p,) * 3, None


def watch_signals(code: Any) -> None:
    """Tell a loaded library, if its source has ``interruption.h``, how to look for signals."""
    watch = getattr(code, "kineverse_watch_signals", None)
    if watch is not None:
        watch.argtypes, watch.restype = (ctypes.c_void_p,), None
        watch(ctypes.addressof(_signals))


def raise_signal() -> None:
    """Raise what a handler of signals has raised while C was running in this thread, if any has."""
    if _signals.type and threading.current_thread() is threading.main_thread():
        given = _signals.type, _signals.value, _signals.traceback
        _signals.type = _signals.value = _signals.traceback = None
        _restore(*given)
