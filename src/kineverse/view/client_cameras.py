"""Cameras of browsers: everything stays in view as windows have it, until somebody moves the camera."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from kineverse.view.camera import Camera

logger = logging.getLogger(__name__)

SAME = 1e-3
"""Poses of cameras that differ by less are the same, as a part of the distance to what is looked at."""


class ClientCameras:
    """Places the cameras of all browsers that show a page, for the shape of each window.

    Parameters
    ----------
    server
        A viser server.
    first
        Where the server puts the cameras of new browsers.
    framed
        Returns the camera for an aspect, the width of a picture divided by its height.
    """

    def __init__(self, server: Any, first: Camera, framed: Callable[[float], Camera]) -> None:
        self._lock = threading.Lock()
        self._first, self._framed = first, framed
        self._placed: dict[int, Camera] = {}
        server.on_client_connect(self._meet)
        server.on_client_disconnect(lambda client: self._placed.pop(client.client_id, None))

    def follow(self, first: Camera, framed: Callable[[float], Camera]) -> None:
        """Frame something else from now on."""
        with self._lock:
            self._first, self._framed = first, framed

    def _meet(self, client: Any) -> None:
        client.camera.on_update(self._place)
        self._place(client.camera)

    def _place(self, camera: Any) -> None:
        """Move a camera to where it sees everything, if nobody has moved it from where it was put."""
        try:
            with self._lock:
                if not camera.image_height or not camera.image_width:
                    return
                client = camera.client
                wanted = self._framed(camera.image_width / camera.image_height)
                ours = (self._first, self._placed.get(client.client_id, self._first))
                if any(_is_at(camera, place) for place in ours) and not _is_at(camera, wanted):
                    self._placed[client.client_id] = wanted
                    with client.atomic():
                        camera.position = np.array(wanted.position)
                        camera.look_at = np.array(wanted.target)
        except Exception:
            # The browser may be going away; whoever looks can still move the camera.
            logger.debug("a camera could not be placed", exc_info=True)


def _is_at(camera: Any, place: Camera) -> bool:
    off = np.abs(np.concatenate([camera.position - place.position, camera.look_at - place.target])).max()
    return bool(off < SAME * np.linalg.norm(np.subtract(place.position, place.target)))
