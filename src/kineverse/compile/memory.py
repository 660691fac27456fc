"""Memory for large results, used again when nobody holds the results any more.

Memory that is new to a process is filled with zeros by the system at first touch, which takes three times as
long as computing and writing poses does. A loop over batches drops one result for each it makes, so it gets
that memory back.
"""

from __future__ import annotations

import weakref

import numpy as np
import numpy.typing as npt

_CACHE_LINE = 64
# Smaller blocks the C library keeps by itself.
_SMALLEST = 4 * 2**20
_LARGEST_TOTAL = 128 * 2**20

# Longest free first. Used by operations that are atomic: garbage collection may interrupt this very code to
# give back a block.
_free: list[npt.NDArray[np.float64]] = []


def aligned(size: int) -> npt.NDArray[np.float64]:
    """Return an uninitialised vector that begins at a cache line.

    Its memory is used for another vector only after this one and all arrays made from it are gone.

    Parameters
    ----------
    size
        How many numbers.
    """
    if 8 * size < _SMALLEST:
        return _from_line(np.empty(size + _CACHE_LINE // 8))[:size]
    block = _freed(size + _CACHE_LINE // 8)
    if block is None:
        block = np.empty(size + _CACHE_LINE // 8)
    lease = _Lease(block)
    weakref.finalize(lease, _give_back, block).atexit = False
    return _from_line(np.asarray(lease))[:size]


class _Lease:
    """What arrays in a block are made from: they refer to it, so it lives as long as the last of them."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, block: npt.NDArray[np.float64]) -> None:
        self.__array_interface__ = block.__array_interface__


def _from_line(block: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return block[-block.__array_interface__["data"][0] % _CACHE_LINE // 8 :]


def _freed(size: int) -> npt.NDArray[np.float64] | None:
    """Return a free block of this size, if there is one."""
    for _ in range(len(_free)):
        try:
            block = _free.pop(0)
        except IndexError:
            break
        if block.size == size:
            return block
        _free.append(block)
    return None


def _give_back(block: npt.NDArray[np.float64]) -> None:
    _free.append(block)
    while sum(b.nbytes for b in _free[:]) > _LARGEST_TOTAL:
        try:
            _free.pop(0)
        except IndexError:
            break
