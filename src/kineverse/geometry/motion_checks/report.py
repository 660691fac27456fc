"""Report of the motion checks: findings, suspects and what cannot be said, coordinate by coordinate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.printing import format_number
from kineverse.model.display import count_values
from kineverse.symbols import Symbol

Severity: TypeAlias = Literal["finding", "suspect", "cannot_say"]
"""A finding is certainly wrong, a suspect is worth a look, and what cannot be said lacks something."""

ADVICE: Mapping[str, str] = {
    "crossed_limits": "Swap the limits.",
    "degrees_for_radians": "Write the limits in radians: degrees times 0.01745.",
    "radians_for_degrees": "Write the limits in degrees, or declare that the file has radians.",
    "millimetres_for_metres": "Write lengths in metres.",
    "axis_outside": "Move the origin of the joint to where the part is held.",
    "moves_nothing": "Attach the part to the child of this joint, or remove the joint.",
    "floats": "Move the part, or the origin of its joint, to its carrier.",
    "impossible_inertia": "Compute the inertia from the shape, or leave it out.",
    "center_of_mass_outside": "Correct the origin of the inertia; it is in the frame of the body.",
    "inside_out": "Reverse the triangles of the mesh.",
    "into_carrier": "Check the axis, its origin and the limits.",
    "flipped_axis": "Reverse the axis, or swap the signs of the limits.",
    "turned_axis": "Check the direction of the axis.",
    "comes_apart": "Check the type of the joint and at its limits.",
    "no_limits": "Give the joint limits.",
    "gap": "Check whether something between them lacks a shape.",
    "wrong_scale": "Check the scale of the mesh, or at the unit that it was drawn in.",
    "wrong_density": "Check the mass, and at the scale of the shapes.",
    "inertia_too_large": "Compute the inertia from the shape.",
    "missing_shapes": "Give the files of these shapes to be sure.",
    "no_shapes": "Give the bodies shapes to be sure.",
    "no_sweep": "",
}
"""Kinds of what the checks say, each with the advice for it. The names of the kinds do not change."""


@dataclass(frozen=True)
class MotionFinding:
    """One thing that the motion checks say.

    Attributes
    ----------
    kind
        One of :data:`ADVICE`.
    severity
        ``finding``, ``suspect`` or ``cannot_say``.
    text
        The reason in one line.
    bodies
        The bodies that it is about: those of the moving part.
    against
        The body that they enter; empty for none.
    joint
        Name of the articulation; empty for a body.
    value, limit, unit
        What was measured, what is accepted, and the unit of both: m, rad, kg/m³ or ``1``; None without one.
    state
        Values of coordinates at which it was measured; the others are at their default.

    See Also
    --------
    kineverse.geometry.check_motion
    """

    kind: str
    severity: Severity
    text: str
    bodies: tuple[str, ...] = ()
    joint: str = ""
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    state: Mapping[str, float] = field(default_factory=dict)
    against: str = ""

    @property
    def advice(self) -> str:
        """Advice for the kind."""
        return ADVICE[self.kind]

    def to_json(self) -> dict[str, Any]:
        """Return the entry as JSON data."""
        return {
            "kind": self.kind,
            "text": self.text,
            "advice": self.advice,
            "joint": self.joint or None,
            "bodies": list(self.bodies),
            "against": self.against or None,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit or None,
            "state": dict(self.state),
        }


@dataclass(frozen=True)
class CoordinateReport:
    """Report of one coordinate and the parts that it moves.

    Attributes
    ----------
    name
        Name of the coordinate; empty for the bodies that nothing moves.
    entries
        Everything, in the order of the checks.

    See Also
    --------
    kineverse.geometry.check_motion
    """

    name: str
    entries: tuple[MotionFinding, ...] = ()

    def _of(self, severity: Severity) -> tuple[MotionFinding, ...]:
        return tuple(entry for entry in self.entries if entry.severity == severity)

    @property
    def findings(self) -> tuple[MotionFinding, ...]:
        """Entries that are certainly wrong."""
        return self._of("finding")

    @property
    def suspects(self) -> tuple[MotionFinding, ...]:
        """Entries that are worth a look."""
        return self._of("suspect")

    @property
    def cannot_say(self) -> tuple[MotionFinding, ...]:
        """Entries about what could not be checked, and why."""
        return self._of("cannot_say")

    @property
    def ok(self) -> bool:
        """True without findings."""
        return not self.findings

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON data."""
        return {
            "name": self.name,
            "ok": self.ok,
            "findings": [entry.to_json() for entry in self.findings],
            "suspects": [entry.to_json() for entry in self.suspects],
            "cannot_say": [entry.to_json() for entry in self.cannot_say],
        }


@dataclass(frozen=True)
class MotionReport:
    """Result of :func:`check_motion`.

    Attributes
    ----------
    coordinates
        A report for each degree of freedom, in the order of the model.
    at_rest
        The report of the bodies that nothing moves.

    See Also
    --------
    kineverse.geometry.check_motion
    """

    coordinates: tuple[CoordinateReport, ...]
    at_rest: CoordinateReport

    @property
    def ok(self) -> bool:
        """True without findings."""
        return all(report.ok for report in self.all)

    @property
    def all(self) -> tuple[CoordinateReport, ...]:
        """The reports of all coordinates, and at the end that of the bodies at rest."""
        return (*self.coordinates, self.at_rest)

    @property
    def findings(self) -> tuple[MotionFinding, ...]:
        """All findings."""
        return tuple(entry for report in self.all for entry in report.findings)

    @property
    def suspects(self) -> tuple[MotionFinding, ...]:
        """All suspects."""
        return tuple(entry for report in self.all for entry in report.suspects)

    def _repr_html_(self) -> str:
        from kineverse._rich_display import html_table  # for start-up time

        rows = [
            (report.name or "at rest", entry.severity.replace("_", " "), entry.kind, entry.text, entry.advice)
            for report in self.all
            for entry in (*report.findings, *report.suspects, *report.cannot_say)
        ]
        kinds = {"findings": self.findings, "suspects": self.suspects}
        caption = ", ".join(count_values(len(found), kind) for kind, found in kinds.items())
        return html_table(caption, ("coordinate", "", "kind", "what", "advice"), rows)

    def __getitem__(self, name: Symbol | str) -> CoordinateReport:
        """Return the report of a coordinate."""
        known = {report.name: report for report in self.coordinates}
        if str(name) not in known:
            hint = suggest(str(name), known, "coordinate")
            raise UnknownNameError(f"There is no coordinate '{name}'. {hint}")
        return known[str(name)]


def format_length(length: float) -> str:
    """Return a length [m] as text: in m, mm or µm."""
    for unit, factor in (("m", 1.0), ("mm", 1e3)):
        if abs(length) * factor >= 0.995:
            return f"{format_number(length * factor, 3)} {unit}"
    return f"{format_number(length * 1e6, 3)} µm" if length else "0 m"
