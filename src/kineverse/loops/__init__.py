"""Closed loops: coordinates that follow others so that two frames stay together."""

from .closing import Closed, close
from .constraint import LoopConstraint
from .operation import CloseLoop

__all__ = ["CloseLoop", "Closed", "LoopConstraint", "close"]
