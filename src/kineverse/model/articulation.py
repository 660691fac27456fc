"""Record of an articulation: frames, coordinates, home, dynamics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol


@dataclass(frozen=True, slots=True)
class Articulation:
    """A record for people and exporters; no algorithm needs it to move anything.

    Attributes
    ----------
    kind
        Name of the operation that made it, such as ``revolute``.
    parent, child
        The frames it connects.
    coordinates
        Its own position symbols, with ``home`` the value each has when nothing else is known [m], [rad].
    speeds
        The free speeds that move it.
    dynamics
        What is known beside kinematics, as (name, value) pairs: effort [N] or [N m], damping, friction ...
    follows
        What its position is, if it has one but no coordinate of its own, as a mimic joint or a gearbox [m],
        [rad].

    Raises
    ------
    InvalidValueError
        If there are homes for other coordinates than it has.
    """

    kind: str
    parent: str
    child: str
    coordinates: tuple[Symbol, ...] = ()
    home: tuple[float, ...] = ()
    speeds: tuple[Symbol, ...] = ()
    dynamics: tuple[tuple[str, Any], ...] = ()
    follows: Expression | None = None

    def __post_init__(self) -> None:
        if len(self.home) not in (0, len(self.coordinates)):
            raise InvalidValueError(
                f"The record of {self.kind} '{self.child}' has {len(self.home)} homes for "
                f"{len(self.coordinates)} coordinates; give one for each, or none."
            )

    @property
    def position(self) -> Expression | None:
        """How far it has moved: its one coordinate, or what it follows; None if it is not one number."""
        return self.coordinates[0] if len(self.coordinates) == 1 else self.follows


def check_home(name: str, record: Articulation) -> None:
    """Look whether an articulation has a home in which its frames have a pose.

    Raises
    ------
    InvalidValueError
        If a number of it is not finite, or its orientation is a quaternion of length zero.
    """
    for symbol, value in zip(record.coordinates, record.home, strict=False):
        if isinstance(value, float | int) and not math.isfinite(value):
            raise InvalidValueError(
                f"The home of the articulation '{name}' is finite, and not {value!r} for '{symbol}'."
            )
    home = {str(s): value for s, value in zip(record.coordinates, record.home, strict=False)}
    x = next((path for path in home if path.endswith("/qx")), None)
    if x is not None and not any(home.get(f"{x[:-1]}{part}", 1.0) for part in "xyzw"):
        raise InvalidValueError(
            f"The home of the articulation '{name}' has the quaternion 0 0 0 0, which is no orientation; "
            "that of no rotation is 0 0 0 1, with w last."
        )
