"""Readers and writers of robot and scene descriptions."""

from .loading import load, operations_of
from .sources import locate_model, shipped_models

__all__ = ["load", "locate_model", "operations_of", "shipped_models"]
