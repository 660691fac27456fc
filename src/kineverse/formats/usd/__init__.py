"""USD, Universal Scene Description: joints and bodies of UsdPhysics, and the document of the model."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .kinematics import stage_poses as stage_poses

lazy_face(__name__)
