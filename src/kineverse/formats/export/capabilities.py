"""Capabilities of a file format, and errors for features that it does not support."""

from __future__ import annotations

from dataclasses import dataclass, field

from kineverse.errors import FormatError


@dataclass(frozen=True)
class FormatCapabilities:
    """Features that a file format can represent."""

    name: str
    sum_limits: bool = False  # True if the format limits linear combinations of coordinates
    one_way_speeds: bool = False  # True if the velocity limits of the two directions may differ
    loop_joints: bool = False
    keeps_urdf_elements: bool = False  # True if it writes elements again that a URDF had and no model says
    polynomial_degree: int = 1  # highest degree of the polynomials by which a joint may follow another


_SHOWN = 6  # number of unsupported features that an error message lists


class UnsupportedError(FormatError):
    """Features of a model that a file format cannot represent, with remedies."""

    def __init__(
        self,
        problem: str,
        curved: bool = False,
        strict: bool = False,
        options: tuple[str, str, str] = ("tolerance=0.001", "leave_out=(name, ...)", "without strict=True"),
    ) -> None:
        tolerance, leave_out, leave_out_all = options
        remedies = ["Write a document (.kv.json), which holds all of it"]
        if curved:
            remedies.append(f"have curves approximated with {tolerance}")
        if strict:
            remedies.append(f"leave constraints out with {leave_out}, or all of them {leave_out_all}")
        *first, last = remedies
        super().__init__(f"{problem} {', '.join(first)}, or {last}." if first else f"{problem} {last}.")
        self._problem, self._curved, self._strict = problem, curved, strict

    def with_remedies(self, tolerance: str, leave_out: str, leave_out_all: str) -> UnsupportedError:
        """Return the same error with the options of another interface, such as the command line."""
        options = (tolerance, leave_out, leave_out_all)
        return UnsupportedError(self._problem, self._curved, self._strict, options)


@dataclass
class UnsupportedFeatures:
    """Features of a model that a format does not support, collected during the conversion."""

    target: str  # name of the format
    strict: bool = False  # True if constraints that the format cannot represent are errors
    curved: bool = False  # True if an approximation of curves removes some of the errors
    left_out: dict[str, str] = field(default_factory=dict)
    _reasons: dict[str, list[str]] = field(default_factory=dict)
    _speeds: set[str] = field(default_factory=set)
    _motions: set[str] = field(default_factory=set)

    def refuse(self, name: str, reason: str) -> None:
        """Add an unsupported feature; the reason is a sentence without its subject."""
        reasons = self._reasons.setdefault(name, [])
        if reason not in reasons:
            reasons.append(reason)

    def leave_out(self, name: str, reason: str) -> None:
        """Leave out a constraint, which changes no pose; refuse it in strict mode."""
        if self.strict:
            self.refuse(name, reason)
        elif name not in self.left_out:
            self.left_out[name] = reason
        elif reason not in self.left_out[name]:
            self.left_out[name] += f" and {reason}"

    def leave_out_speeds(self, name: str, reason: str) -> None:
        """Leave out the relation between the speeds of an articulation, such as that of wheels."""
        self._speeds.add(name)
        self.leave_out(name, reason)

    def leave_out_motion(self, name: str, reason: str) -> None:
        """Leave out the motion of a frame, which is at home in the file; refuse it in strict mode."""
        self._motions.add(name)
        self.leave_out(name, reason)

    def __bool__(self) -> bool:
        return bool(self._reasons)

    @property
    def refused(self) -> dict[str, str]:
        """Reasons of what is refused, by name."""
        return {name: " and ".join(reasons) for name, reasons in self._reasons.items()}

    @property
    def remarks(self) -> list[str]:
        """Sentences about the parts of the model that are left out."""
        return [
            f"that '{name}' {reason} is left out: {self.target} cannot express it; its coordinates are free"
            if name in self._speeds
            else f"'{name}' stays at home, as {self.target} cannot express its motion: it {reason}"
            if name in self._motions
            else f"'{name}' is left out, which {self.target} cannot express: it {reason}"
            for name, reason in self.left_out.items()
        ]

    def check(self, file: str) -> None:
        """Raise an error if a feature is not supported."""
        if not self._reasons:
            return
        count = len(self._reasons)
        listed = [f"'{name}' {' and '.join(reasons)}" for name, reasons in self._reasons.items()]
        more = f"; and {count - _SHOWN} more" if count > _SHOWN else ""
        things = "one thing" if count == 1 else f"{count} things"
        raise UnsupportedError(
            f"{file} is not written: {self.target} cannot express {things} of this model. "
            f"{'; '.join(listed[:_SHOWN])}{more}.",
            self.curved,
            self.strict,
        )
