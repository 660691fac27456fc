"""What a reader noticed but did not refuse."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from kineverse.formats.markup import Element, label

_log = logging.getLogger("kineverse.formats")


@dataclass(slots=True)
class Remarks:
    """A growing list of remarks on one document."""

    source: str
    texts: list[str] = field(default_factory=list)

    def add(self, element: Element, text: str, owner: Element | None = None) -> None:
        """Note something about an element, which is part of ``owner``."""
        of = "" if owner is None or owner is element else f"{label(owner)}: "
        remark = f"line {element[3]}, {of}{label(element)} {text}"
        self.texts.append(remark)
        _log.info("%s, %s", self.source, remark)
