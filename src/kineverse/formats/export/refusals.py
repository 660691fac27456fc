"""What a format cannot say, collected so that one error names all of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from kineverse.errors import FormatError

_SHOWN = 6


@dataclass
class Refusals:
    """A growing list of what is refused.

    Attributes
    ----------
    target
        The name of the format.
    """

    target: str
    _reasons: dict[str, list[str]] = field(default_factory=dict)

    def add(self, name: str, reason: str) -> None:
        """Note that something cannot be said; its reasons are sentences without their beginning."""
        reasons = self._reasons.setdefault(name, [])
        if reason not in reasons:
            reasons.append(reason)

    def __bool__(self) -> bool:
        return bool(self._reasons)

    def check(self, file: str, remedy: str) -> None:
        """Raise if there is something.

        Raises
        ------
        FormatError
            With the first of the names, each with its reasons, and how many more there are.
        """
        if not self._reasons:
            return
        count = len(self._reasons)
        shown = [
            f"'{name}' {' and '.join(reasons)}" for name, reasons in list(self._reasons.items())[:_SHOWN]
        ]
        more = f"; and {count - _SHOWN} more" if count > _SHOWN else ""
        things = "one thing" if count == 1 else f"{count} things"
        raise FormatError(
            f"{file} is not written: {self.target} cannot say {things} of this model. "
            f"{'; '.join(shown)}{more}. {remedy}"
        )
