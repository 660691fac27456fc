"""Mechanisms whose parts lock each other: execution of plans, exploration of unknown locks."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .lock_exploration import (
        LearnedLock as LearnedLock,
        LockExploration as LockExploration,
        LockTry as LockTry,
        explore_locks as explore_locks,
    )
    from .plan_execution import (
        ExecutedMove as ExecutedMove,
        PartMover as PartMover,
        UnlockingExecution as UnlockingExecution,
        execute_unlocking as execute_unlocking,
    )

lazy_face(__name__)
