"""Pictures of a model without a browser, a window or a graphics card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import ValueRejectedError
from kineverse.model.view import ModelView
from kineverse.view.axes import triad
from kineverse.view.camera import Camera
from kineverse.view.light import Lamp, shade, to_display, to_linear
from kineverse.view.marks import Marks, mark_parts
from kineverse.view.near import Near
from kineverse.view.parts import Part, parts
from kineverse.view.png import write_png
from kineverse.view.poses import Poses, complete
from kineverse.view.raster import Projection, visible
from kineverse.view.surfaces import Surfaces
from kineverse.view.surroundings import draw_ground, outlines
from kineverse.view.triangles import Floats, Integers, Singles, dot
from kineverse.view.viewpoint import automatic, importance

SAMPLES = 2
"""Pixels computed along each edge of one that is shown."""

BACKDROP = (np.array([0.93, 0.945, 0.96]), np.array([0.70, 0.745, 0.80]))
"""Display colours of the background below and above."""

ARROW = 0.07
"""The length of an arrow where bodies touch, as a part of the height of the picture."""

LARGEST = 64_000_000
"""Most pixels of one picture, computed ones included."""


def picture(
    model: ModelView,
    state: Mapping[Any, float] | None = None,
    size: tuple[int, int] = (960, 720),
    camera: Camera | None = None,
    frames: bool = False,
    collisions: bool = False,
    near: float | None = None,
    decomposed: bool = False,
) -> npt.NDArray[np.uint8]:
    """Return a picture of a model as (height, width, 3) bytes.

    Parameters
    ----------
    model
        What to draw.
    state
        Values by symbol or name [m], [rad]; the default state for the others.
    size
        Width and height in pixels.
    camera
        Where to stand; None for a place from which the model, and as much as possible of what moves, is seen.
    frames
        Whether to draw the axes of all frames (x red, y green, z blue), also through the bodies.
    collisions
        Whether to draw the collision shapes instead of the visual ones; of a body without any, hulls of what
        is seen of it.
    near
        Within what distance to draw lines between bodies that are near to each other [m], green to red by the
        distance, with arrows where they touch; through the bodies. None for no lines.
    decomposed
        Whether collision shapes and lines are those of the hulls that meshes were decomposed into.

    Raises
    ------
    MissingExtraError
        If lines are wanted and the extra ``geometry`` is not installed.
    UnknownNameError
        If the state names a symbol that the model does not have.
    ValueRejectedError
        If the size is not that of a picture.
    """
    width, height = size
    if width < 1 or height < 1 or width * height * SAMPLES**2 > LARGEST:
        raise ValueRejectedError(f"a picture of {width} x {height} pixels cannot be made")
    poses, values = Poses(model), complete(model, state)
    at = dict(zip(poses.names, poses.at(values), strict=True))
    found = None if near is None else Near(model, decomposed).at(values, near)
    items = parts(model, "collision" if collisions else "visual", decomposed)
    scene = Surfaces.of(items, at)
    if camera is None:
        camera = automatic(scene, importance(model, items), at, width / height)
    over: list[Part] = []
    if frames or not len(scene.corners):
        over += triad(model, scene.corners, at)
    if found is not None:
        length = ARROW * camera.height
        over += mark_parts(Marks.of(found, length), length)
    return _drawn(scene, Surfaces.of(over, at), size, camera)


def drawn(
    items: Sequence[Part],
    poses: Mapping[str, Floats],
    size: tuple[int, int],
    camera: Camera,
    over: Sequence[Part] = (),
) -> npt.NDArray[np.uint8]:
    """Return a picture of any parts as (height, width, 3) bytes.

    Parameters
    ----------
    items
        What to draw, on a floor.
    poses
        Where the frames of all parts are, 4×4.
    size
        Width and height in pixels.
    camera
        Where to stand.
    over
        What is drawn over that, also where it is behind.
    """
    return _drawn(Surfaces.of(items, poses), Surfaces.of(over, poses), size, camera)


def _drawn(scene: Surfaces, over: Surfaces, size: tuple[int, int], camera: Camera) -> npt.NDArray[np.uint8]:
    projection = Projection.of(camera, size[0] * SAMPLES, size[1] * SAMPLES)
    image = _render(scene, projection, camera)
    _overlay(image, over, projection)
    return _shrunk(image, SAMPLES)


def save(
    path: str | Path, model: ModelView, state: Mapping[Any, float] | None = None, **options: Any
) -> None:
    """Write :func:`picture` of a model, with the same options, to a PNG file."""
    write_png(path, picture(model, state, **options))


def _render(scene: Surfaces, projection: Projection, camera: Camera) -> Singles:
    """Return (height, width, 3) display values of a scene on its ground."""
    image = _backdrop(projection)
    if len(scene.corners):
        seen, near = visible(projection, scene.corners, scene.closed, scene.colors[:, 3])
        away = np.subtract(camera.position, camera.target)
        lamp = Lamp.over(scene.corners, float(np.arctan2(away[1], away[0])) + 0.6, 0.85)
        covered = np.flatnonzero(seen >= 0)
        if len(covered):
            triangle = seen[covered]
            points, normals = _surface_points(scene, projection, covered, triangle)
            colors = to_linear(scene.colors[:, :3]).astype(np.float32)[triangle]
            display = to_display(shade(colors, normals, lamp, lamp.reaches(points, normals, covered)))
            display *= outlines(scene.group[triangle], normals, near, covered, projection)[:, None]
            image[covered] = display
        draw_ground(image, np.flatnonzero(seen < 0), scene.corners, projection, lamp)
    return image.reshape(projection.height, projection.width, 3)


def _backdrop(projection: Projection) -> Singles:
    rows = np.linspace(1.0, 0.0, projection.height)[:, None]
    below, above = BACKDROP
    column = (below + (above - below) * rows**1.5).astype(np.float32)
    return np.repeat(column, projection.width, axis=0)


def _surface_points(
    scene: Surfaces, projection: Projection, pixel: Integers, triangle: Integers
) -> tuple[Singles, Singles]:
    """Return the points (N, 3) and normals (N, 3), toward the camera, that pixels look at."""
    rays = projection.rays(pixel)
    # Seen from the camera all coordinates are small, and single precision is good for a hair.
    a = scene.corners[:, 0] - projection.origin
    u, v = scene.corners[:, 1] - scene.corners[:, 0], scene.corners[:, 2] - scene.corners[:, 0]
    flat = np.cross(u, v)
    square = np.maximum(dot(flat, flat), 1e-300)
    reach = dot(flat, a)
    # A ray r meets the plane n·p = d at p = r d / (n·r); planes through the camera are never seen.
    edge_on = np.abs(reach) < 1e-12 * np.sqrt(square)
    planes = np.where(edge_on[:, None], 0.0, flat / np.where(edge_on, 1.0, reach)[:, None])
    along = dot(rays, _single(planes)[triangle])
    points = rays / np.where(along == 0.0, np.float32(1.0), along)[:, None]
    # Barycentric coordinates are linear in the point: w_b = (v x n)·(p - a) / n², w_c = (n x u)·(p - a) / n².
    to_b, to_c = np.cross(v, flat) / square[:, None], np.cross(flat, u) / square[:, None]
    b = dot(_single(to_b)[triangle], points) - _single(dot(to_b, a))[triangle]
    c = dot(_single(to_c)[triangle], points) - _single(dot(to_c, a))[triangle]
    b, c = np.clip(b, 0.0, 1.0)[:, None], np.clip(c, 0.0, 1.0)[:, None]
    n = _single(scene.normals)
    normals = n[triangle, 0]
    normals += (n[:, 1] - n[:, 0])[triangle] * b
    normals += (n[:, 2] - n[:, 0])[triangle] * c
    normals /= np.sqrt(np.maximum(dot(normals, normals), 1e-12))[:, None]
    # An open surface seen from behind is lit like one seen from the front.
    normals *= np.where(dot(normals, rays) > 0.0, np.float32(-1.0), np.float32(1.0))[:, None]
    return np.asarray(points + _single(projection.origin), dtype=np.float32), normals


def _single(values: Floats) -> Singles:
    return values.astype(np.float32)


def _shrunk(image: Singles, samples: int) -> npt.NDArray[np.uint8]:
    """Return the mean of samples × samples pixels as bytes."""
    total = sum(image[i::samples, j::samples] for i in range(samples) for j in range(samples))
    return np.asarray(np.round(total * (255.0 / samples**2)), dtype=np.uint8)


def _overlay(image: Singles, scene: Surfaces, projection: Projection) -> None:
    """Draw axes over everything, faintly shaded, so that frames inside of bodies are seen too."""
    if not len(scene.corners):
        return
    seen, _ = visible(projection, scene.corners, scene.closed, scene.colors[:, 3])
    pixel = np.flatnonzero(seen >= 0)
    flat = image.reshape(-1, 3)
    facing = np.abs(scene.normals[seen[pixel], 0] @ projection.axes[2])
    color = scene.colors[seen[pixel], :3] * (0.75 + 0.25 * facing)[:, None]
    flat[pixel] = 0.1 * flat[pixel] + 0.9 * color
