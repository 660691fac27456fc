"""How much is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

Progress: TypeAlias = Callable[[Iterable[Any], str, str], Iterable[Any]]


def _silent(items: Iterable[Any], what: str, unit: str) -> Iterable[Any]:
    return items


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured, and on which robot.

    Attributes
    ----------
    robot
        The name or file of the robot; a PR2 that is found here if None, see :func:`.robot.find_robot`.
    frame
        The frame whose pose and Jacobian are computed; a gripper if None.
    rounds
        How many times everybody takes a turn.
    processes
        The same where every turn is a fresh process.
    configurations
        How many configurations single calls go through in one turn.
    steps
        Through how many states, at most, things move among others.
    rows
        How many configurations a batch has.
    operations
        How many operations and constraints the large models have.
    boxes
        Among how many boxes, at most, an arm is moved.
    progress
        Wraps what is worked on, like :func:`kineverse.cli.progress.progress`.
    """

    robot: str | None = None
    frame: str | None = None
    rounds: int = 25
    processes: int = 9
    configurations: int = 1000
    steps: int = 200
    rows: int = 100_000
    operations: int = 10_000
    boxes: int = 3000
    progress: Progress = _silent


QUICK = Settings(rounds=5, processes=3, steps=20, operations=1_000)
"""Enough to see an order of magnitude."""
