"""The operation that keeps the closure of a loop as constraints, all its coordinates free."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.errors import ModelError, NameTakenError
from kineverse.expressions.expression import array
from kineverse.expressions.functions import norm
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD
from kineverse.model.operation import Effects, Operation
from kineverse.model.reader import Reader

from .record import constrained_record
from .residual import as_ends, as_mask, residual_rows, upright

APART = 1e-9
"""What a row may be that nothing changes [m], [rad]."""


@dataclass(frozen=True, kw_only=True)
class LoopConstraint(Operation):
    """Two frames should coincide: an equality constraint for each row of what is left between them.

    For loops that :class:`~kineverse.CloseLoop` cannot turn into a function of the free coordinates. All
    coordinates stay free; :meth:`kineverse.Model.violations` and velocity rows see the closure, and
    :meth:`kineverse.Model.project` moves a state to where it holds.

    The constraints are ``0 <= row <= 0``, with the rows of :class:`~kineverse.CloseLoop`: elements of the
    position p [m] and of ½(R - Rᵀ)^∨ [rad] in axes of ``to``. They are called ``name/x``, ``name/ry`` and so
    on, ``name/1/x`` for the second pair of frames. Where turns count, ``name/upright`` is a number that is
    positive unless the frames are half a turn apart. A row that nothing moves has no constraint if it is
    zero; otherwise ``name/apart`` is the distance of all rows from zero, which is never 0 then.

    Attributes
    ----------
    name
        Of the closure.
    frame, to
        The frames, which must be connected by other operations already.
    mask
        What coincides, names out of ``x y z rx ry rz``.
    more
        Further pairs (frame, to) that coincide in the same way.

    Raises
    ------
    ModelError
        If the frames are connected rigidly: nothing moves what is between them.
    NameTakenError
        If there is an articulation of that name.
    """

    name: str
    frame: str
    to: str = WORLD
    mask: tuple[str, ...] = ("x", "y", "z")
    more: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "mask", as_mask(self.mask, self.name))
        object.__setattr__(self, "more", as_ends(self.more, self.name))

    def default_tag(self) -> str:
        """Return ``loop`` and the name, as of a loop that is solved."""
        return f"loop {self.name}"

    def apply(self, model: Reader) -> Effects:
        """Write the constraints."""
        if self.name in model.articulations:
            raise NameTakenError(
                f"There is an articulation '{self.name}' already; give loop '{self.name}' another name."
            )
        constraints: dict[str, Constraint] = {}
        ends = ((self.frame, self.to), *self.more)
        for k, (frame, to) in enumerate(ends):
            constraints |= self._between(model, frame, to, f"{self.name}/{k}" if k else self.name)
        return Effects(
            constraints=constraints,
            articulations={self.name: constrained_record(ends, self.mask, tuple(constraints))},
        )

    def _between(self, model: Reader, frame: str, to: str, name: str) -> dict[str, Constraint]:
        pose = model.fk(frame, to)
        rows = residual_rows(pose, self.mask)
        # Each by itself, so that a trace knows what is decided by: whether anything moves it.
        alone = {axis: model.resolve(row) for axis, row in rows.items()}
        moving = [axis for axis, row in alone.items() if row.symbols] if pose.symbols else []
        if not moving:
            raise ModelError(
                f"Loop '{self.name}' cannot move: nothing changes what its mask names between '{frame}' and "
                f"'{to}'."
            )
        found = {f"{name}/{axis}": Constraint.of(0.0, rows[axis], 0.0) for axis in moving}
        if any(abs(float(row)) > APART for axis, row in alone.items() if axis not in moving):
            found[f"{name}/apart"] = Constraint.of(0.0, norm(array(list(rows.values()))), 0.0)
        for k, sign in enumerate(upright(pose, self.mask)):
            if model.resolve(sign).symbols:
                found[f"{name}/upright{k or ''}"] = Constraint.of(0.0, sign, math.inf)
        return found
