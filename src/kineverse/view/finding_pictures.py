"""Pictures of what the motion checks say: the part where it is worst, and faintly where it rests."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import numpy.typing as npt

from kineverse.errors import KineverseError
from kineverse.geometry.motion_checks.report import MotionFinding, MotionReport
from kineverse.model.model_view import ModelView

from .drawables import Drawable, Rgba, collect_drawables
from .pictures import draw_picture, write_png
from .poses import FramePoses, complete
from .rendering.auto_camera import choose_camera_for_parts

SIZE = (640, 480)  # [pixels]

PART: Rgba = (0.95, 0.42, 0.10, 1.0)  # colour of the part
OTHER: Rgba = (0.20, 0.45, 0.85, 1.0)  # colour of the other body that it is about
REST: Rgba = (0.95, 0.42, 0.10, 0.30)  # colour of the part where it rests
REMAINDER: Rgba = (0.78, 0.78, 0.76, 1.0)  # colour of all others

MARGIN = 0.25  # share of the picture around the part: what is near has to be seen


def draw_finding(model: ModelView, finding: MotionFinding) -> npt.NDArray[np.uint8] | None:
    """Return a picture of what the motion checks say, as (height, width, 3) bytes.

    The part is orange, what it enters blue, and all others grey; where the part rests, it is drawn faintly.

    Parameters
    ----------
    model
        The model that was checked.
    finding
        An entry of a :class:`kineverse.geometry.MotionReport`; it is drawn at its state.

    Returns
    -------
    numpy.ndarray or None
        None if none of its bodies can be drawn.

    Examples
    --------
    >>> block = kv.model.Shape(kv.model.Box((0.1, 0.1, 0.1)))
    >>> body = kv.model.Body(visuals=(block,), collisions=(block,))
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("wall", "world", kv.translation(0.3, 0, 0), body=body)
    ...     edit.apply(kv.Prismatic(name="drawer", parent="world", child="slide", lower=0, upper=0.6))
    ...     edit.add_frame("drawer", "slide", body=body)
    'frame wall'
    'joint drawer'
    'frame drawer'
    >>> report = kv.geometry.check_motion(model)
    >>> finding = [*report.findings, *report.suspects][0]
    >>> kv.view.draw_finding(model, finding).shape
    (480, 640, 3)
    """
    moving = {body for body in finding.bodies if body in model.bodies}
    items = collect_drawables(model, "collision" if _has_collisions(model, moving) else "visual")
    weights = np.array([1.0 if item.frame in moving else 0.0 for item in items])
    if not weights.any():
        return None
    frames = FramePoses(model)
    default = model.default_state()
    at = default.updated({model.symbol(name): value for name, value in finding.state.items()})
    rest, worst = (
        dict(zip(frames.names, frames.evaluate(complete(model, state)), strict=True))
        for state in (default, at)
    )
    camera = choose_camera_for_parts(items, [rest, worst], weights, SIZE[0] / SIZE[1], MARGIN)
    drawn = [
        _paint(item, PART if item.frame in moving else OTHER if item.frame == finding.against else REMAINDER)
        for item in items
    ]
    if finding.state:
        # The ghost hangs on the world, as its frame is elsewhere in this state.
        ghosts = [item for item in items if item.frame in moving]
        drawn += [
            replace(_paint(item, REST), frame="world", surface=item.surface.transform(rest[item.frame]))
            for item in ghosts
        ]
    return draw_picture(drawn, worst, SIZE, camera)


def save_finding_pictures(
    model: ModelView, report: MotionReport, folder: Path, before: str, taken: set[str]
) -> Iterator[tuple[str, str, Path]]:
    """Write a PNG of each finding and suspect that a picture can show.

    Names of files begin with ``before``, and are none of those taken. Each result is the name of the
    coordinate, the kind, and the file.
    """
    for one in report.all:
        for entry in (*one.findings, *one.suspects):
            try:
                pixels = draw_finding(model, entry)
            except KineverseError:  # a state in which a loop does not close
                pixels = None
            if pixels is None:
                continue
            name = _file_name(f"{before}{one.name or entry.bodies[0]}.{entry.kind}", taken)
            write_png(folder / name, pixels)
            yield one.name, entry.kind, folder / name


def _has_collisions(model: ModelView, part: Iterable[str]) -> bool:
    return any(model.bodies[body].collisions for body in part)


def _paint(item: Drawable, color: Rgba) -> Drawable:
    return replace(item, color=color, surface=replace(item.surface, colors=None))


def _file_name(name: str, taken: set[str]) -> str:
    """Return a name as that of a new file: without slashes and other signs."""
    stem = re.sub(r"[^\w.-]+", "_", name)
    number = next(k for k in count(1) if f"{stem}.{k}" not in taken)
    taken.add(f"{stem}.{number}")
    return f"{stem}.png" if number == 1 else f"{stem}.{number}.png"
