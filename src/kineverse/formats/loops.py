"""What becomes of loops that a description closes."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

from kineverse.errors import ValueRejectedError

Loops: TypeAlias = Literal["solve", "constraint", "refuse"]

LOOPS: tuple[Loops, ...] = get_args(Loops)


def check_loops(loops: object) -> None:
    """Raise unless this is one of the ways in which loops are read."""
    if loops not in LOOPS:
        raise ValueRejectedError(
            "loops= is 'solve', which keeps as constraints what cannot be solved, 'constraint' or 'refuse', "
            f"not {loops!r}."
        )
