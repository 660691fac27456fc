"""The frames that a model has more than the one that it was written from: links in between, and carriers."""

from __future__ import annotations

from collections.abc import Iterator

from kineverse.model.view import ModelView


def added_frames(model: ModelView, original: ModelView) -> list[str]:
    """Return the frames of a model that a writer, or a reader, had to add to what the original has.

    They carry nothing, and either lie between two frames of which one hangs directly below the other in the
    original, called as what moves them or below the name of the lower one; or nothing is below them, and they
    are called as the one coordinate that moves them.
    """
    candidates = {name for name in model.frames if name not in original.frames and name not in model.bodies}
    found = set(_in_between(model, original, candidates)) if candidates else set()
    parents = {frame.parent for frame in model.frames.values()}
    found.update(name for name in candidates - parents if _is_carrier(model, name))
    return [name for name in model.frames if name in found]


def _in_between(model: ModelView, original: ModelView, candidates: set[str]) -> Iterator[str]:
    for lower, frame in original.frames.items():
        if lower not in model.frames:
            continue
        chain = []
        above = model.frames[lower].parent
        while above in candidates and _is_called_so(model, above, lower):
            chain.append(above)
            above = model.frames[above].parent
        if above == frame.parent:
            yield from chain


def _is_called_so(model: ModelView, name: str, lower: str) -> bool:
    movers = (name, name.removesuffix("_joint"))
    return name.startswith(f"{lower}/") or any(mover in model.articulations for mover in movers)


def _is_carrier(model: ModelView, name: str) -> bool:
    moving = [s for s in model.fk(name, model.frames[name].parent).symbols if s.has_derivative]
    return len(moving) == 1 and name in (moving[0].path, f"{moving[0].path}/carrier")
