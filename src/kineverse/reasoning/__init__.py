"""Reasoning about models (layer 5): interlocks and their conditions."""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .boxes import Interval, IntervalBox
from .certify import contradictions
from .find_interlocks import interlocks
from .interlock import Hold, Interlock, Interlocks, Undecided
from .opening_order import opening_order

__all__ = [
    "Hold",
    "Interlock",
    "Interlocks",
    "Interval",
    "IntervalBox",
    "Undecided",
    "contradictions",
    "interlocks",
    "opening_order",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute_error("The package kineverse.reasoning", name, __all__, MODULE_SYNONYMS)
