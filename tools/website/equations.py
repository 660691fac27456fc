"""Equations in LaTeX as MathML, which browsers draw themselves."""

from __future__ import annotations

import re

from latex2mathml.converter import convert


def to_mathml(latex: str, display: bool = False) -> str:
    """Return an equation as MathML.

    Raises
    ------
    ValueError
        For a command that is unknown.
    """
    drawn = convert(latex, display="block" if display else "inline")
    if unknown := re.search(r"\\\w+|&(?!#?\w+;)", re.sub(r"<[^>]*>", "", drawn)):
        raise ValueError(f"{unknown[0]} is unknown in {latex!r}")
    return drawn
