"""State estimation of a known model from noisy measurements."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from kineverse.estimation.noise import Outliers as Outliers

    from .estimate import Estimate as Estimate
    from .tracker import HypothesisBank as HypothesisBank
    from .measurements import (
        ObservedExpression as ObservedExpression,
        ObservedPose as ObservedPose,
        ObservedPosition as ObservedPosition,
    )
    from .tracker import Tracker as Tracker

lazy_face(__name__)
