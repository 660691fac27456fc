"""Calibration of a model's geometry from recordings of joint values and of what was seen at them."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .calibration import Calibration as Calibration, calibrate as calibrate
    from .look_table import LookTable as LookTable, read_looks as read_looks
    from .observations import (
        BlockSource as BlockSource,
        Look as Look,
        NoiseGroup as NoiseGroup,
        ObservedPixel as ObservedPixel,
        ResidualBlock as ResidualBlock,
    )
    from .odometry import WheelOdometry as WheelOdometry

lazy_face(__name__)
