"""Record of a closed loop: frames, mask, free and dependent coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse.model.articulation import Articulation
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import symbol_name

from .loop_solution import SolvedLoop

SOLVED_LOOP, CONSTRAINED_LOOP = "closedloop", "loopconstraint"
LOOP_KINDS = (SOLVED_LOOP, CONSTRAINED_LOOP)


@dataclass(frozen=True)
class LoopRecord:
    """Closed loop of a model."""

    name: str
    ends: tuple[tuple[str, str], ...]  # pairs of frames (frame, to) that coincide in the axes of the mask
    mask: tuple[str, ...]  # some of x y z rx ry rz
    free: tuple[str, ...]  # coordinates
    dependent: tuple[str, ...]
    constraints: tuple[str, ...] = ()


def make_loop_record(
    ends: tuple[tuple[str, str], ...], mask: tuple[str, ...], closed: SolvedLoop
) -> Articulation:
    """Return the record of a loop with dependent coordinates."""
    frame, to = ends[0]
    facts = {
        "free": tuple(map(str, closed.free)),
        "dependent": tuple(map(str, closed.dependent)),
        "ends": ends,
        "mask": mask,
        **{name: getattr(closed, name) for name in ("mobility", "branches", "branch", "condition")},
        "worst at": closed.worst,
        "domain": closed.function.domain,
    }
    return Articulation(SOLVED_LOOP, to, frame, dynamics=tuple(facts.items()))


def make_constrained_record(
    ends: tuple[tuple[str, str], ...], mask: tuple[str, ...], constraints: tuple[str, ...]
) -> Articulation:
    """Return the record of a loop with equality constraints."""
    frame, to = ends[0]
    facts = ("ends", ends), ("mask", mask), ("constraints", constraints)
    return Articulation(CONSTRAINED_LOOP, to, frame, dynamics=facts)


def find_loops(model: ModelView) -> Iterator[LoopRecord]:
    """Yield the loops of a model in the order of their operations.

    Loops of a document are included, if it has complete records; documents of earlier versions have not.
    """
    followers = set(map(str, model.rates.dependent))
    for name, record in model.articulations.items():
        known = dict(record.dynamics)
        if record.kind not in LOOP_KINDS or not _is_complete(known, record.kind):
            continue
        loop = _as_named(name, record, known)
        there = followers >= set(loop.dependent) and all(c in model.constraints for c in loop.constraints)
        if there and all(frame in model.frames or frame == WORLD for pair in loop.ends for frame in pair):
            yield loop


def _is_complete(known: Mapping[str, Any], kind: str) -> bool:
    """Return whether a record is complete; documents may contain anything under these names."""
    ends = known.get("ends")
    said = ("mask", "free", "dependent") if kind == SOLVED_LOOP else ("mask", "constraints")
    texts = (known.get(key) for key in said)
    return (
        isinstance(ends, tuple)
        and bool(ends)
        and all(_is_texts(pair) and len(pair) == 2 for pair in ends)
        and all(map(_is_texts, texts))
    )


def _is_texts(value: object) -> bool:
    return isinstance(value, tuple) and all(isinstance(item, str) for item in value)


def _as_named(name: str, record: Articulation, known: Mapping[str, Any]) -> LoopRecord:
    """Return a record with the names of frames and coordinates in the model.

    A document stores texts without the prefix that its frames get when it is loaded.
    """
    frame, to = known["ends"][0]
    renamed, saved = (record.child, frame) if frame != WORLD else (record.parent, to)
    prefix = renamed.removesuffix(saved)
    before = symbol_name(prefix, 0)
    ends = tuple((_below(prefix, one), _below(prefix, other)) for one, other in known["ends"])
    free, dependent = (tuple(f"{before}{s}" for s in known.get(key, ())) for key in ("free", "dependent"))
    constraints = tuple(f"{prefix}{c}" for c in known.get("constraints", ()))
    return LoopRecord(name, ends, known["mask"], free, dependent, constraints)


def _below(prefix: str, frame: str) -> str:
    return frame if frame == WORLD else f"{prefix}{frame}"
