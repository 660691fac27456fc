"""Context manager that pauses Python's cyclic garbage collector."""

from __future__ import annotations

import gc


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
