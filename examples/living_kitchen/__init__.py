"""A scene that lives: a kitchen in motion, seen through noise, tracked beside the truth, and a joint learned.

:class:`.life.Life` is the scene itself, numbers only: what moves, what is seen of it, what is believed. It is
drawn by :mod:`.picture` without a browser and by :mod:`.page` in one.
"""

from __future__ import annotations

from .sensor import Sight
from .simulation import Life

__all__ = ["Life", "Sight"]
