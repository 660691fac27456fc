"""Figure of opened boxes over steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .unlocking_runs import LOCK_RULES, Rule, UnlockingRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FIGURE_SIZE = (9.0, 3.5)
_COLORS: Mapping[Rule, str] = {
    "and": "tab:blue",
    "product": "tab:orange",
    "none": "0.5",
    "undemanded": "tab:green",
}


def draw_boxes(canvas: Canvas, boxes: Mapping[tuple[Rule, int], Sequence[UnlockingRun]]) -> None:
    """Draw the share of opened boxes over the number of steps, a panel for each number of parts."""
    longest = 1.1 * max((run.steps for own in boxes.values() for run in own if run.done), default=1)
    parts = list(dict.fromkeys(count for _, count in boxes))
    panels = np.atleast_1d(canvas.subplots(1, len(parts), sharey=True))
    for axes, count in zip(panels, parts, strict=True):
        for rule, name in LOCK_RULES.items():
            own = boxes.get((rule, count))
            if not own:
                continue
            steps = sorted(run.steps for run in own if run.done)
            share = np.arange(len(steps) + 1) / len(own)
            axes.step(
                [0, *steps, longest], [*share, share[-1]], where="post", color=_COLORS[rule], label=name
            )
        axes.set_title(f"boxes of {count} parts")
        axes.set_xlabel("steps")
        axes.set_ylim(-0.02, 1.02)
    panels[0].set_ylabel("share opened")
    panels[0].legend(loc="center right", frameon=False)
