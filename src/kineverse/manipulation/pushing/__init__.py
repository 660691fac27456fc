"""Pushing: contact points, their choice, and a controller that only pushes (2020 paper, eq. 5-11)."""

from .push_controller import Pushing
from .push_skill import push

__all__ = ["Pushing", "push"]
