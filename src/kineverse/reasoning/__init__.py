"""Reasoning about models (layer 5): what locks what, and when."""

from kineverse.vocabulary import MODULE, unknown_attribute

from .boxes import Box, Interval
from .check import contradictions
from .finding import interlocks
from .interlock import Hold, Interlock, Interlocks, Undecided
from .order import opening_order

__all__ = [
    "Box",
    "Hold",
    "Interlock",
    "Interlocks",
    "Interval",
    "Undecided",
    "contradictions",
    "interlocks",
    "opening_order",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute("The package kineverse.reasoning", name, __all__, MODULE)
