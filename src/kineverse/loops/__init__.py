"""Closed kinematic loops: dependent coordinates, or equality constraints, that keep two frames together."""

from kineverse.model import registry

from .close_loop import CloseLoop, LoopConstraint
from .loop_solution import SolvedLoop, solve_loop

__all__ = ["CloseLoop", "LoopConstraint", "SolvedLoop", "solve_loop"]

registry.register_shorthand("close_loop", "kineverse.loops.close_loop:CloseLoop")
