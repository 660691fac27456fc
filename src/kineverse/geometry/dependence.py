"""Dependence of frames on symbols."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model_view import ModelView
from kineverse.model.rate_nodes import collect_symbols
from kineverse.symbols import Symbol


class FrameDependence:
    """Frames of a model that move when some symbols change.

    Symbols are compared as coordinates, whatever their order, as for constraints. A speed moves the frames
    that its position moves, and those of every coordinate whose rate contains the speed. An independent
    coordinate of a closed loop moves the frames of its dependent coordinates.

    Parameters
    ----------
    model
        The model.
    symbols
        Symbols or their names.

    Raises
    ------
    UnknownNameError
        For a symbol that the model does not know.
    """

    def __init__(self, model: ModelView, symbols: Iterable[Symbol | str]) -> None:
        self._frames: Mapping[str, Frame] = dict(model.frames)
        self._paths = _driven_coordinates(model, {_symbol_path(model, symbol) for symbol in symbols})
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
            moving = (*moving, frame) if self._moves_in_parent(frame) else moving
            self._moving_ancestors[frame] = moving
        return moving

    def _moves_in_parent(self, name: str) -> bool:
        for factor in self._frames[name].factors:
            if isinstance(factor, Expression):
                if any(s.path in self._paths for s in collect_symbols(factor)):
                    return True
                if any(key.path in self._paths for key in factor.gradient(False)):
                    return True
        return False


def _symbol_path(model: ModelView, symbol: Symbol | str) -> str:
    if isinstance(symbol, Symbol):
        known = {s.path for s in (*model.symbols, *model.rates.dependent, *model.speeds)}
        if symbol.path not in known:
            raise UnknownNameError(
                f"The model has no symbol '{symbol}'. {suggest(symbol.path, known, 'symbol')}"
            )
        return symbol.path
    return model.symbol(symbol).path


def _driven_coordinates(model: ModelView, paths: set[str]) -> set[str]:
    """Return the paths of all coordinates that move with the given ones, including these."""
    rates = model.rates
    found = set(paths)
    for coordinate, row in rates.items():
        if any(speed.path in paths for speed in row):
            found.add(coordinate.path)
    # A coordinate in such a row may in turn determine dependent coordinates.
    for coordinate, expression in rates.dependent.items():
        if any(s.path in found for s in expression.symbols):
            found.add(coordinate.path)
    return found
