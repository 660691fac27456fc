"""Layer of a run on the page: ghost of the belief, arrows and way of the controller, text and a table."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from kineverse.view.hypertext import BREAK, FONT, HtmlBox, element
from kineverse.view.motion_drawables import TRACE
from kineverse.view.poses import to_wxyz
from kineverse.view.run_drawing import GHOST, WAY_RADIUS, RunDrawing, RunMoment
from kineverse.view.triangle_mesh import Floats

_ROOT = "/run"
_CELL = "text-align:left;padding:1px 9px 1px 0;vertical-align:top;white-space:nowrap"


class RunLayer:
    """Ghost, arrows, way, text and table of a run on the page."""

    def __init__(self, server: Any, drawing: RunDrawing, title: str) -> None:
        self._server, self._drawing = server, drawing
        # Events of the page come from other threads than moments.
        self._lock = threading.RLock()
        self._moment = RunMoment({}, {})
        self._ghosts: dict[str, Any] = {}
        self._arrows: list[Any] = []
        self._way: Any = None
        self._wanted: Any = None
        self._folder = server.gui.add_folder(title, order=-0.9)
        with self._folder:
            self._text = HtmlBox(server.gui, element("div"))
            self._ghost_box = server.gui.add_checkbox("belief", True, hint="Show what the robot believes.")
            self._arrow_box = server.gui.add_checkbox(
                "controller", True, hint="Show vectors of the controller as arrows, and the way of the hand."
            )
            self._table = HtmlBox(server.gui, element("div"))
        for box in (self._ghost_box, self._arrow_box):
            box.on_update(lambda _: self.draw(self._moment))

    def draw(self, moment: RunMoment) -> None:
        """Show ghost, arrows and text of a moment, in place of those before."""
        with self._lock, self._server.atomic():
            self._moment = moment
            self._draw_ghosts(moment.ghosts if self._ghost_box.value else {})
            self._draw_arrows(moment.arrows if self._arrow_box.value else {})
            self._draw_way(moment if self._arrow_box.value else RunMoment({}, {}))
            lines = [line for text in moment.lines for line in (text, BREAK)]
            self._text.show(element("div", *lines, style=f"{FONT}padding:0 9px"))

    def show_table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Show a table below the text."""
        lines = [element("tr", *(element("th", cell, style=_CELL) for cell in head))]
        lines += [element("tr", *(element("td", cell, style=_CELL) for cell in row)) for row in rows]
        with self._lock:
            self._table.show(
                element(
                    "table",
                    *lines,
                    style=f"{FONT}margin:6px 9px;border-collapse:collapse;display:block;overflow-x:auto",
                )
            )

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

    def _draw_way(self, moment: RunMoment) -> None:
        """Draw the way of the hand as a line, and the pose at which it is wanted as axes."""
        scene = self._server.scene
        if self._way is not None:
            self._way.remove()
            self._way = None
        if moment.way is not None and len(moment.way) > 1:
            color = tuple(round(255 * c) for c in TRACE[:3])
            ends = np.stack([moment.way[:-1], moment.way[1:]], axis=1).astype(np.float32)
            self._way = scene.add_line_segments(f"{_ROOT}/way", ends, color, thickness=2 * WAY_RADIUS)
        if self._wanted is None and moment.wanted is not None:
            self._wanted = scene.add_frame(f"{_ROOT}/wanted", axes_length=0.12, axes_radius=0.005)
        if self._wanted is not None:
            self._wanted.visible = moment.wanted is not None
            if moment.wanted is not None:
                self._wanted.position = moment.wanted[:3, 3]
                self._wanted.wxyz = to_wxyz(moment.wanted[None])[0]
