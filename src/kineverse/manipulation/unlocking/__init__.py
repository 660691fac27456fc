"""Mechanisms whose parts lock each other: execution of plans, exploration of locks that nobody described."""

from .part_mover import PartMover
from .plan_execution import ExecutedMove, UnlockingExecution, execute_unlocking

__all__ = ["ExecutedMove", "PartMover", "UnlockingExecution", "execute_unlocking"]
