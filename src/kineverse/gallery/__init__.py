"""Gallery: a small scene for every articulation of the library, loaded by name.

>>> import kineverse as kv
>>> model = kv.load("articulations/screw")
>>> model.degrees_of_freedom
(screw/bolt,)

``kineverse view articulations/screw`` shows it. Scenes are documents; ``tools/scenes`` writes them.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from kineverse.errors import UnknownNameError, suggest

__all__ = ["find_document", "is_seed", "names", "summary"]

LONGEST_SEED = 18  # largest number of digits of a seed in the name of a generated model
_FOLDER = Path(__file__).parent / "scenes"


def names() -> tuple[str, ...]:
    """Return the names of all scenes, family by family."""
    return tuple(_summaries())


def summary(name: str) -> str:
    """Return the summary of a scene in one line."""
    try:
        return _summaries()[name]
    except KeyError:
        similar = suggest(name, _summaries(), "articulation")
        raise UnknownNameError(f"There is no articulation {name!r} in the gallery. {similar}") from None


def is_seed(name: str) -> bool:
    """Return whether a name is a seed: decimal digits without leading zeros."""
    return name.isascii() and name.isdecimal() and len(name) <= LONGEST_SEED and str(int(name)) == name


def find_document(name: str) -> Path:
    """Return the path of the document of a scene."""
    summary(name)
    return _FOLDER / f"{name}.kv.json"


@cache
def _summaries() -> dict[str, str]:
    result: dict[str, str] = json.loads((_FOLDER / "summaries.json").read_text(encoding="utf-8"))
    return result
