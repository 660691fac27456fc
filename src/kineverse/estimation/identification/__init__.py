"""Identification of joints and kinematic graphs from noisy poses."""

from .families import Family, FamilyParameter
from .joint_identification import identify
from .online_identification import Identifier
from .result import Fit, IdentificationResult

__all__ = ["Family", "FamilyParameter", "Fit", "IdentificationResult", "Identifier", "identify"]
