"""Reasoning about models (layer 5): interlocks and their conditions."""

from kineverse._synonyms import MODULE_SYNONYMS
from kineverse.errors import unknown_attribute_error

from .boxes import Interval, IntervalBox
from .find_interlocks import interlocks
from .interlock_records import Hold, Interlock, Interlocks, Undecided, opening_order
from .interlock_verification import contradictions
from .plan_verification import InvariantSet, plan_violations, refutation_gaps
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
