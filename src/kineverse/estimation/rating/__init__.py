"""Whether a served model still explains what is seen, and what would."""

from .monitor import PlausibilityMonitor
from .plausibility import plausibility
from .report import ImplausibleError, Plausibility, Rating

__all__ = ["ImplausibleError", "Plausibility", "PlausibilityMonitor", "Rating", "plausibility"]
