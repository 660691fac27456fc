"""Reasoning about models (layer 5): interlocks and their conditions."""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .boxes import Interval, IntervalBox
from .certify import contradictions
from .find_interlocks import interlocks
from .interlock import Hold, Interlock, Interlocks, Undecided
from .opening_order import opening_order
from .plan_check import plan_violations
from .refutation import InvariantSet, refutation_gaps
from .unlocking_plan import UnlockingPlan, UnlockingStep, plan_unlocking

__all__ = [
    "Hold",
    "Interlock",
    "Interlocks",
    "Interval",
    "IntervalBox",
    "InvariantSet",
    "Undecided",
    "UnlockingPlan",
    "UnlockingStep",
    "contradictions",
    "interlocks",
    "opening_order",
    "plan_unlocking",
    "plan_violations",
    "refutation_gaps",
]


def __getattr__(name: str) -> object:
    raise unknown_attribute_error("The package kineverse.reasoning", name, __all__, MODULE_SYNONYMS)
