"""Closed kinematic loops: dependent coordinates, or equality constraints, that keep two frames together."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .close_loop import CloseLoop as CloseLoop, LoopConstraint as LoopConstraint
    from .loop_solution import SolvedLoop as SolvedLoop, solve_loop as solve_loop

lazy_face(__name__)
