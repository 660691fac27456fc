"""Identification of joints and kinematic graphs from noisy poses."""

from .custom_family import Family, FamilyParameter
from .identify import identify
from .online import Identifier
from .result import Fit, IdentificationResult

__all__ = ["Family", "FamilyParameter", "Fit", "IdentificationResult", "Identifier", "identify"]
