"""The papers' experiments, made again: each measures, says beside it what the papers report, and draws."""

from .registry import EXPERIMENTS, Options, reproduce
from .report import Figure, Report, ReportTable

__all__ = ["EXPERIMENTS", "Figure", "Options", "Report", "ReportTable", "reproduce"]
