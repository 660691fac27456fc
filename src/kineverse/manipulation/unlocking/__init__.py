"""Mechanisms whose parts lock each other: execution of plans, exploration of unknown locks."""

from .lock_exploration import LearnedLock, LockExploration, LockTry, explore_locks
from .plan_execution import ExecutedMove, PartMover, UnlockingExecution, execute_unlocking

__all__ = [
    "ExecutedMove",
    "LearnedLock",
    "LockExploration",
    "LockTry",
    "PartMover",
    "UnlockingExecution",
    "execute_unlocking",
    "explore_locks",
]
