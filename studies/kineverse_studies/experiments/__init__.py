"""Experiments of the papers: measurements beside the published values, with figures."""

from kineverse.view.plots import Figure

from .registry import EXPERIMENTS, Options, reproduce
from .report import Report, ReportTable

__all__ = ["EXPERIMENTS", "Figure", "Options", "Report", "ReportTable", "reproduce"]
