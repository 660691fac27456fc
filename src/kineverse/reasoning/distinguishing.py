"""Distinguishing cases until a question has an answer in each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from kineverse.bounds.terms import Term

from .cases import Case

T = TypeVar("T")

CASES_AT_MOST = 1000


@dataclass(frozen=True)
class Unclear:
    """No answer yet: which terms' signs would help, and what can be said if they stay unknown."""

    about: tuple[Term, ...]
    otherwise: object = None


@dataclass(frozen=True)
class Unknown:
    """No answer, and why."""

    reason: str


def distinguish(start: Case, question: Callable[[Case], T | Unclear]) -> Iterator[tuple[Case, T | Unknown]]:
    """Yield cases that cover everything, each with its answer."""
    stack, done = [start], 0
    while stack:
        case = stack.pop()
        done += 1
        answer = question(case)
        if not isinstance(answer, Unclear):
            yield case, answer
            continue
        if done + len(stack) > CASES_AT_MOST:
            yield case, Unknown(f"there are more than {CASES_AT_MOST} cases to distinguish")
            continue
        reason: str | None = None
        for term in answer.about:
            parts = case.split(term)
            if not isinstance(parts, str):
                stack += parts
                break
            reason = reason or parts
        else:
            if answer.otherwise is not None:
                yield case, answer.otherwise  # type: ignore[misc]
            else:
                yield case, Unknown(reason or "nothing decides it")
