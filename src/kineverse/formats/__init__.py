"""Readers and writers of robot and scene descriptions."""

from .loading import load
from .sources import locate_model, shipped_models

__all__ = ["load", "locate_model", "shipped_models"]
