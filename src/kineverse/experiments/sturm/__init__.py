"""``sturm``: doors and drawers that others recorded, and whether they are taken for what they are."""

from .report import OPTIONS, run

__all__ = ["OPTIONS", "run"]
