"""MJCF equalities of joints, as joints that follow others, and tendons with their lengths and couplings.

An equality is y - y0 = Σ aₖ (x - x0)ᵏ. In the order of the file, the joint y becomes a function of x, unless
it follows another joint already or x follows y. Those equalities stay constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.functions import norm
from kineverse.formats.description import DisjointSets
from kineverse.formats.reader_warnings import warn
from kineverse.model.basic_operations import Constrain
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Operation, Writes
from kineverse.model.rates import to_plain
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import position

from .description import MjcfCoupling, MjcfJoint, Quartic

_FIXED = "\0"  # leader of joints that an equality fixes; not a valid name

_HOME_TOLERANCE = 1e-6


class FollowerJoints:
    """Joints that follow others by equalities."""

    def __init__(self, couplings: Iterable[MjcfCoupling], model_name: Callable[[str], str]) -> None:
        self._model_name = model_name
        self._by_follower: dict[str, MjcfCoupling] = {}
        self.remaining: list[MjcfCoupling] = []
        groups = DisjointSets()
        for coupling in couplings:
            follower = coupling.follower
            if follower not in self._by_follower and groups.union(coupling.leader or _FIXED, follower):
                self._by_follower[follower] = coupling
            else:
                self.remaining.append(coupling)
        self._expressions: dict[str, Expression] = {}
        self.leaders = {name: coupling.leader for name, coupling in self._by_follower.items()}

    def __contains__(self, joint: str) -> bool:
        return joint in self._by_follower

    def position(self, joint: str) -> Expression:
        """Return the position of a joint: its coordinate, or an expression of independent coordinates."""
        chain: list[MjcfCoupling] = []
        leader: str | None = joint
        while leader is not None and leader in self._by_follower and leader not in self._expressions:
            chain.append(self._by_follower[leader])
            leader = chain[-1].leader
        if leader is None:
            q = as_expression(0.0)  # without leader, the polynomial is a0
        else:
            q = self._expressions.get(leader, position(self._model_name(leader)))
        for coupling in reversed(chain):
            q = self._expressions[coupling.follower] = coupling.rest + quartic_expression(
                coupling.coefficients, q - coupling.leader_rest
            )
        return q

    def constraints(self) -> Iterator[Constrain]:
        """Yield the remaining equalities as constraints; warn of those that cannot hold."""
        for coupling in self.remaining:
            leader = as_expression(0.0) if coupling.leader is None else self.position(coupling.leader)
            target = quartic_expression(coupling.coefficients, leader - coupling.leader_rest)
            residual = self.position(coupling.follower) - coupling.rest - target
            if residual.symbols:
                name = self._model_name(coupling.name)
                yield Constrain(name, Constraint.from_expressions(0.0, residual, 0.0))
            elif abs(float(residual)) > 1e-9:
                warn(
                    [
                        f"{coupling.where} is left out, and never holds: it holds its joint "
                        f"{abs(float(residual)):.6g} away from where another equality does."
                    ]
                )

    def warn_moved_homes(self, joints: Iterable[MjcfJoint], source: str) -> None:
        """Warn of followers whose home position in the file is not that of the equality."""
        homes = {joint.name: joint.home[0] for joint in joints if len(joint.home) == 1}
        known = {position(self._model_name(name)): value for name, value in homes.items()}
        for name in self.leaders:
            follows = self.position(name)
            if name in homes and all(s in known for s in follows.symbols):
                home = float(follows({s: known[s] for s in follows.symbols}))
                if abs(home - homes[name]) > _HOME_TOLERANCE:
                    warn(
                        [
                            f"{source}: its home is moved to where equalities hold: "
                            f"'{self._model_name(name)}' from {homes[name]:.6g} to {home:.6g}."
                        ]
                    )


def quartic_expression(coefficients: Quartic, x: Expression) -> Expression:
    """Return Σ aₖ xᵏ by Horner's rule, without the terms that are zero."""
    result: Expression | None = None
    for a in reversed(coefficients):
        if result is not None:
            result = result * x
        if a:
            result = as_expression(a) if result is None else result + a
    return as_expression(0.0) if result is None else result


LENGTH_KEY = "length"


@dataclass(frozen=True, kw_only=True)
class Tendon(Operation, document_kind="Tendon"):
    """Tendon with a length over joints or along a path through frames.

    L = Σ coef · q [m], where q are positions of articulations; or ``L = Σ |pₖ₊₁ - pₖ| / divisor`` [m] over
    the origins p of frames, summed over the branches of pulleys. The length is the datum ``name/length``, and
    its range the constraint of the same name.
    """

    name: str
    terms: tuple[tuple[str, float], ...] = ()  # pairs of articulation and factor
    paths: tuple[tuple[float, tuple[str, ...]], ...] = ()
    lower: float | None = None  # limit of the length [m]; None for none
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
    tendon: str  # tendon of the length L
    leader: str | None  # tendon of the length M; L - L0 = a0 without one
    coefficients: Quartic  # a0 to a4
    rest: float = 0.0  # L0 [m]
    leader_rest: float = 0.0  # M0 [m]

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
