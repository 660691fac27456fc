"""Experiments of the papers: measurements beside the published values, with figures."""

from .registry import EXPERIMENTS, Options, reproduce
from .report import Figure, Report, ReportTable

__all__ = ["EXPERIMENTS", "Figure", "Options", "Report", "ReportTable", "reproduce"]
