"""Identification of joints and kinematic graphs from noisy poses."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .families import Family as Family, FamilyParameter as FamilyParameter
    from .joint_identification import identify as identify
    from .online_identification import Identifier as Identifier
    from .result import Fit as Fit, IdentificationResult as IdentificationResult

lazy_face(__name__)
