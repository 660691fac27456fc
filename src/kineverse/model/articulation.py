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
    """Record of an articulation, for people and exporters. Kinematics does not depend on it.

    Attributes
    ----------
    kind
        Name of the operation that made it, such as ``revolute``.
    parent, child
        Names of the frames that it connects.
    coordinates
        Position symbols of the articulation, with ``home`` as their default values [m], [rad].
    speeds
        Free speeds that move it.
    dynamics
        Dynamic parameters as (name, value) pairs: effort [N] or [N m], damping, friction ...
    follows
        Position of an articulation without a coordinate of its own, such as a mimic joint or a gearbox [m],
        [rad].

    Raises
    ------
    InvalidValueError
        If the number of homes differs from the number of coordinates.

    See Also
    --------
    kineverse.Model.articulations
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
        """The joint position: the only coordinate, or ``follows``; None if the position is not one number."""
        return self.coordinates[0] if len(self.coordinates) == 1 else self.follows

    def dynamics_of(self, coordinate: Symbol) -> dict[str, Any]:
        """Return the dynamic parameters of one coordinate: all of a single one, else those below its name."""
        if len(self.coordinates) == 1:
            return dict(self.dynamics)
        start = f"{coordinate.path.rpartition('/')[2]}/"
        return {key.removeprefix(start): value for key, value in self.dynamics if key.startswith(start)}


def check_home(name: str, record: Articulation) -> None:
    """Check the home of an articulation."""
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
