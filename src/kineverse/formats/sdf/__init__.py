"""SDF, the Simulation Description Format of Gazebo."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .description import (
        SdfAxis as SdfAxis,
        SdfFrame as SdfFrame,
        SdfJoint as SdfJoint,
        SdfLink as SdfLink,
        SdfRoot as SdfRoot,
        SdfScene as SdfScene,
    )
    from .reader import parse_sdf as parse_sdf, read_sdf as read_sdf

lazy_face(__name__)
