"""Estimation: state tracking, calibration, model identification and plausibility of models.

:mod:`kineverse.estimation.tracking` estimates the state of a known model,
:mod:`kineverse.estimation.calibration` the geometry of a model,
:mod:`kineverse.estimation.identification` identifies joints between observed frames, and
:mod:`kineverse.estimation.plausibility` tests a model against observations. Layer 5.
"""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .calibration import (
        Calibration as Calibration,
        Look as Look,
        LookTable as LookTable,
        ObservedPixel as ObservedPixel,
        WheelOdometry as WheelOdometry,
        calibrate as calibrate,
        read_looks as read_looks,
    )
    from .identification import (
        Family as Family,
        FamilyParameter as FamilyParameter,
        Fit as Fit,
        IdentificationResult as IdentificationResult,
        Identifier as Identifier,
        identify as identify,
    )
    from .identification.kinematic_graph import (
        KinematicEdge as KinematicEdge,
        KinematicGraph as KinematicGraph,
        RigidBody as RigidBody,
        identify_graph as identify_graph,
    )
    from .noise import pose_covariance as pose_covariance
    from .plausibility import (
        ImplausibleError as ImplausibleError,
        JointVerdict as JointVerdict,
        Plausibility as Plausibility,
        PlausibilityMonitor as PlausibilityMonitor,
        check_plausibility as check_plausibility,
    )
    from .tracking import (
        Estimate as Estimate,
        HypothesisBank as HypothesisBank,
        ObservedExpression as ObservedExpression,
        ObservedPose as ObservedPose,
        ObservedPosition as ObservedPosition,
        Outliers as Outliers,
        Tracker as Tracker,
    )

lazy_face(__name__)
