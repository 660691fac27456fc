"""Reasoning about models (layer 5): interlocks and their conditions."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .boxes import Interval as Interval, IntervalBox as IntervalBox
    from .find_interlocks import interlocks as interlocks
    from .interlock_records import (
        Hold as Hold,
        Interlock as Interlock,
        Interlocks as Interlocks,
        Undecided as Undecided,
        opening_order as opening_order,
    )
    from .interlock_verification import contradictions as contradictions
    from .plan_verification import (
        InvariantSet as InvariantSet,
        plan_violations as plan_violations,
        refutation_gaps as refutation_gaps,
    )
    from .unlocking_plan import (
        UnlockingPlan as UnlockingPlan,
        UnlockingStep as UnlockingStep,
        plan_unlocking as plan_unlocking,
    )

lazy_face(__name__)
