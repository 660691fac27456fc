"""MJCF joint equalities as joints that follow others.

An equality says y - y0 = Σ aₖ (x - x0)ᵏ. In the order of the file, y follows x, unless it follows already or
x follows y: then the equality stays as what it is, a constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from kineverse.expressions.expression import Expression, as_expression
from kineverse.formats.reader_warnings import warn
from kineverse.formats.tree import DisjointSets
from kineverse.model.constraint import Constraint
from kineverse.model.operations import Constrain
from kineverse.symbols import position

from .description import MjcfCoupling, MjcfJoint, Quartic

_FIXED = "\0"
"""Stands for what leads a joint that an equality holds where it is: no name has it."""

_SAME = 1e-6


class FollowerJoints:
    """The joints that follow others.

    Attributes
    ----------
    leaders
        What each of them follows directly; None where it stands still.
    left_over
        The equalities that made none follow.
    """

    def __init__(self, couplings: Iterable[MjcfCoupling], named: Callable[[str], str]) -> None:
        self._named = named
        self._by_follower: dict[str, MjcfCoupling] = {}
        self.left_over: list[MjcfCoupling] = []
        groups = DisjointSets()
        for coupling in couplings:
            follower = coupling.follower
            if follower not in self._by_follower and groups.union(coupling.leader or _FIXED, follower):
                self._by_follower[follower] = coupling
            else:
                self.left_over.append(coupling)
        self._expressions: dict[str, Expression] = {}
        self.leaders = {name: coupling.leader for name, coupling in self._by_follower.items()}

    def __contains__(self, joint: str) -> bool:
        return joint in self._by_follower

    def position(self, joint: str) -> Expression:
        """Return the position of a joint: its coordinate, or what it is in terms of those that lead."""
        chain: list[MjcfCoupling] = []
        ahead: str | None = joint
        while ahead is not None and ahead in self._by_follower and ahead not in self._expressions:
            chain.append(self._by_follower[ahead])
            ahead = chain[-1].leader
        if ahead is None:
            end = as_expression(0.0)  # of the polynomial only a0 is left
        else:
            end = self._expressions.get(ahead, position(self._named(ahead)))
        for coupling in reversed(chain):
            end = self._expressions[coupling.follower] = coupling.rest + quartic_expression(
                coupling.coefficients, end - coupling.leader_rest
            )
        return end

    def constraints(self) -> Iterator[Constrain]:
        """Yield the equalities that are left over; tell of those that can never hold."""
        for coupling in self.left_over:
            leader = as_expression(0.0) if coupling.leader is None else self.position(coupling.leader)
            along = quartic_expression(coupling.coefficients, leader - coupling.leader_rest)
            residual = self.position(coupling.follower) - coupling.rest - along
            if residual.symbols:
                name = self._named(coupling.name)
                yield Constrain(name, Constraint.of(0.0, residual, 0.0))
            elif abs(float(residual)) > 1e-9:
                warn(
                    [
                        f"{coupling.where} is left out, and never holds: it holds its joint "
                        f"{abs(float(residual)):.6g} away from where another equality does."
                    ]
                )

    def warn_homes(self, joints: Iterable[MjcfJoint], source: str) -> None:
        """Tell of followers that a file says to be elsewhere at home than where they follow to."""
        homes = {joint.name: joint.home[0] for joint in joints if len(joint.home) == 1}
        known = {position(self._named(name)): home for name, home in homes.items()}
        for name in self.leaders:
            follows = self.position(name)
            if name in homes and all(s in known for s in follows.symbols):
                there = float(follows({s: known[s] for s in follows.symbols}))
                if abs(there - homes[name]) > _SAME:
                    warn(
                        [
                            f"{source}: its home is moved to where equalities hold: '{self._named(name)}' "
                            f"from {homes[name]:.6g} to {there:.6g}."
                        ]
                    )


def quartic_expression(coefficients: Quartic, x: Expression) -> Expression:
    """Return Σ aₖ xᵏ, by Horner's rule and without terms that are zero."""
    result: Expression | None = None
    for a in reversed(coefficients):
        if result is not None:
            result = result * x
        if a:
            result = as_expression(a) if result is None else result + a
    return as_expression(0.0) if result is None else result
