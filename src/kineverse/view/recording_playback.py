"""Playback of a recorded run on the page: the truth moves, the belief is a ghost, vectors are arrows."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.view.hypertext import BREAK, FONT, HtmlBox, element
from kineverse.view.poses import to_wxyz
from kineverse.view.recorded_scene import GHOST, RecordedScene
from kineverse.view.viewer import Viewer
from kineverse.worlds import RunRecording

_ROOT = "/recording"


def play_recording(
    page: Viewer,
    recording: RunRecording,
    *,
    time: float | None = None,
    speed: float = 1.0,
    loop: bool = False,
) -> None:
    """Play a recorded run on a page of its model, with a slider for the time.

    Parameters
    ----------
    page
        Page of ``recording.model``.
    recording
        The run.
    time
        Time to show, without playing [s]; None to play from the beginning.
    speed
        Time of the recording per time of the clock.
    loop
        True to play it again and again.

    Raises
    ------
    InvalidValueError
        If nothing was recorded.
    """
    scene = RecordedScene(recording)
    if scene.trajectory is None:
        raise InvalidValueError(f"There is no state in {recording.path.name} to be played.")
    layer = RecordingLayer(page.server, scene)
    page.play(scene.trajectory, speed=speed, loop=loop, layer=layer, at=time)


class RecordingLayer:
    """Ghost, arrows and text of a recorded run on the page.

    Parameters
    ----------
    server
        A viser server.
    scene
        Contents of the run.
    """

    def __init__(self, server: Any, scene: RecordedScene) -> None:
        self._server, self._scene = server, scene
        # Events of the page come from other threads than the clock.
        self._lock = threading.Lock()
        self._time = 0.0
        self._ghosts: dict[str, Any] = {}
        self._arrows: list[Any] = []
        self._folder = server.gui.add_folder("run", order=-0.9)
        with self._folder:
            self._text = HtmlBox(server.gui, element("div"))
            self._ghost_box = server.gui.add_checkbox(
                "belief",
                True,
                visible=bool(len(scene.recording.beliefs)),
                hint="Show what the robot believes.",
            )
            self._arrow_box = server.gui.add_checkbox(
                "controller",
                True,
                visible=bool(len(scene.recording.vectors)),
                hint="Show vectors of the controller as arrows.",
            )
        for box in (self._ghost_box, self._arrow_box):
            box.on_update(lambda _: self.show(self._time))

    def show(self, time: float) -> None:
        """Show the belief, the vectors and the phase at a time [s]."""
        with self._lock, self._server.atomic():
            self._time = time
            self._show_ghosts(time)
            self._show_arrows(time)
            lines = [line for text in self._scene.describe(time) for line in (text, BREAK)]
            self._text.show(element("div", *lines, style=f"{FONT}padding:0 9px"))

    def remove(self) -> None:
        """Remove everything from the page."""
        with self._lock:
            self._folder.remove()
            self._server.scene.remove_by_name(_ROOT)

    def _show_ghosts(self, time: float) -> None:
        poses = self._scene.ghost_poses(time) if self._ghost_box.value else {}
        for frame, pose in poses.items():
            node = self._ghosts.get(frame) or self._add_ghost(frame)
            node.position, node.wxyz = pose[:3, 3], to_wxyz(pose[None])[0]
        for frame, node in self._ghosts.items():
            if node.visible != (frame in poses):
                node.visible = frame in poses

    def _add_ghost(self, frame: str) -> Any:
        """Add the shapes of a body to the page, and return the node that moves them."""
        scene = self._server.scene
        node = self._ghosts[frame] = scene.add_frame(f"{_ROOT}/ghost{len(self._ghosts)}", show_axes=False)
        color = tuple(round(255 * c) for c in GHOST[:3])
        for k, part in enumerate(part for part in self._scene.parts if part.frame == frame):
            surface = part.surface
            scene.add_mesh_simple(
                f"{node.name}/{k}",
                surface.vertices,
                surface.faces,
                color=color,
                opacity=GHOST[3],
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        return node

    def _show_arrows(self, time: float) -> None:
        for node in self._arrows:
            node.remove()
        self._arrows = []
        arrows = self._scene.arrows(time) if self._arrow_box.value else {}
        if not arrows:
            return
        scene, ends = self._server.scene, np.array(list(arrows.values()))
        colors = [[round(255 * c) for c in self._scene.arrow_color(name)[:3]] for name in arrows]
        self._arrows.append(
            scene.add_arrows(
                f"{_ROOT}/arrows",
                ends.astype(np.float32),
                np.array(colors, dtype=np.uint8),
                shaft_radius=0.006,
                head_radius=0.016,
                head_length=0.04,
            )
        )
        self._arrows += [
            scene.add_label(f"{_ROOT}/name{k}", name, position=ends[k, 1], font_screen_scale=0.8)
            for k, name in enumerate(arrows)
        ]
