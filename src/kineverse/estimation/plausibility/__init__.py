"""Plausibility of a served model, and replacements of its joints."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .check import (
        PlausibilityMonitor as PlausibilityMonitor,
        check_plausibility as check_plausibility,
    )
    from .report import (
        ImplausibleError as ImplausibleError,
        JointVerdict as JointVerdict,
        Plausibility as Plausibility,
    )

lazy_face(__name__)
