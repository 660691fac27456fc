"""One kind of what a model holds, as a mapping by name."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, Mapping, ValuesView
from typing import TYPE_CHECKING, Any

from .display import as_html, as_lines
from .reader import missing

if TYPE_CHECKING:
    from .structure import Structure


class Listing(Mapping[str, Any]):
    """One kind of a model's data by name, live; a wrong name lists the right ones."""

    def __init__(self, view: Structure, kind: str, present: Any) -> None:
        self._view = view
        self._kind = kind
        self._present = present

    def _values(self) -> dict[str, Any]:
        self._view._settle()
        return self._view._head[self._kind]

    def __getitem__(self, name: str) -> Any:
        with self._view._lock:
            values = self._values()
            try:
                value = values[name]
            except (KeyError, TypeError):
                raise missing(self._kind, name, values) from None
            return value if self._present is None else self._present(name, value)

    def __iter__(self) -> Iterator[str]:
        with self._view._lock:
            self._view._settle()
            return iter(list(self._view._ordered(self._kind)))

    def items(self) -> ItemsView[str, Any]:
        """Return names and values as they are now."""
        with self._view._lock:
            return {name: self[name] for name in self}.items()

    def values(self) -> ValuesView[Any]:
        """Return the values as they are now."""
        with self._view._lock:
            return {name: self[name] for name in self}.values()

    def __len__(self) -> int:
        with self._view._lock:
            return len(self._values())

    def __contains__(self, name: object) -> bool:
        with self._view._lock:
            return name in self._values()

    def __str__(self) -> str:
        with self._view._lock:
            return as_lines(self._title, self.items(), len(self))

    def _repr_html_(self) -> str:
        with self._view._lock:
            return as_html(self._title, self.items(), len(self))

    @property
    def _title(self) -> str:
        return f"{len(self)} {self._kind}"

    def __repr__(self) -> str:
        names = list(self)
        shown = ", ".join(names[:8])
        return f"<{len(names)} {self._kind}: {shown}{', ...' if len(names) > 8 else ''}>"
