"""Clips: moving pictures of a model without a browser, as animated WebP or GIF files."""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.errors import MissingDependencyError, ShapeError
from kineverse.formats.files import replace_file
from kineverse.model.kinematics import infer_units
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike

from .animation import PERIOD, RangeAnimation, select_animated
from .drawables import Drawable, collect_drawables
from .pictures import CLIP_SUFFIXES, draw_picture
from .poses import FramePoses, complete
from .rendering.auto_camera import choose_camera_for_parts, find_extreme_points, reframe
from .rendering.camera import Camera
from .rendering.triangle_mesh import Floats
from .sliders import Ranges

SIZE = (640, 480)  # [pixels]
RATE = 12.5  # pictures per second

_QUALITY = 80  # of WebP, of 100
_SAMPLES = 3  # number of states in which the camera is chosen
_STILL = 1e-6  # largest change of a pose, in any entry, of what does not move [m], [1]


class ClipMoment(NamedTuple):
    """Contents of one picture of a clip."""

    state: StateLike  # the default state for what it lacks [m], [rad]
    overlay: Sequence[Drawable] = ()  # further parts on frames of the model
    over: Sequence[Drawable] = ()  # further parts that are drawn over the others


def is_clip_name(path: str | Path) -> bool:
    """Return True if the suffix of a file is that of a clip."""
    return Path(path).suffix.lower() in CLIP_SUFFIXES


def draw_clip(
    model: ModelView,
    moments: Sequence[ClipMoment],
    size: tuple[int, int] = SIZE,
    camera: Camera | None = None,
    collisions: bool = False,
    decomposed: bool = False,
) -> Iterator[npt.NDArray[np.uint8]]:
    """Return pictures of a model, (height, width, 3) bytes each, from one camera and in one light.

    Without a camera, one is chosen that has all that moves in view. Collisions are as those of
    :func:`kineverse.view.picture`.
    """
    items = collect_drawables(model, "collision" if collisions else "visual", decomposed)
    frames = FramePoses(model)
    poses = np.array([frames.evaluate(complete(model, moment.state)) for moment in moments])
    outlines = {number: find_extreme_points(item.surface.vertices) for number, item in enumerate(items)}
    places = [dict(zip(frames.names, one, strict=True)) for one in poses]
    moves = np.array([_moves(poses[:, frames.index(item.frame)]) for item in items])
    if camera is None:
        chosen = moves if moves.any() else np.full(len(items), True)
        camera = _choose_camera(items, places, chosen, outlines, size[0] / size[1])
    around = _find_points(items, places, range(len(items)), outlines)
    for moment, place in zip(moments, places, strict=True):
        yield draw_picture([*items, *moment.overlay], place, size, camera, moment.over, around)


def sweep_ranges(
    model: ModelView, state: StateLike | None = None, held: Container[str] = ()
) -> list[ClipMoment]:
    """Return the moments of a motion of all coordinates through their ranges, as the page animates them.

    Those of the names ``held`` stay at the values of the state. The end meets the beginning. The list is
    empty if nothing can move.
    """
    values = complete(model, state)
    ranges = Ranges(model)
    units = infer_units(model, values, ranges.names)
    limits = {name: pair for name, pair in ranges.limits_at(values).items() if name not in held}
    found = select_animated(model, limits, (), values, units)
    motion = RangeAnimation(values, found, -PERIOD)  # it has faded in
    times = np.arange(0.0, PERIOD, 1.0 / RATE).tolist()
    return [ClipMoment(values | motion.values_at(time)) for time in times] if found else []


def clip_times(duration: float, speed: float = 1.0) -> list[float]:
    """Return the times [s] of the pictures of a motion of a duration [s], shown ``speed`` times as fast."""
    times: list[float] = np.linspace(0.0, duration, math.ceil(duration / speed * RATE) + 1).tolist()
    return times


def encode_clip(
    pictures: Sequence[npt.NDArray[np.uint8]], suffix: str, rate: float = RATE, **options: Any
) -> bytes:
    """Return the bytes of an animated WebP (suffix ``.webp``) or GIF (``.gif``) that is repeated for ever.

    Pictures are (height, width, 3) bytes, all of one size, ``rate`` of them a second. Options are those of
    Pillow's writer, such as ``quality``. Without Pillow, this is a :class:`MissingDependencyError`.
    """
    try:
        pillow = importlib.import_module("PIL.Image")
    except ImportError:
        raise MissingDependencyError(f"Clips need Pillow: {install_command('view')}") from None
    if len({image.shape for image in pictures}) != 1:
        raise ShapeError("a clip is one or more pictures of one size")
    images = [pillow.fromarray(image) for image in pictures]
    defaults: dict[str, Any]
    if suffix.lower() == ".gif":
        # One palette for all pictures: what stands still keeps its colours, and need not be written again.
        some = np.concatenate(pictures[:: max(len(pictures) // 8, 1)])
        palette = pillow.fromarray(some).quantize(256, dither=pillow.Dither.NONE)
        images = [image.quantize(palette=palette, dither=pillow.Dither.NONE) for image in images]
        kind, defaults = "GIF", {"optimize": False}
    else:
        kind, defaults = "WEBP", {"quality": _QUALITY, "method": 6}
    file = io.BytesIO()
    timing = {"duration": round(1000 / rate), "loop": 0}
    images[0].save(file, kind, save_all=True, append_images=images[1:], **timing, **(defaults | options))
    return file.getvalue()


def write_clip(path: str | Path, pictures: Sequence[npt.NDArray[np.uint8]], rate: float = RATE) -> None:
    """Write a clip to a file, in the format of its suffix."""
    replace_file(Path(path), encode_clip(pictures, Path(path).suffix, rate))


def _moves(poses: Floats) -> bool:
    return bool(np.ptp(poses, axis=0).max() > _STILL)


def _choose_camera(
    items: Sequence[Drawable],
    places: Sequence[Mapping[str, Floats]],
    shown: npt.NDArray[np.bool_],
    outlines: Mapping[int, Floats],
    aspect: float,
) -> Camera:
    """Return the camera that has some parts in view all the time, and shows most of them."""
    some = [places[k] for k in np.linspace(0, len(places) - 1, _SAMPLES).astype(int)]
    camera = choose_camera_for_parts(items, some, shown.astype(float), aspect)
    return reframe(camera, _find_points(items, places, np.flatnonzero(shown).tolist(), outlines), aspect)


def _find_points(
    items: Sequence[Drawable],
    places: Sequence[Mapping[str, Floats]],
    chosen: Sequence[int],
    outlines: Mapping[int, Floats],
) -> Floats:
    """Return the points (N, 3) of some parts at all times [m]."""
    points = [np.zeros((0, 3))]
    for number in chosen:
        frame = items[number].frame
        poses = np.array([place[frame] for place in places])
        points += [
            outlines[number] @ pose[:3, :3].T + pose[:3, 3] for pose in poses[: None if _moves(poses) else 1]
        ]
    return np.concatenate(points)
