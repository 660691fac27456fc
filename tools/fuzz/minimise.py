"""Minimisation of failing inputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from .targets import Target


def minimise(data: bytes, target: Target, fails: Callable[[bytes], bool], seconds: float = 60.0) -> bytes:
    """Return a failing input from which nothing can be removed, or the smallest one found in time."""
    end = time.monotonic() + seconds
    smaller = True
    while smaller and time.monotonic() < end:
        smaller = False
        for reduce in (target.reduce, _chunks):
            found = True
            while found and time.monotonic() < end:
                found = False
                for candidate in reduce(data):
                    if time.monotonic() > end:
                        break
                    if len(candidate) < len(data) and fails(candidate):
                        data, found, smaller = candidate, True, True
                        break
    return data


def _chunks(data: bytes) -> Iterator[bytes]:
    """Yield inputs without a run of bytes, long runs first (delta debugging)."""
    size = len(data) // 2
    while size >= (1 if len(data) <= 2000 else 16):
        for at in range(0, len(data), size):
            yield data[:at] + data[at + size :]
        size //= 2
