"""What is on record about an articulation, beside the mathematics it wrote."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
    """

    kind: str
    parent: str
    child: str
    coordinates: tuple[Symbol, ...] = ()
    home: tuple[float, ...] = ()
    speeds: tuple[Symbol, ...] = ()
    dynamics: tuple[tuple[str, Any], ...] = ()
