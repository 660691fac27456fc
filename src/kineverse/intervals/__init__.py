"""Guaranteed ranges of expressions by interval arithmetic."""

from .arithmetic import RealInterval
from .enclosure import Enclosures, enclose_bound
from .graph import TermGraph

__all__ = ["Enclosures", "RealInterval", "TermGraph", "enclose_bound"]
