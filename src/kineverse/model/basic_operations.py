"""Operations that write one value: frame, body, constraint, rate, home, data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

from .body import Body
from .constraint import Constraint
from .frame import WORLD, Frame
from .operation import Operation, Writes
from .rates import RateRow
from .read_recorder import ReadRecorder


@dataclass(frozen=True)
class SetBody(Operation, document_kind="SetBody", tag="body"):
    """Assignment of a body to a frame: visual and collision shapes, and inertia."""

    name: str
    body: Body

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the body."""
        if self.name != WORLD and self.name not in model.frames:
            model.frames[self.name]  # raises, with similar names
        return Writes(bodies={self.name: self.body})


@dataclass(frozen=True)
class SetHome(Operation, document_kind="SetHome", tag="home"):
    """Assignment of the home of an articulation: default values of its coordinates [m], [rad]."""

    name: str
    home: tuple[float, ...]

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the record of the articulation with the new home."""
        return Writes(articulations={self.name: replace(model.articulations[self.name], home=self.home)})


@dataclass(frozen=True)
class AddFrame(Operation, document_kind="AddFrame", tag="frame"):
    """New frame in a parent, with an optional body.

    See Also
    --------
    kineverse.model.Edit.add_frame
    """

    name: str
    frame: Frame
    body: Body | None = None

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the frame, and the body if it is not empty."""
        bodies = {} if self.body is None else {self.name: self.body}
        return Writes(frames={self.name: self.frame}, bodies=bodies)


@dataclass(frozen=True)
class Constrain(Operation, document_kind="Constrain", tag="constraint"):
    """New constraint.

    See Also
    --------
    kineverse.model.Edit.constrain
    """

    name: str
    constraint: Constraint

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the constraint."""
        return Writes(constraints={self.name: self.constraint})


@dataclass(frozen=True)
class SetRate(Operation, document_kind="SetRate"):
    """Assignment of the rate of a coordinate as a linear function of speeds.

    See Also
    --------
    kineverse.model.Edit.set_rate
    """

    coordinate: Symbol
    row: RateRow

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the row."""
        return Writes(rates={self.coordinate: dict(self.row)})

    def default_tag(self) -> str:
        """Return ``rate`` and the coordinate."""
        return f"rate {self.coordinate}"


@dataclass(frozen=True)
class SetData(Operation, document_kind="Write", tag="data"):
    """Assignment of a datum.

    See Also
    --------
    kineverse.model.Edit.write
    """

    name: str
    value: Any

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the value."""
        return Writes(data={self.name: self.value})


@dataclass(frozen=True)
class Attach(Operation, document_kind="Attach"):
    """Move of an existing frame, with all frames below it, to another parent.

    See Also
    --------
    kineverse.model.Edit.attach
    """

    name: str
    frame: Frame

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the frame with the new parent."""
        if self.name not in model.frames:
            model.frames[self.name]  # raises, with similar names
        return Writes(frames={self.name: self.frame})

    def default_tag(self) -> str:
        """Return ``attach``, the frame and its new parent."""
        return f"attach {self.name} to {self.frame.parent}"


@dataclass(frozen=True)
class Override(Operation, document_kind="Override"):
    """Operation with permission to overwrite values of earlier ones.

    See Also
    --------
    kineverse.model.Edit.apply
    """

    overrides = True

    operation: Operation

    @property
    def traceable(self) -> bool:  # type: ignore[override]
        """True if the operation is traceable."""
        return self.operation.traceable

    def apply(self, model: ReadRecorder) -> Writes:
        """Return the writes of the operation."""
        return self.operation.apply(model)

    def default_tag(self) -> str:
        """Return ``override`` and the tag of the operation."""
        return f"override {self.operation.default_tag()}"


@dataclass(frozen=True)
class SoftLimits(Operation, document_kind="SoftLimits"):
    """Limits of a joint by its safety controller, inside the hard limits."""

    name: str  # name of the articulation; the constraint is called name/soft_limits
    q: Expression  # coordinate, or expression of the joint position [rad] or [m]
    lower: float  # soft limit [rad] or [m]
    upper: float

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the constraint."""
        if self.name not in model.articulations:
            model.articulations[self.name]  # raises, with similar names
        if not self.q.symbols:
            return Writes()
        return Writes(constraints={f"{self.name}/soft_limits": (self.lower, self.q, self.upper)})
