"""End of C that lasts: when its time is up, and when a signal such as Ctrl-C arrives.

Python notes a signal and runs its handler when it is back in Python. So C that may last asks Python from
time to time, with :data:`WATCH` in its source. What a handler raises is kept until C has returned.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any

WATCH = r"""
#include <math.h>
#include <time.h>

/* Functions of Python, and the exception that a handler of signals has raised: type, value and traceback. */
typedef struct {
  int (*take_gil)(void);
  void (*release_gil)(int);
  int (*check_signals)(void);
  void (*fetch)(void **, void **, void **);
  void *type, *value, *traceback;
} Signals;

static Signals *signals;

__attribute__((visibility("default"))) void kineverse_watch_signals(Signals *s) { signals = s; }

/* Work that is over when its time is up, or a handler has raised an exception. Times of a clock [s]. */
typedef struct {
  double end, next; /* next: when signals are looked at again */
  int calls, over;
} Watch;

enum { GOING_ON, LATE, INTERRUPTED };

/* Nobody notices a delay of so many seconds, and to ask takes microseconds, or until other threads let us. */
#define ASKING 0.05

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void watch_begin(Watch *w, double seconds) {
  const double begin = now();
  w->end = begin + seconds;
  w->next = begin + ASKING;
  w->calls = 0;
  w->over = GOING_ON;
}

static __attribute__((noinline)) int look_at_clock(Watch *w) {
  if (w->over) return w->over;
  const double t = now();
  if (t > w->end) w->over = LATE;
  if (t <= w->next || !signals) return w->over;
  const int gil = signals->take_gil();
  if (signals->check_signals()) {
    signals->fetch(&signals->type, &signals->value, &signals->traceback);
    w->over = INTERRUPTED;
  }
  signals->release_gil(gil);
  w->next = now() + ASKING;
  return w->over;
}

/* As look_at_clock, for loops whose rounds take microseconds: it looks in one round of 32. */
static inline int is_over(Watch *w) { return w->over || ((++w->calls & 31) == 0 && look_at_clock(w)); }
"""


class _Signals(ctypes.Structure):
    _functions = ("PyGILState_Ensure", "PyGILState_Release", "PyErr_CheckSignals", "PyErr_Fetch")
    _fields_ = tuple((name, ctypes.c_void_p) for name in (*_functions, "type", "value", "traceback"))


_api = ctypes.pythonapi
# The exception is written and read by the main thread only, which runs all handlers.
_signals = _Signals(*(ctypes.cast(getattr(_api, name), ctypes.c_void_p) for name in _Signals._functions))
_restore = _api.PyErr_Restore
_restore.argtypes, _restore.restype = (ctypes.c_void_p,) * 3, None


def watch_signals(code: Any) -> None:
    """Tell a loaded library, if its source has :data:`WATCH`, how to look for signals."""
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
