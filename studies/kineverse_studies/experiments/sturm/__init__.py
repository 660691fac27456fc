"""Experiment ``sturm``: classification of published recordings of doors and drawers."""

from .classify import OPTIONS, run

__all__ = ["OPTIONS", "run"]
