"""Three-dimensional scene of the page: bodies, frames and floor of a model."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from kineverse.model.model_view import ModelView

from .drawables import Drawable, Kind, choose_axis_length, collect_drawables
from .poses import FramePoses, to_wxyz
from .rendering import lighting
from .rendering.auto_camera import ClientCameras, choose_camera, find_extreme_points, reframe, weigh_drawables
from .rendering.camera import Camera
from .rendering.rasterizer import Projection, TriangleSoup, rasterize
from .rendering.triangle_mesh import Floats, TriangleMesh

FIELD_OF_VIEW, ASPECT = 0.8, 1.25
ROOT = "/model"

FADED_OPACITY = 0.45  # opacity of bodies while frames or nearest points inside of them are shown


class ViewerScene:
    """Scene of a model on the page; an update sends only poses that changed."""

    def __init__(
        self, server: Any, model: ModelView, values: Mapping[str, float], camera: Camera | None = None
    ) -> None:
        self._server, self._camera = server, camera
        self._cameras = ClientCameras(server)
        # Events of the page and the motion of the model come from different threads.
        self._lock = threading.RLock()
        self._frames_shown, self._labels_shown, self._filter = False, False, ""
        self._visuals_shown, self._collisions_shown, self._ground_shown = True, False, True
        self._decomposed, self._transparent = False, False
        self._overlay: tuple[Drawable, ...] = ()
        lighting.set_up(server)
        self.refresh(model, values)

    def refresh(self, model: ModelView, values: Mapping[str, float]) -> None:
        """Show another model, or this one after an edit, with the same settings."""
        with self._lock:
            self._model = model
            self._kinematics = FramePoses(model)
            self.names = self._kinematics.names
            self.poses = self._replace_non_finite(self._kinematics.evaluate(values), np.eye(4))
            self._drawables = visuals = collect_drawables(model)
            self.problems = sorted({f"{part.frame}: {part.problem}" for part in visuals if part.problem})
            with self._server.atomic():
                self._server.scene.remove_by_name(ROOT)
                self._nodes: dict[str, Any] = {}
                self._visuals, self._collisions = self._add(visuals, "visual"), list[Any]()
                self._overlay_nodes: list[Any] = []
                self._place_camera(visuals)
                self.show_ground(self._ground_shown)
                self.show_visuals(self._visuals_shown)
                self.show_collisions(self._collisions_shown)
                self.show_overlay(self._overlay)
                self.show_frames(self._frames_shown, self._labels_shown, self._filter)
            # A model without bodies would be an empty page.
            if not visuals:
                self.show_frames(True, True)

    def update(self, values: Mapping[str, float]) -> int:
        """Move all frames to their poses at values of all symbols; return the number of frames that moved."""
        with self._lock:
            hidden = set(self.unplaced)
            poses = self._replace_non_finite(self._kinematics.evaluate(values), self.poses)
            for frame in hidden.symmetric_difference(self.unplaced):
                if frame in self._nodes:
                    self._nodes[frame].visible = frame in hidden
            moved = np.flatnonzero(np.abs(poses - self.poses).max(axis=(1, 2)) > 1e-9)
            self.poses = poses
            if not len(moved):
                return 0
            quaternions = to_wxyz(poses[moved])
            with self._server.atomic():
                for k, wxyz in zip(moved, quaternions, strict=True):
                    node = self._nodes.get(self.names[k])
                    if node is not None:
                        node.position, node.wxyz = poses[k, :3, 3], wxyz
                self._move_frames()
            return len(moved)

    def _replace_non_finite(self, poses: Floats, replacements: Floats) -> Floats:
        """Return poses, with others in place of those that are not finite; note the frames of these."""
        self.unplaced = self._kinematics.unplaced(poses)
        return np.where(np.isfinite(poses).all(axis=(1, 2), keepdims=True), poses, replacements)

    def pose(self, frame: str) -> Floats:
        """Return the pose of a frame that was drawn last, 4×4."""
        return np.array(self.poses[self._kinematics.index(frame)])

    def pick(
        self, origin: npt.ArrayLike, direction: npt.ArrayLike
    ) -> tuple[str, tuple[float, float, float]] | None:
        """Return the frame of the first visible body on a ray, and the point in it [m], or None."""
        numbers = np.array([origin, direction], dtype=float)
        if not self._visuals_shown or not np.isfinite(numbers).all() or not numbers[1].any():
            return None
        with self._lock:
            at = {
                name: pose
                for name, pose in zip(self.names, self.poses, strict=True)
                if name not in self.unplaced
            }
            parts = [part for part in self._drawables if part.frame in at]
        # What is seen along a ray is a picture of one pixel.
        surfaces = TriangleSoup.from_drawables(parts, at)
        projection = Projection.from_camera(Camera(tuple(numbers[0]), tuple(numbers.sum(axis=0))), 1, 1)
        (seen,), (nearness,) = rasterize(projection, surfaces.corners, surfaces.closed)
        if seen < 0:
            return None
        frame = parts[surfaces.source[seen]].frame
        world_T_frame = at[frame]
        point = projection.origin + projection.axes[2] / nearness - world_T_frame[:3, 3]
        x, y, z = (point @ world_T_frame[:3, :3]).tolist()
        return frame, (x, y, z)

    def show_frames(self, axes: bool, labels: bool = False, containing: str = "") -> None:
        """Show or hide the axes and the names of the frames whose name contains a text."""
        with self._lock:
            self._frames_shown, self._labels_shown, self._filter = axes, labels, containing
            for name in ("/axes", "/labels"):
                self._server.scene.remove_by_name(name)
            wanted = [k for k, name in enumerate(self.names) if containing.lower() in name.lower()]
            self._shown, self._labels = wanted, []
            self._axes = None
            self._fade()
            if axes and wanted:
                self._axes = self._server.scene.add_batched_axes(
                    "/axes",
                    to_wxyz(self.poses[wanted]),
                    self.poses[wanted, :3, 3],
                    axes_length=self.length,
                    axes_radius=0.035 * self.length,
                )
            if labels:
                add = self._server.scene.add_label
                self._labels = [
                    add(f"/labels/{k}", self.names[k], position=self.poses[k, :3, 3], font_screen_scale=0.8)
                    for k in wanted
                ]

    def show_collisions(self, shown: bool) -> None:
        """Show or hide the collision shapes, half transparent; they are built on first use."""
        with self._lock:
            self._collisions_shown = shown
            if shown and not self._collisions:
                added = self._add(collect_drawables(self._model, "collision", self._decomposed), "collision")
                self._collisions = [node for node, _ in added]
            for node in self._collisions:
                node.visible = shown

    def show_overlay(self, items: Iterable[Drawable]) -> None:
        """Show further parts, which move with their frames, in place of those of an earlier call.

        Parts of frames that the model does not have any more are left out.
        """
        with self._lock:
            self._overlay = tuple(items)
            for node in self._overlay_nodes:
                node.remove()
            added = self._add((part for part in self._overlay if part.frame in self.names), "overlay")
            self._overlay_nodes = [node for node, _ in added]

    def decompose(self, wanted: bool) -> None:
        """Show collision meshes as the hulls of their decomposition, or as one hull again."""
        with self._lock:
            if wanted == self._decomposed:
                return
            self._decomposed = wanted
            for node in self._collisions:
                node.remove()
            self._collisions = []
            self.show_collisions(self._collisions_shown)

    @property
    def collisions_shown(self) -> bool:
        """True if the collision shapes are shown."""
        return self._collisions_shown

    def show_transparent(self, shown: bool) -> None:
        """Make bodies half transparent, or opaque again, for markers inside of them."""
        with self._lock:
            self._transparent = shown
            self._fade()

    def show_visuals(self, shown: bool) -> None:
        """Show or hide the visual shapes."""
        with self._lock:
            self._visuals_shown = shown
            for node, _ in self._visuals:
                node.visible = shown

    def show_ground(self, shown: bool) -> None:
        """Show or hide the floor."""
        self._ground_shown = shown
        lighting.set_floor(self._server, self._floor, self._extent, shown)

    def _fade(self) -> None:
        transparent = self._frames_shown or self._transparent
        for node, opacity in self._visuals:
            wanted = min(opacity or 1.0, FADED_OPACITY) if transparent else opacity
            if node.opacity != wanted:
                node.opacity = wanted
            if node.cast_shadow == transparent:
                # Shadows ignore opacity: half transparent bodies would cast black ones onto themselves.
                node.cast_shadow = node.receive_shadow = not transparent

    def _add(
        self, items: Iterable[Drawable], kind: Kind | Literal["overlay"]
    ) -> list[tuple[Any, float | None]]:
        """Add shapes below the nodes of their frames; return their nodes and opacities."""
        added = []
        for number, part in enumerate(items):
            frame = self._node(part.frame)
            for k, (surface, color) in enumerate(_split_by_color(part)):
                opacity = None if color[3] >= 1.0 else color[3]
                node = self._server.scene.add_mesh_simple(
                    f"{frame.name}/{kind}{number}_{k}",
                    surface.vertices,
                    surface.faces,
                    color=tuple(round(255 * c) for c in color[:3]),
                    opacity=opacity,
                    side="front" if surface.closed else "double",
                    cast_shadow=kind == "visual",
                )
                added.append((node, opacity))
        return added

    def _node(self, frame: str) -> Any:
        """Return the scene node of a frame; added at its pose if there is none yet."""
        if frame not in self._nodes:
            k = self._kinematics.index(frame)
            # Slashes would make viser nest the nodes, and our poses are all relative to the world. The number
            # tells names apart that look the same.
            self._nodes[frame] = self._server.scene.add_frame(
                f"{ROOT}/{k} {frame.replace('/', '∕')}",
                show_axes=False,
                visible=frame not in self.unplaced,
                position=self.poses[k, :3, 3],
                wxyz=to_wxyz(self.poses[k : k + 1])[0],
            )
        return self._nodes[frame]

    def _move_frames(self) -> None:
        if self._axes is not None:
            self._axes.batched_wxyzs = to_wxyz(self.poses[self._shown]).astype(np.float32)
            self._axes.batched_positions = self.poses[self._shown, :3, 3].astype(np.float32)
        for k, label in zip(self._shown, self._labels, strict=False):
            label.position = self.poses[k, :3, 3]

    def _place_camera(self, visuals: list[Drawable]) -> None:
        at = {
            name: pose for name, pose in zip(self.names, self.poses, strict=True) if name not in self.unplaced
        }
        visuals = [part for part in visuals if part.frame in at]
        surfaces = TriangleSoup.from_drawables(visuals, at)
        self.length = choose_axis_length(surfaces.corners, at)
        if len(surfaces.corners):
            points = surfaces.corners.reshape(-1, 3)
            shown = find_extreme_points(points)
        else:
            points = np.array([pose[:3, 3] for pose in at.values()])
            shown = np.concatenate([points, points + 0.2])
        low, high = points.min(axis=0), points.max(axis=0)
        self._floor, self._extent = float(low[2]), float(np.linalg.norm(high - low))
        camera = self._camera
        if camera is None:
            camera = choose_camera(surfaces, weigh_drawables(self._model, visuals), at, ASPECT, FIELD_OF_VIEW)
            self._cameras.set_framing(camera, partial(reframe, camera, shown))
        start = self._server.initial_camera
        start.position, start.look_at = np.array(camera.position), np.array(camera.target)
        start.fov = camera.field_of_view
        away = np.subtract(camera.position, camera.target)
        lighting.set_lamp(self._server, float(np.arctan2(away[1], away[0])))


def _split_by_color(part: Drawable) -> list[tuple[TriangleMesh, tuple[float, ...]]]:
    """Split a surface into pieces of one colour each, because a mesh of the page has one colour."""
    surface = part.surface
    if surface.colors is None:
        return [(surface, part.color)]
    # Textures are reduced to a few dozen tones.
    tones, which = np.unique(np.round(surface.colors * 12.0) / 12.0, axis=0, return_inverse=True)
    pieces = []
    for k in range(len(tones)):
        chosen = np.flatnonzero(which.reshape(-1) == k)
        mean = surface.colors[chosen].mean(axis=0)
        used, faces = np.unique(surface.faces[chosen], return_inverse=True)
        piece = TriangleMesh(
            surface.vertices[used], faces.reshape(-1, 3), surface.normals[used], closed=surface.closed
        )
        pieces.append((piece, tuple(float(c) for c in mean)))
    return pieces
