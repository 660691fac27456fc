"""Capabilities of a file format, and errors for features that it does not support."""

from __future__ import annotations

from dataclasses import dataclass, field

from kineverse.errors import FormatError


@dataclass(frozen=True)
class FormatCapabilities:
    """What a format can say.

    Attributes
    ----------
    name
        Of the format.
    sums
        Whether it limits sums of several coordinates.
    one_way
        Whether a speed may have another limit forwards than backwards.
    loops
        Whether it ties frames, so that what closes a loop needs not be solved for.
    degree
        Of the polynomials by which a joint may follow another.
    """

    name: str
    sums: bool = False
    one_way: bool = False
    loops: bool = False
    degree: int = 1


_SHOWN = 6


class UnsupportedError(FormatError):
    """What a model says and a format cannot, with what can be done about it.

    Parameters
    ----------
    problem
        What that is.
    curved
        Whether some of it could be approximated.
    strict
        Whether constraints are among it, which could be left out.
    said
        How whoever reads the message has curves approximated, leaves out one constraint, and all of them.
    """

    def __init__(
        self,
        problem: str,
        curved: bool = False,
        strict: bool = False,
        said: tuple[str, str, str] = ("tolerance=0.001", "leave_out=(name, ...)", "without strict=True"),
    ) -> None:
        tolerance, leave_out, all_of_them = said
        remedies = ["Write a document (.kv.json), which says all of it"]
        if curved:
            remedies.append(f"have curves approximated with {tolerance}")
        if strict:
            remedies.append(f"leave constraints out with {leave_out}, or all of them {all_of_them}")
        *first, last = remedies
        super().__init__(f"{problem} {', '.join(first)}, or {last}." if first else f"{problem} {last}.")
        self._problem, self._curved, self._strict = problem, curved, strict

    def with_remedies(self, tolerance: str, leave_out: str, all_of_them: str) -> UnsupportedError:
        """Return the same for somebody who says that in another way."""
        return UnsupportedError(
            self._problem, self._curved, self._strict, (tolerance, leave_out, all_of_them)
        )


@dataclass
class UnsupportedFeatures:
    """A growing list of what is refused.

    Attributes
    ----------
    target
        The name of the format.
    strict
        Whether constraints are refused, too, rather than left out.
    curved
        Whether something among them could be approximated.
    left_out
        Why constraints, and speeds of articulations, are left out, by name.
    """

    target: str
    strict: bool = False
    curved: bool = False
    left_out: dict[str, str] = field(default_factory=dict)
    _reasons: dict[str, list[str]] = field(default_factory=dict)
    _speeds: set[str] = field(default_factory=set)

    def add(self, name: str, reason: str) -> None:
        """Note that something cannot be said; its reasons are sentences without their beginning."""
        reasons = self._reasons.setdefault(name, [])
        if reason not in reasons:
            reasons.append(reason)

    def leave(self, name: str, reason: str) -> None:
        """Note that a constraint is left out; all frames are where they should be without it."""
        if self.strict:
            self.add(name, reason)
        elif name not in self.left_out:
            self.left_out[name] = reason
        elif reason not in self.left_out[name]:
            self.left_out[name] += f" and {reason}"

    def leave_out_speeds(self, name: str, reason: str) -> None:
        """Note that the ties between the speeds of an articulation are left out, as those of wheels are."""
        self._speeds.add(name)
        self.leave(name, reason)

    def __bool__(self) -> bool:
        return bool(self._reasons)

    @property
    def remarks(self) -> list[str]:
        """What is left out, as sentences."""
        return [
            f"that '{name}' {reason} is left out: {self.target} cannot say it, and its coordinates are free"
            if name in self._speeds
            else f"'{name}' is left out, which {self.target} cannot say: it {reason}"
            for name, reason in self.left_out.items()
        ]

    def check(self, file: str) -> None:
        """Raise if there is something.

        Raises
        ------
        UnsupportedError
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
        raise UnsupportedError(
            f"{file} is not written: {self.target} cannot say {things} of this model. "
            f"{'; '.join(shown)}{more}.",
            self.curved,
            self.strict,
        )
