"""Names for what a format needs and a model does not have."""

from __future__ import annotations

from collections.abc import Iterable


class Names:
    """Names of one kind that are taken."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)

    def take(self, *wishes: str) -> str:
        """Return the first wish that is free, else the last with a number behind it; it is taken then."""
        for wish in wishes:
            if wish not in self._taken:
                self._taken.add(wish)
                return wish
        count = 2
        while f"{wishes[-1]}_{count}" in self._taken:
            count += 1
        return self.take(f"{wishes[-1]}_{count}")
