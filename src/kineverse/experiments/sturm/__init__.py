"""``sturm``: doors and drawers that others recorded, and whether they are taken for what they are."""

from .classify import OPTIONS, run

__all__ = ["OPTIONS", "run"]
