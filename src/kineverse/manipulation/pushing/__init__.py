"""Pushing: contact points, their choice, and a controller that only pushes (2020 paper, eq. 5-11)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .push_controller import Pushing as Pushing
    from .push_skill import push as push

lazy_face(__name__)
