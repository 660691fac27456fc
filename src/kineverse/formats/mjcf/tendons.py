"""Tendon operations: lengths as data, ranges and couplings as constraints."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.functions import norm
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Operation, Writes
from kineverse.model.rate_nodes import to_plain
from kineverse.model.read_recorder import ReadRecorder

from .description import Quartic
from .joint_equalities import quartic_expression

LENGTH_KEY = "length"


@dataclass(frozen=True, kw_only=True)
class Tendon(Operation, document_kind="Tendon"):
    """Tendon with a length over joints or along a path through frames.

    L = Σ coef · q [m], where q are positions of articulations; or L = Σ |pₖ₊₁ - pₖ| / divisor [m] over the
    origins p of frames, summed over the branches of pulleys. The length is the datum ``name/length``, and its
    range the constraint of the same name.
    """

    name: str
    terms: tuple[tuple[str, float], ...] = ()  # pairs of articulation and factor
    paths: tuple[tuple[float, tuple[str, ...]], ...] = ()
    lower: float | None = None  # limits of the length [m]; None for no limit
    upper: float | None = None
    dynamics: tuple[tuple[str, float], ...] = ()

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the length and its range."""
        length = as_expression(0.0)
        for joint, factor in self.terms:
            q = model.articulations[joint].position
            assert q is not None  # in MuJoCo, only hinges and slides are in tendons
            length = length + factor * q
        for divisor, frames in self.paths:
            for near, far in pairwise(frames):
                length = length + norm(model.fk(far, near)[:3, 3]) / divisor
        name = f"{self.name}/{LENGTH_KEY}"
        lower = -float("inf") if self.lower is None else self.lower
        upper = float("inf") if self.upper is None else self.upper
        bounded = length.symbols and not (self.lower is None and self.upper is None)
        return Writes(
            data={name: to_plain(length)}
            | ({f"{self.name}/dynamics": self.dynamics} if self.dynamics else {}),
            constraints={name: Constraint.from_expressions(lower, length, upper)} if bounded else {},
        )


@dataclass(frozen=True, kw_only=True)
class TendonCoupling(Operation, document_kind="TendonCoupling"):
    """Equality between the lengths of two tendons: L - L0 = Σ aₖ (M - M0)ᵏ."""

    name: str  # name of the constraint
    tendon: str  # tendons of the lengths L
    leader: str | None  # M; L - L0 = a0 without leader
    coefficients: Quartic  # coefficients a0 to a4
    rest: float = 0.0  # L0 and M0 [m]
    leader_rest: float = 0.0

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the constraint."""
        length: Expression = model.data[f"{self.tendon}/{LENGTH_KEY}"]
        other = as_expression(0.0) if self.leader is None else model.data[f"{self.leader}/{LENGTH_KEY}"]
        along = quartic_expression(self.coefficients, other - self.leader_rest)
        residual = length - self.rest - along
        return Writes(
            constraints={self.name: Constraint.from_expressions(0.0, residual, 0.0)}
            if residual.symbols
            else {}
        )
