"""Collision geometry of a model (layer 4); a scene needs the extra ``geometry``."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .collision_filter import RULES as RULES, Rule as Rule, rules_as_data as rules_as_data
    from .distance_expressions import PairDistance as PairDistance
    from .distance_queries import PreparedQuery as PreparedQuery
    from .motion_checks.check import check_motion as check_motion
    from .motion_checks.report import (
        CoordinateReport as CoordinateReport,
        MotionFinding as MotionFinding,
        MotionReport as MotionReport,
    )
    from .results import (
        DistanceResult as DistanceResult,
        DistanceResults as DistanceResults,
        NearestPoint as NearestPoint,
        RayHit as RayHit,
    )
    from .scene import Scene as Scene

lazy_face(__name__)
