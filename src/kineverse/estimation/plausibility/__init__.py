"""Plausibility of a served model, and replacements of its joints."""

from .monitor import PlausibilityMonitor
from .plausibility import check_plausibility
from .report import ImplausibleError, JointVerdict, Plausibility

__all__ = ["ImplausibleError", "JointVerdict", "Plausibility", "PlausibilityMonitor", "check_plausibility"]
