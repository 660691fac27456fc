"""Dependence of frames on symbols."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import gradient_keys
from kineverse.symbols import Symbol

from .body import is_empty_body
from .frame import WORLD, Frame
from .model_view import ModelView, find_symbols
from .rates import collect_symbols


class FrameDependence:
    """Frames of a model that move when some symbols change.

    Symbols are compared as coordinates, whatever their order, as for constraints. A speed moves the frames
    that its position moves, and those of every coordinate whose rate contains the speed. An independent
    coordinate of a closed loop moves the frames of its dependent coordinates.
    """

    def __init__(self, model: ModelView, symbols: Iterable[Symbol | str]) -> None:
        self._frames: Mapping[str, Frame] = dict(model.frames)
        known = _known_paths(model)
        asked = find_symbols(model, symbols)
        self._paths = _driven_coordinates(model, {_known_path(s, known) for s in asked})
        self._moving_ancestors: dict[str, tuple[str, ...]] = {WORLD: ()}

    def moves(self, frame: str) -> bool:
        """Return True if a frame moves in the world."""
        return bool(self.moving_ancestors(frame))

    def moves_between(self, one: str, other: str) -> bool:
        """Return True if two frames move with respect to each other."""
        return self.moving_ancestors(one) != self.moving_ancestors(other)

    def moving_ancestors(self, name: str) -> tuple[str, ...]:
        """Return those frames on the path from the world to a frame that move in their parent."""
        above = []
        while name not in self._moving_ancestors:
            above.append(name)
            name = self._frames[name].parent
        moving = self._moving_ancestors[name]
        for frame in reversed(above):
            stays = self._paths.isdisjoint(_paths_in_parent(self._frames[frame]))
            moving = moving if stays else (*moving, frame)
            self._moving_ancestors[frame] = moving
        return moving


def moved_frames(model: ModelView, symbols: Iterable[Symbol | str]) -> dict[Symbol, tuple[str, ...]]:
    """Return the frames that each symbol moves in the world, for many symbols at once.

    The symbols are compared as in :class:`FrameDependence`. The frames are in the order of the model.

    Parameters
    ----------
    symbols
        Symbols, their names or patterns, such as the speeds of a controller.

    Examples
    --------
    >>> kv.model.moved_frames(kv.load("kitchen"), ["kitchen/fridge_door"])
    {kitchen/fridge_door: ('kitchen/fridge_door', 'kitchen/fridge_door_handle')}
    """
    asked = list(find_symbols(model, symbols))
    known = _known_paths(model)
    bits: dict[str, int] = {}  # one bit for each symbol, in the masks of coordinates and of frames
    for i, symbol in enumerate(asked):
        for path in _driven_coordinates(model, {_known_path(symbol, known)}):
            bits[path] = bits.get(path, 0) | 1 << i
    frames: Mapping[str, Frame] = dict(model.frames)
    masks = {WORLD: 0}
    for frame in frames:
        above = []
        while frame not in masks:
            above.append(frame)
            frame = frames[frame].parent
        mask = masks[frame]
        for name in reversed(above):
            for path in _paths_in_parent(frames[name]):
                mask |= bits.get(path, 0)
            masks[name] = mask
    result: dict[Symbol, tuple[str, ...]] = {}
    for i, symbol in enumerate(asked):
        result[symbol] = tuple(name for name in frames if masks[name] >> i & 1)
    return result


def moving_symbols(model: ModelView, symbols: Iterable[Symbol | str]) -> dict[str, tuple[Symbol, ...]]:
    """Return which of some symbols move each frame in its parent, for the frames that any of them moves.

    The symbols are compared as in :class:`FrameDependence`. The frames are in the order of the model.
    """
    asked = list(find_symbols(model, symbols))
    known = _known_paths(model)
    movers: dict[str, list[Symbol]] = {}
    for symbol in asked:
        for path in _driven_coordinates(model, {_known_path(symbol, known)}):
            movers.setdefault(path, []).append(symbol)
    result: dict[str, tuple[Symbol, ...]] = {}
    for name, frame in model.frames.items():
        found = {s for path in _paths_in_parent(frame) for s in movers.get(path, ())}
        if found:
            result[name] = tuple(s for s in asked if s in found)
    return result


def count_moved_bodies(model: ModelView, symbols: Iterable[Symbol | str]) -> dict[Symbol, int]:
    """Return the number of bodies with shapes or inertia that each symbol moves, see :func:`moved_frames`.

    Examples
    --------
    >>> model = kv.load("pr2")
    >>> kv.model.count_moved_bodies(model, ["pr2/torso_lift_joint", "pr2/l_wrist_roll_joint"])
    {pr2/torso_lift_joint: 33, pr2/l_wrist_roll_joint: 7}
    """
    bodies = {name for name, body in model.bodies.items() if not is_empty_body(body)}
    return {s: len(bodies.intersection(frames)) for s, frames in moved_frames(model, symbols).items()}


def _paths_in_parent(frame: Frame) -> set[str]:
    """Return the paths of the symbols that move a frame in its parent, those of gradients included."""
    result: set[str] = set()
    for factor in frame.factors:
        if isinstance(factor, Expression):
            result.update(s.path for s in collect_symbols(factor))
            result.update(s.path for s in gradient_keys(factor, heuristic=False))
    return result


def _known_paths(model: ModelView) -> set[str]:
    return {s.path for s in (*model.symbols, *model.rates.dependent, *model.speeds)}


def _known_path(symbol: Symbol, known: set[str]) -> str:
    if symbol.path not in known:
        raise UnknownNameError(f"The model has no symbol '{symbol}'. {suggest(symbol.path, known, 'symbol')}")
    return symbol.path


def _driven_coordinates(model: ModelView, paths: set[str]) -> set[str]:
    rates = model.rates
    result = set(paths)
    for coordinate, row in rates.items():
        if any(speed.path in paths for speed in row):
            result.add(coordinate.path)
    # A coordinate in such a row may in turn determine dependent coordinates.
    for coordinate, expression in rates.dependent.items():
        if any(s.path in result for s in expression.symbols):
            result.add(coordinate.path)
    return result
