"""MJCF, the description format of MuJoCo, read by MuJoCo's own parser."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .description import (
        MjcfJoint as MjcfJoint,
        MjcfLink as MjcfLink,
        MjcfScene as MjcfScene,
        MjcfSite as MjcfSite,
    )
    from .reader import parse_mjcf as parse_mjcf, read_mjcf as read_mjcf

lazy_face(__name__)
