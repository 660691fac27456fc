"""SRDF, the Semantic Robot Description Format of MoveIt, which accompanies a URDF."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .description import (
        EndEffector as EndEffector,
        Srdf as Srdf,
        SrdfGroup as SrdfGroup,
        VirtualJoint as VirtualJoint,
    )
    from .reader import parse_srdf as parse_srdf, read_srdf as read_srdf

lazy_face(__name__)
