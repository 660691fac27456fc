"""Playback of a recorded run on the page: the truth moves, the belief is a ghost, vectors are arrows."""

from __future__ import annotations

from typing import Any

from kineverse.errors import InvalidValueError
from kineverse.view.recorded_scene import RecordedScene
from kineverse.view.run_layer import RunLayer
from kineverse.view.viewer import Viewer
from kineverse.worlds import RunRecording


def play_recording(
    page: Viewer,
    recording: RunRecording,
    *,
    time: float | None = None,
    speed: float = 1.0,
    loop: bool = False,
) -> None:
    """Play a recorded run on a page of its model, with a slider for the time."""
    scene = RecordedScene(recording)
    if scene.trajectory is None:
        raise InvalidValueError(f"There is no state in {recording.path.name} to be played.")
    page.play(scene.trajectory, speed=speed, loop=loop, layer=RecordingLayer(page.server, scene), at=time)


class RecordingLayer:
    """Layer of a recorded run, by time."""

    def __init__(self, server: Any, scene: RecordedScene) -> None:
        self._scene, self._layer = scene, RunLayer(server, scene.drawing, "recording")

    def show(self, time: float) -> None:
        """Show the belief, the vectors and the phase at a time [s]."""
        self._layer.draw(self._scene.at(time))

    def remove(self) -> None:
        """Remove everything from the page."""
        self._layer.remove()
