"""Names that belong together, merged as it becomes known that they do."""

from __future__ import annotations


class Groups:
    """Names that belong together."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Return the name that stands for the group of a name."""
        above = self._above
        top = name
        while top in above:
            top = above[top]
        while name != top:
            above[name], name = top, above[name]
        return top

    def unite(self, a: str, b: str) -> bool:
        """Put two groups together; return whether they were two."""
        first, second = self.of(a), self.of(b)
        if first == second:
            return False
        self._above[second] = first
        return True
