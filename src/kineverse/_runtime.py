"""Threads, garbage and limits: locks of objects, pauses of the garbage collector, bounds of a process."""

from __future__ import annotations

import _thread
import gc
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, Self, TypeVar


class no_collection:  # noqa: N801
    """Pause the garbage collector, for code that creates many objects and no garbage.

    A generator would do, but takes several times as long, and controllers pause it in each step.
    """

    __slots__ = ("_collecting",)

    def __enter__(self) -> None:
        self._collecting = gc.isenabled()
        gc.disable()

    def __exit__(self, *_: object) -> None:
        if self._collecting:
            gc.enable()


class Closing:
    """Context manager that is closed at the end of its block."""

    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class CallLock(_thread.RLock):  # type: ignore[misc]  # final for type checkers only
    """Lock of an object's methods, which may call each other; its copies and pickles are other locks."""

    def __reduce__(self) -> tuple[type[CallLock], tuple[()]]:
        return CallLock, ()


class Lockable(Protocol):
    """Object with a lock."""

    _lock: CallLock


Owner = TypeVar("Owner", bound=Lockable)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def one_at_a_time(
    method: Callable[Concatenate[Owner, Arguments], Result],
) -> Callable[Concatenate[Owner, Arguments], Result]:
    """Return a method that waits until other threads have left the methods of the same object.

    For objects whose calls share tables in memory with compiled code, which runs without Python's lock.
    """

    @wraps(method)
    def alone(self: Owner, /, *args: Arguments.args, **options: Arguments.kwargs) -> Result:
        with self._lock:
            return method(self, *args, **options)

    return alone


def limit_resources(memory: int, cpu_seconds: int | None = None) -> None:
    """Limit the address space [bytes] and the CPU time [s] of this process, where the system can."""
    try:
        import resource  # missing on Windows
    except ImportError:
        return
    for kind, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, cpu_seconds)):
        if most is not None:
            with suppress(ValueError, OSError):
                resource.setrlimit(kind, (most, most))
