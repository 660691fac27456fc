"""The recordings as a picture: each from where most of it is seen, and the missed ones in large."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from kineverse.experiments.sturm.judging import Judged
from kineverse.view.identified import Looked, draw_along, draw_side

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

COLUMNS = 10
SMALL, LARGE = 1.5, 4.0
"""The edge of a picture of one recording, and of a missed one [inch]."""

RIGHT, WRONG = "0.25", "tab:red"


def size_of(judged: Sequence[Judged]) -> tuple[float, float]:
    """Return width and height of the whole [inch]."""
    missed = sum(not j.right for j in judged)
    return COLUMNS * SMALL, SMALL * math.ceil(len(judged) / COLUMNS) + LARGE * missed + 0.5


def draw_recordings(canvas: Canvas, judged: Sequence[Judged]) -> None:
    """Draw all recordings with what they were taken for, and below both explanations of those missed."""
    missed = [j for j in judged if not j.right]
    rows = math.ceil(len(judged) / COLUMNS)
    heights = [SMALL * rows, *[LARGE] * len(missed)]
    above, *below = canvas.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    axes = above.subplots(rows, COLUMNS, squeeze=False).ravel()
    for place, one in zip(axes, judged, strict=False):
        _draw_small(place, one)
    for place in axes[len(judged) :]:
        place.axis("off")
    for part, one in zip(below, missed, strict=True):
        families = (one.recording.label, one.found.best.family)
        for place, family, shown in zip(
            part.subplots(1, 4), (families[0], *families, families[1]), (0, 1, 0, 1), strict=True
        ):
            looked = Looked.at(one.found[family], one.recording.poses)
            (draw_along, draw_side)[shown](place, looked)
            place.set_title(
                f"{family} {one.found[family].probability:.2g}: {place.get_title()}", fontsize="small"
            )
        part.suptitle(f"missed: {one.recording.name}", color=WRONG)


def _draw_small(axes: Axes, one: Judged) -> None:
    looked = Looked.at(one.found.best, one.recording.poses)
    right, up = (2, 0) if one.found.best.family == "prismatic" else (0, 1)
    axes.plot(looked.seen[:, right], looked.seen[:, up], ".", markersize=2, color="tab:orange")
    axes.plot(looked.way[:, right], looked.way[:, up], linewidth=0.8, color="tab:blue")
    if looked.turns:
        axes.plot(0.0, 0.0, "+", color="tab:blue", markersize=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xticks([])
    axes.set_yticks([])
    color = RIGHT if one.right else WRONG
    name = "\n".join(one.recording.name.split("/")[-2:])
    axes.set_title(f"{name}: {one.called}", fontsize=6, color=color)
    for spine in axes.spines.values():
        spine.set_color(color)
