"""Warnings of readers: logged, and collected by whoever asks for them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from kineverse.formats.xml_reader import Element, ElementError, label

_log = logging.getLogger("kineverse.formats")

_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())


class Fault(str):
    """A remark on a mistake that a strict reader refuses, and what was taken instead."""

    __slots__ = ()


@dataclass(slots=True)
class ReaderWarnings:
    """A growing list of remarks on one document; where it is read strictly, mistakes are no remarks."""

    source: str
    texts: list[str] = field(default_factory=list)
    strict: bool = False

    def add(self, element: Element, text: str, owner: Element | None = None) -> None:
        """Note something about an element, which is part of ``owner``."""
        of = "" if owner is None or owner is element else f"{label(owner)}: "
        remark = f"line {element[3]}, {of}{label(element)} {text}"
        self.texts.append(remark)
        warn([f"{self.source}, {remark}"])

    def mend(self, mistake: ElementError, taken: str, owner: Element | None = None) -> None:
        """Note a mistake in a part of ``owner``, and what is taken instead.

        Raises
        ------
        ElementError
            The mistake, where the document is read strictly.
        """
        if self.strict:
            raise mistake
        element = mistake.element
        owner = owner or element
        of = "" if owner is element else f"{label(element)} "
        self.fault(element[3], f"{label(owner)}: {of}{mistake.message.rstrip('. ')}; {taken}.")

    def fault(self, line: int, text: str) -> None:
        """Note a mistake in a line, which is not refused."""
        fault = Fault(f"line {line}, {text}")
        self.texts.append(fault)
        warn([Fault(f"{self.source}, {fault}")])


def warn(remarks: Iterable[str]) -> None:
    """Log remarks, each with its source in front, and give them to whoever listens."""
    for remark in remarks:
        _log.info("%s", remark)
        for heard in _listeners.get():
            heard.append(remark)


@contextmanager
def collect_warnings() -> Iterator[list[str]]:
    """Yield a list that takes every remark of any reader, with its source, made within the block."""
    heard: list[str] = []
    token = _listeners.set((*_listeners.get(), heard))
    try:
        yield heard
    finally:
        _listeners.reset(token)
