"""viser nodes of the simulation: bodies that are moved, and marks that are redrawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from kineverse.view.drawables import Drawable, Rgba
from kineverse.view.poses import to_wxyz
from kineverse.view.rendering import lighting
from kineverse.view.rendering.triangle_mesh import Floats

from . import marker_meshes as marks
from .placed_model import shade
from .scene import CAMERA, ESTIMATE_POSE, SceneDrawables
from .unknown_mechanisms import BASE, PART

ROOT = "/living"

EXTENT = 12.0
"""Extent of the scene [m]."""

FIELD_OF_VIEW = 0.86
"""Field of view [rad]: beside the controls a page is about as high as it is wide."""

HIDDEN_SCALE = 1e-4
"""Scale of a hidden marker."""

POSE_TOLERANCE = 2e-4
"""Largest change of a pose that is not sent [m], [rad]."""

CAPTIONS = {"the truth": (0.4, 0.0, 2.75), "the estimate": (0.4, 0.0, 2.75)}


class SceneNodes:
    """Nodes of a viser server that show a scene; an update sends only changes.

    Parameters
    ----------
    server
        A viser server.
    drawables
        The parts of the scene.
    """

    def __init__(self, server: Any, drawables: SceneDrawables) -> None:
        self._server, self._drawables = server, drawables
        lighting.set_up(server)
        lighting.set_floor(server, 0.0, EXTENT, True)
        away = np.subtract(CAMERA.position, CAMERA.target)
        lighting.set_lamp(server, float(np.arctan2(away[1], away[0])))
        start = server.initial_camera
        start.position, start.look_at = np.array(CAMERA.position), np.array(CAMERA.target)
        start.fov = FIELD_OF_VIEW
        for number, (text, at) in enumerate(CAPTIONS.items()):
            place = np.asarray(at) + (ESTIMATE_POSE[:3, 3] if number else 0.0)
            server.scene.add_label(f"{ROOT}/words{number}", text, position=place)
        self._nodes: dict[str, Any] = {}
        self._meshes: dict[str, list[tuple[Any, Drawable]]] = {}
        self._poses: dict[str, Floats] = {}
        self._colors: dict[str, Rgba] = {}
        with server.atomic():
            self._add(drawables.truth.parts)
            # Estimates have no shadows, which are much of the work of a browser without a graphics card.
            self._add(drawables.estimate.parts, shadows=False)
            self._add_marks()
            self._add_mechanism()
        self.update()

    def _add(self, parts: list[Drawable], shadows: bool = True) -> None:
        poses = self._drawables.poses()
        for number, part in enumerate(parts):
            key = part.frame
            if key not in self._nodes:
                # Slashes would make viser nest the nodes.
                name = f"{ROOT}/{key.replace('/', '∕')}"
                self._nodes[key] = self._server.scene.add_frame(name, show_axes=False)
                if key in poses:
                    self._place(key, poses[key])
            red, green, blue, alpha = part.color
            mesh = self._server.scene.add_mesh_simple(
                f"{self._nodes[key].name}/{number}",
                part.surface.vertices,
                part.surface.faces,
                color=_bytes((red, green, blue)),
                opacity=None if alpha >= 1.0 else alpha,
                side="front" if part.surface.closed else "double",
                cast_shadow=shadows,
                # In a scene this large the shadow of a body on itself is a pattern of stripes.
                receive_shadow=False,
            )
            self._meshes.setdefault(key, []).append((mesh, part))

    def _add_mechanism(self) -> None:
        drawables = self._drawables
        self._drawn_results = -1
        self._shown_mechanism = drawables.known_mechanism
        self._add(drawables.mechanism.parts)
        self._add(drawables.identified.parts, shadows=False)

    def _add_marks(self) -> None:
        scene, simulation = self._server.scene, self._drawables.simulation
        count = len(simulation.kitchen_tracker.frames) + len(simulation.poses)
        self._markers = scene.add_batched_axes(
            f"{ROOT}/markers",
            np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            np.zeros((count, 3)),
            batched_scales=np.ones(count),
            axes_length=marks.MARKER,
            axes_radius=marks.THICK / 2,
        )
        nowhere = np.zeros((1, 2, 3), dtype=np.float32)
        self._bars, *self._lines = (
            scene.add_line_segments(f"{ROOT}/{name}", nowhere, _bytes(color), thickness=2.0 * radius)
            for name, color, radius in (
                ("bars", marks.BARS, marks.BAR),
                ("axis0", marks.AXIS, marks.LINE),
                ("axis1", marks.AXIS, marks.LINE),
            )
        )
        self._cloud = scene.add_point_cloud(
            f"{ROOT}/cloud", nowhere[0], _bytes(marks.CLOUD), point_size=0.025, point_shape="circle"
        )
        self._tubes = [
            scene.add_mesh_simple(
                f"{ROOT}/tube{number}",
                nowhere[0],
                np.zeros((1, 3), dtype=np.uint32),
                color=_bytes(marks.TUBE),
                opacity=0.35,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            for number in range(2)
        ]

    def _segments(self) -> Floats:
        """Return the uncertainty bars as lines (n, 2, 3)."""
        paths = self._drawables.uncertainty_bars()
        return np.stack([paths[:, :-1], paths[:, 1:]], axis=2).reshape(-1, 2, 3)

    def update(self) -> None:
        """Show the present state."""
        drawables = self._drawables
        with self._server.atomic():
            if drawables.known_mechanism is not self._shown_mechanism:
                self._remove_mechanism()
                self._add_mechanism()
            for key, pose in drawables.poses().items():
                if key in self._nodes and np.abs(pose - self._poses.get(key, np.inf)).max() > POSE_TOLERANCE:
                    self._place(key, pose)
            for key, tone in drawables.colors().items():
                if key in self._meshes and self._colors.get(key) != tone:
                    self._colors[key] = tone
                    for mesh, part in self._meshes[key]:
                        mesh.color = _bytes(shade(tone, part.color)[:3])
            self._update_markers()
            self._bars.points = self._segments().astype(np.float32)
            if len(drawables.simulation.learner.history) != self._drawn_results:
                self._drawn_results = len(drawables.simulation.learner.history)
                self._draw_axis()

    def _place(self, key: str, pose: Floats) -> None:
        self._poses[key] = pose
        node = self._nodes[key]
        node.position, node.wxyz = pose[:3, 3], to_wxyz(pose[None])[0]

    def _update_markers(self) -> None:
        simulation = self._drawables.simulation
        poses = np.concatenate([simulation.readings.poses, simulation.mechanism_readings.poses])
        visible = np.concatenate([simulation.readings.visible, simulation.mechanism_readings.visible])
        self._markers.batched_positions = poses[:, :3, 3].astype(np.float32)
        self._markers.batched_wxyzs = to_wxyz(poses).astype(np.float32)
        self._markers.batched_scales = np.where(visible, 1.0, HIDDEN_SCALE).astype(np.float32)

    def _draw_axis(self) -> None:
        """Draw the latest identified axis and the stored positions, which change seldom."""
        drawables = self._drawables
        observed_positions, axis = drawables.observed_positions(), drawables.axis()
        self._nodes[drawables.identified.key(PART)].visible = drawables.simulation.learner.model is not None
        self._cloud.visible = bool(len(observed_positions))
        self._cloud.points = observed_positions.astype(np.float32)
        for mark in (*self._lines, *self._tubes):
            mark.visible = axis is not None
        if axis is None:
            return
        for shown, line in zip(self._lines, axis.lines, strict=True):
            shown.points = line[None].astype(np.float32)
        for shown, tube in zip(self._tubes, axis.tubes, strict=True):
            shown.vertices, shown.faces = tube.vertices.astype(np.float32), tube.faces.astype(np.uint32)

    def _remove_mechanism(self) -> None:
        drawables = self._drawables
        for placed in (drawables.mechanism, drawables.identified):
            for frame in (BASE, PART):
                key = placed.key(frame)
                self._nodes.pop(key).remove()
                for table in (self._meshes, self._poses, self._colors):
                    table.pop(key, None)


def _bytes(color: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in color)
    return red, green, blue
