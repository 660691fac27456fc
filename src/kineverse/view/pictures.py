"""Pictures of a model without a browser, and PNG files."""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError, InvalidValueError, ShapeError
from kineverse.formats.files import replace_file
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike

from .drawables import Drawable, collect_drawables, create_axes
from .poses import FramePoses, complete
from .proximity import ProximityMarkers, ProximityQuery, create_marker_drawables
from .rendering.auto_camera import choose_camera, weigh_drawables
from .rendering.camera import Camera
from .rendering.lighting import (
    DirectionalLight,
    compute_outlines,
    draw_background,
    draw_ground,
    shade,
    to_display,
    to_linear,
)
from .rendering.rasterizer import Projection, TriangleSoup, rasterize
from .rendering.triangle_mesh import Floats, Integers, Singles, dot_rows


def write_png(path: str | Path, pixels: npt.NDArray[np.uint8]) -> None:
    """Write an image of (height, width, 3) or (height, width, 4) bytes to a PNG file."""
    check_png_name(path)
    replace_file(Path(path), encode_png(pixels))


def check_png_name(path: str | Path) -> None:
    """Check that the name of a file ends in .png, or has no suffix, and that its folder exists."""
    suffix = Path(path).suffix
    if suffix.lower() not in ("", ".png"):
        advice = " 'kineverse view' writes clips." if suffix.lower() in CLIP_SUFFIXES else ""
        png = Path(path).with_suffix(".png")
        raise FormatError(f"Pictures are written as .png, not {suffix}: '{png}'.{advice}")
    if not Path(path).parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(Path(path).parent))


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return the bytes of a PNG file (ISO/IEC 15948: colour type 2 or 6, no interlace)."""
    image = np.asarray(pixels)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8 or not image.size:
        raise ShapeError(f"an image is (height, width, 3 or 4) of uint8, not {image.shape} of {image.dtype}")
    height, width, channels = image.shape
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    # Filter 2, the difference to the row above, shrinks pictures of rooms to a third.
    rows = image.reshape(height, width * channels)
    lines = np.empty((height, 1 + width * channels), dtype=np.uint8)
    lines[:, 0] = 2
    lines[0, 1:] = rows[0]
    lines[1:, 1:] = rows[1:] - rows[:-1]
    body = zlib.compress(lines.tobytes(), 6)
    chunks = _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


CLIP_SUFFIXES = (".webp", ".gif")  # of files of clips
SAMPLES = 2  # number of computed pixels along each edge of a final one
ARROW = 0.07  # length of arrows at contacts, as a fraction of the height of the picture
LARGEST = 64_000_000  # most pixels of one picture, computed ones included


def picture(
    model: ModelView,
    state: StateLike | None = None,
    size: tuple[int, int] = (960, 720),
    camera: Camera | None = None,
    frames: bool = False,
    collisions: bool = False,
    near: float | None = None,
    decomposed: bool = False,
    overlay: Sequence[Drawable] = (),
    over: Sequence[Drawable] = (),
) -> npt.NDArray[np.uint8]:
    """Return a picture of a model as (height, width, 3) bytes.

    Parameters
    ----------
    state
        Values by symbol or name [m], [rad]; the default state for the others.
    size
        Width and height in pixels.
    camera
        The camera; None for one that shows the model and as much as possible of its moving parts.
    frames
        True to draw the axes of all frames (x red, y green, z blue), also through the bodies.
    collisions
        True to draw the collision shapes instead of the visual ones; of a body without any, the hulls of
        its visual shapes.
    near
        The distance within which to draw lines between bodies [m], green to red by the distance, with
        arrows at contacts; through the bodies. None for no lines.
    decomposed
        True to use the hulls of decomposed meshes for collision shapes and lines.
    overlay
        Further parts on frames of the model, such as spheres, as transparent as their colours.
    over
        Further parts that are drawn over the others, even if they are behind them, such as arrows.

    Raises
    ------
    MissingDependencyError
        If lines are wanted and the extra ``geometry`` is not installed.
    InvalidValueError
        If the size is not that of a picture.

    Examples
    --------
    >>> pixels = kv.view.picture(kv.load("shelf_door"), {"shelf_door/door": 0.8}, size=(64, 48))
    >>> pixels.shape, pixels.dtype
    ((48, 64, 3), dtype('uint8'))
    """
    width, height = size
    if width < 1 or height < 1 or width * height * SAMPLES**2 > LARGEST:
        raise InvalidValueError(f"a picture of {width} x {height} pixels cannot be made")
    poses, values = FramePoses(model), complete(model, state)
    matrices = poses.evaluate(values)
    at = dict(zip(poses.names, matrices, strict=True))
    for frame in poses.unplaced(matrices):  # Its bodies are not drawn, as on the page.
        del at[frame]
    found = None if near is None else ProximityQuery(model, decomposed).evaluate(values, near)
    items = collect_drawables(model, "collision" if collisions else "visual", decomposed)
    items, front = ([part for part in parts if part.frame in at] for parts in ([*items, *overlay], over))
    scene = TriangleSoup.from_drawables(items, at)
    if camera is None:
        camera = choose_camera(scene, weigh_drawables(model, items), at, width / height)
    if frames or not len(scene.corners):
        front += create_axes(model, scene.corners, at)
    if found is not None:
        length = ARROW * camera.height
        front += create_marker_drawables(ProximityMarkers.from_result(found, length), length)
    return _draw(scene, TriangleSoup.from_drawables(front, at), size, camera)


def draw_picture(
    items: Sequence[Drawable],
    poses: Mapping[str, Floats],
    size: tuple[int, int],
    camera: Camera,
    over: Sequence[Drawable] = (),
    around: Floats | None = None,
) -> npt.NDArray[np.uint8]:
    """Return a picture of any parts as (height, width, 3) bytes.

    Floor and shadows are those of a scene that fills the points ``around`` (N, 3) [m]; None for the parts.
    """
    scene, overlay = (TriangleSoup.from_drawables(parts, poses) for parts in (items, over))
    return _draw(scene, overlay, size, camera, around)


def _draw(
    scene: TriangleSoup,
    over: TriangleSoup,
    size: tuple[int, int],
    camera: Camera,
    around: Floats | None = None,
) -> npt.NDArray[np.uint8]:
    projection = Projection.from_camera(camera, size[0] * SAMPLES, size[1] * SAMPLES)
    image = _render(scene, projection, camera, around)
    _overlay(image, over, projection)
    return _downsample(image, SAMPLES)


def join_pictures(rows: Sequence[Sequence[npt.NDArray[np.uint8]]], gap: int = 4) -> npt.NDArray[np.uint8]:
    """Return rows of pictures of one size as one, with white gaps [pixels] between them."""
    shapes = {image.shape for row in rows for image in row}
    if len(shapes) != 1:
        raise ShapeError(f"pictures of one size can be joined, not of {sorted(shapes)}")
    height, width, channels = shapes.pop()
    columns = max(map(len, rows))
    size = len(rows) * (height + gap) - gap, columns * (width + gap) - gap, channels
    joined = np.full(size, 255, dtype=np.uint8)
    for i, row in enumerate(rows):
        for j, image in enumerate(row):
            y, x = i * (height + gap), j * (width + gap)
            joined[y : y + height, x : x + width] = image
    return joined


def save_picture(path: str | Path, model: ModelView, state: StateLike | None = None, **options: Any) -> None:
    """Write :func:`picture` of a model, with the same options, to a PNG file.

    Examples
    --------
    >>> kv.view.save_picture("shelf.png", kv.load("shelf_door"), {"shelf_door/door": 0.8}, size=(64, 48))
    """
    write_png(path, picture(model, state, **options))


def _render(
    scene: TriangleSoup, projection: Projection, camera: Camera, around: Floats | None = None
) -> Singles:
    """Return (height, width, 3) display values of a scene on its ground."""
    image = draw_background(projection)
    if len(scene.corners):
        extent = scene.corners.reshape(-1, 3) if around is None else around
        seen, near = rasterize(projection, scene.corners, scene.closed, scene.colors[:, 3])
        away = np.subtract(camera.position, camera.target)
        beside = float(np.arctan2(away[1], away[0])) + 0.6
        lamp = DirectionalLight.from_direction(scene.corners, beside, 0.85, extent)
        covered = np.flatnonzero(seen >= 0)
        if len(covered):
            triangle = seen[covered]
            points, normals = _surface_points(scene, projection, covered, triangle)
            colors = to_linear(scene.colors[:, :3]).astype(np.float32)[triangle]
            display = to_display(shade(colors, normals, lamp, lamp.lit_fraction(points, normals, covered)))
            display *= compute_outlines(scene.group[triangle], normals, near, covered, projection)[:, None]
            image[covered] = display
        draw_ground(image, np.flatnonzero(seen < 0), extent, projection, lamp)
    return image.reshape(projection.height, projection.width, 3)


def _surface_points(
    scene: TriangleSoup, projection: Projection, pixel: Integers, triangle: Integers
) -> tuple[Singles, Singles]:
    """Return the points (N, 3) and normals (N, 3), toward the camera, that pixels show."""
    rays = projection.pixel_rays(pixel)
    # In camera coordinates all numbers are small, and single precision is exact to a tenth of a millimetre.
    a = scene.corners[:, 0] - projection.origin
    u, v = scene.corners[:, 1] - scene.corners[:, 0], scene.corners[:, 2] - scene.corners[:, 0]
    flat = np.cross(u, v)
    square = np.maximum(dot_rows(flat, flat), 1e-300)
    reach = dot_rows(flat, a)
    # A ray r meets the plane n·p = d at p = r d / (n·r); planes through the camera are never visible.
    edge_on = np.abs(reach) < 1e-12 * np.sqrt(square)
    planes = np.where(edge_on[:, None], 0.0, flat / np.where(edge_on, 1.0, reach)[:, None])
    along = dot_rows(rays, _to_single(planes)[triangle])
    points = rays / np.where(along == 0.0, np.float32(1.0), along)[:, None]
    # Barycentric coordinates are linear in the point: w_b = (v x n)·(p - a) / n², w_c = (n x u)·(p - a) / n².
    to_b, to_c = np.cross(v, flat) / square[:, None], np.cross(flat, u) / square[:, None]
    b = dot_rows(_to_single(to_b)[triangle], points) - _to_single(dot_rows(to_b, a))[triangle]
    c = dot_rows(_to_single(to_c)[triangle], points) - _to_single(dot_rows(to_c, a))[triangle]
    b, c = np.clip(b, 0.0, 1.0)[:, None], np.clip(c, 0.0, 1.0)[:, None]
    n = _to_single(scene.normals)
    normals = n[triangle, 0]
    normals += (n[:, 1] - n[:, 0])[triangle] * b
    normals += (n[:, 2] - n[:, 0])[triangle] * c
    normals /= np.sqrt(np.maximum(dot_rows(normals, normals), 1e-12))[:, None]
    # The back of an open surface is lit like its front.
    normals *= np.where(dot_rows(normals, rays) > 0.0, np.float32(-1.0), np.float32(1.0))[:, None]
    return np.asarray(points + _to_single(projection.origin), dtype=np.float32), normals


def _to_single(values: Floats) -> Singles:
    return values.astype(np.float32)


def _downsample(image: Singles, samples: int) -> npt.NDArray[np.uint8]:
    """Return the mean of samples × samples pixels as bytes."""
    total = sum(image[i::samples, j::samples] for i in range(samples) for j in range(samples))
    return np.asarray(np.round(total * (255.0 / samples**2)), dtype=np.uint8)


def _overlay(image: Singles, scene: TriangleSoup, projection: Projection) -> None:
    """Draw parts over everything, faintly shaded, so that frames inside of bodies are visible."""
    if not len(scene.corners):
        return
    seen, _ = rasterize(projection, scene.corners, scene.closed, scene.colors[:, 3])
    pixel = np.flatnonzero(seen >= 0)
    flat = image.reshape(-1, 3)
    facing = np.abs(scene.normals[seen[pixel], 0] @ projection.axes[2])
    color = scene.colors[seen[pixel], :3] * (0.75 + 0.25 * facing)[:, None]
    flat[pixel] = 0.1 * flat[pixel] + 0.9 * color
