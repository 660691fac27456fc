"""Layer of a run on the page: the belief as a ghost, arrows of the controller, and what happens in words."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from kineverse.view.hypertext import BREAK, FONT, HtmlBox, element
from kineverse.view.poses import to_wxyz
from kineverse.view.run_drawing import GHOST, RunDrawing, RunMoment
from kineverse.view.triangle_mesh import Floats

_ROOT = "/run"


class RunLayer:
    """Ghost, arrows and text of a run on the page.

    Parameters
    ----------
    server
        A viser server.
    drawing
        Drawing of the model of the page.
    title
        Title of the folder with the text.
    """

    def __init__(self, server: Any, drawing: RunDrawing, title: str) -> None:
        self._server, self._drawing = server, drawing
        # Events of the page come from other threads than moments.
        self._lock = threading.RLock()
        self._moment = RunMoment({}, {})
        self._ghosts: dict[str, Any] = {}
        self._arrows: list[Any] = []
        self._folder = server.gui.add_folder(title, order=-0.9)
        with self._folder:
            self._text = HtmlBox(server.gui, element("div"))
            self._ghost_box = server.gui.add_checkbox("belief", True, hint="Show what the robot believes.")
            self._arrow_box = server.gui.add_checkbox(
                "controller", True, hint="Show vectors of the controller as arrows."
            )
        for box in (self._ghost_box, self._arrow_box):
            box.on_update(lambda _: self.draw(self._moment))

    def draw(self, moment: RunMoment) -> None:
        """Show ghost, arrows and text of a moment, in place of those before."""
        with self._lock, self._server.atomic():
            self._moment = moment
            self._draw_ghosts(moment.ghosts if self._ghost_box.value else {})
            self._draw_arrows(moment.arrows if self._arrow_box.value else {})
            lines = [line for text in moment.lines for line in (text, BREAK)]
            self._text.show(element("div", *lines, style=f"{FONT}padding:0 9px"))

    def remove(self) -> None:
        """Remove everything from the page."""
        with self._lock:
            self._folder.remove()
            self._server.scene.remove_by_name(_ROOT)

    def _draw_ghosts(self, poses: Mapping[str, Floats]) -> None:
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
        for k, part in enumerate(part for part in self._drawing.parts if part.frame == frame):
            scene.add_mesh_simple(
                f"{node.name}/{k}",
                part.surface.vertices,
                part.surface.faces,
                color=color,
                opacity=GHOST[3],
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        return node

    def _draw_arrows(self, arrows: Mapping[str, Floats]) -> None:
        for node in self._arrows:
            node.remove()
        self._arrows = []
        if not arrows:
            return
        scene, ends = self._server.scene, np.array(list(arrows.values()))
        colors = [[round(255 * c) for c in self._drawing.color(name)[:3]] for name in arrows]
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
