"""Warnings of readers: logged, and collected within a block."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from msgspec import Struct, field

from kineverse.errors import FormatError

from .xml_reader import Element, ElementError, label

_listeners: ContextVar[tuple[list[str], ...]] = ContextVar("listeners", default=())


class Fault(str):
    """Warning about a mistake that a strict reader refuses, with the value used instead."""

    __slots__ = ()


class ChangedMotion(Fault):
    """Fault without which the model would move otherwise: logged as a warning, others as information."""

    __slots__ = ()


class CrossedLimits(Fault):
    """Fault of a joint whose lower limit is above its upper one; ``joint`` is its name in the file."""

    joint: str = ""

    @classmethod
    def of(cls, joint: str, text: str) -> CrossedLimits:
        """Return the fault of a joint."""
        fault = cls(text)
        fault.joint = joint
        return fault


class ReaderWarnings(Struct):
    """Warnings about one document; with ``strict``, mistakes raise instead."""

    source: str  # name of the document
    texts: list[str] = field(default_factory=list)  # warnings so far
    strict: bool = False  # True if mistakes are errors

    def add(self, element: Element, text: str, owner: Element | None = None) -> None:
        """Add a warning about an element, which is part of ``owner``."""
        of = "" if owner is None or owner is element else f"{label(owner)}: "
        remark = f"line {element[3]}, {of}{label(element)} {text}"
        self.texts.append(remark)
        warn([f"{self.source}, {remark}"])

    def repair(
        self,
        mistake: ElementError,
        taken: str,
        owner: Element | None = None,
        kind: Callable[[str], Fault] = Fault,
    ) -> None:
        """Add a warning about a mistake in a part of ``owner``, with the value used instead."""
        if self.strict:
            raise mistake
        element = mistake.element
        owner = owner or element
        of = "" if owner is element else f"{label(element)} "
        self.fault(element[3], f"{label(owner)}: {of}{mistake.message.rstrip('. ')}; {taken}.", kind)

    @contextmanager
    def passing_over(self, owner: Element | None = None) -> Iterator[None]:
        """Warn about a mistake in the block, whose element is passed over."""
        try:
            yield
        except ElementError as mistake:
            self.repair(mistake, "it is passed over", owner)

    def mistake(self, line: int, text: str, taken: str) -> None:
        """Add a warning about a mistake in a line, with what is done instead; an error if strict."""
        if self.strict:
            raise FormatError(f"{self.source}, line {line}, {text}")
        self.fault(line, f"{text.rstrip('.')}; {taken}.")

    def fault(self, line: int, text: str, kind: Callable[[str], Fault] = Fault) -> None:
        """Add a warning about a mistake in a line."""
        self.texts.append(kind(f"line {line}, {text}"))
        warn([kind(f"{self.source}, {self.texts[-1]}")])


def warn(remarks: Iterable[str]) -> None:
    """Log warnings, each with its source in front, and add them to the lists of :func:`collect_warnings`."""
    for remark in remarks:
        import logging  # for start-up time

        level = logging.WARNING if isinstance(remark, ChangedMotion) else logging.INFO
        logging.getLogger("kineverse.formats").log(level, "%s", remark)
        for heard in _listeners.get():
            heard.append(remark)


@contextmanager
def collect_warnings() -> Iterator[list[str]]:
    """Yield a list that collects the warnings of all readers within the block, with their sources.

    Examples
    --------
    >>> with open("door.urdf", "w", encoding="utf-8") as file:
    ...     size = file.write("<robot name='door'><link name='leaf'><visual/></link></robot>")
    >>> with kv.formats.collect_warnings() as warnings:
    ...     model = kv.load("door.urdf")
    >>> warnings
    ['door.urdf, line 1, <link name="leaf">: <visual> has no shape and is left out.']
    """
    heard: list[str] = []
    token = _listeners.set((*_listeners.get(), heard))
    try:
        yield heard
    finally:
        _listeners.reset(token)
