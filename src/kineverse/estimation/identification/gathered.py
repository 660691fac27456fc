"""Observations that become more."""

from __future__ import annotations

import numpy as np

from kineverse.errors import ShapeError

from .observations import Observations
from .rigid import Array


class Gathered:
    """Observations that came one by one, in arrays that grow by doubling."""

    def __init__(self) -> None:
        self._arrays: list[Array | None] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, one: Observations) -> None:
        """Take one more.

        Raises
        ------
        ShapeError
            If it is of another kind than those before.
        """
        new = [one.parent, one.child, one.parent_covariance, one.child_covariance]
        if not self._arrays:
            self._arrays = [None if array is None else np.empty_like(array) for array in new]
        elif [_kind(array) for array in new] != [_kind(array) for array in self._arrays]:
            raise ShapeError("Poses and positions do not mix, nor a parent that is the world with another.")
        for k, (old, array) in enumerate(zip(self._arrays, new, strict=True)):
            if old is None or array is None:
                continue
            if len(old) == self._count:
                # What was handed out keeps the old array.
                self._arrays[k] = old = np.concatenate([old, np.empty_like(old)])
            old[self._count] = array[0]
        self._count += 1

    @property
    def all(self) -> Observations:
        """All of them."""
        parent, child, of_parent, of_child = (
            None if array is None else array[: self._count] for array in self._arrays
        )
        assert parent is not None
        assert child is not None
        assert of_child is not None  # as only that of the parent may be missing
        return Observations(parent, child, of_parent, of_child)


def _kind(array: Array | None) -> tuple[int, ...] | None:
    return None if array is None else array.shape[1:]
