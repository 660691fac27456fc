"""Methods of objects that several threads use."""

from __future__ import annotations

import _thread
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar


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
