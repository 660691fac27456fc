"""Plausibility of a served model, and replacements of its joints."""

from .check import check_plausibility
from .monitor import PlausibilityMonitor
from .report import ImplausibleError, JointVerdict, Plausibility

__all__ = ["ImplausibleError", "JointVerdict", "Plausibility", "PlausibilityMonitor", "check_plausibility"]
