"""The papers' experiments, made again: each measures, says beside it what the papers report, and draws."""

from .options import Options
from .registry import EXPERIMENTS, reproduce
from .report import Figure, Report, Table

__all__ = ["EXPERIMENTS", "Figure", "Options", "Report", "Table", "reproduce"]
