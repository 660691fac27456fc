"""Thread pool over the rows of a batch."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

# Pieces per thread on average, so that the other threads take over from a delayed one.
_PIECES = 4
# A piece has at most so many times the smallest number of rows that is worth a thread: some 20 ms.
_LARGEST = 200

_threads: ThreadPoolExecutor | None = None


def cores() -> int:
    """Return the number of cores for this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def parallel_rows(work: Callable[[int, int], object], rows: int, smallest: int, align: int = 8) -> None:
    """Call ``work(first, end)`` for pieces of all rows, in several threads if there are enough rows.

    Notes
    -----
    A signal, such as Ctrl-C, ends the call between two pieces. No thread works on when it has ended, since
    memory of the rows may be gone then.
    """
    threads = max(min(cores(), rows // max(smallest, 1)), 1)
    piece = _LARGEST * max(smallest, 1)
    if threads > 1:
        piece = min(piece, max(-(-rows // (threads * _PIECES)), smallest))
    piece = -(-piece // align) * align
    starts = iter(range(0, rows, piece))
    if threads == 1:
        for first in starts:
            work(first, min(first + piece, rows))
        return

    def take() -> None:
        # Advancing a range iterator is atomic; every thread takes the next piece after finishing one.
        for first in starts:
            work(first, min(first + piece, rows))

    helpers = [_pool().submit(take) for _ in range(threads - 1)]
    try:
        take()
    finally:
        for _ in starts:  # none are left for the others, if an exception ends this
            pass
        wait(helpers)
    for helper in helpers:
        helper.result()


def _pool() -> ThreadPoolExecutor:
    global _threads
    if _threads is None:
        _threads = ThreadPoolExecutor(max(cores() - 1, 1), thread_name_prefix="kineverse-batch")
    return _threads


def _forked() -> None:
    global _threads
    _threads = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
