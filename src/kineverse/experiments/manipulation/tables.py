"""Tables and figures of trials."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from kineverse.experiments.report import Figure, ReportTable

from .trials import FAILURES, RobotSummary, Trial, as_json, summarize_robots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Rows = tuple[tuple[float | str, ...], ...]

_LONGEST_REASON = 90
_MEASURES = (
    ("limits", "limits violated"),
    ("penetration", "penetration [mm]"),
    ("grasp_error", "grasp error [mm]"),
    ("contact_losses", "contact losses"),
)


def make_success_table(trials: Sequence[Trial], title: str = "Success") -> ReportTable:
    """Return the table of success by robot."""
    rows: list[tuple[float | str, ...]] = []
    for one in summarize_robots(trials):
        failed = Counter(t.failure for t in trials if t.robot == one.robot and not t.done)
        rows.append(
            (
                one.robot,
                one.objects,
                one.done,
                one.excused,
                f"{100 * one.rate:.1f} %",
                *(failed[name] for name in FAILURES if name),
            )
        )
    head = ("robot", "objects", "done", "out of reach", "of those in reach", *(f for f in FAILURES if f))
    return ReportTable(title, head, tuple(rows))


def make_time_table(trials: Sequence[Trial], title: str = "Times of a control step, CPU [ms]") -> ReportTable:
    """Return the table of the times of control steps by robot."""
    rows: Rows = tuple((one.robot, one.steps.count, *_milliseconds(one)) for one in summarize_robots(trials))
    return ReportTable(title, ("robot", "steps", "mean", "sd", "p99", "worst", "wall mean"), rows)


def make_quality_table(trials: Sequence[Trial]) -> ReportTable:
    """Return the table of the worst measures by robot, of those that the trials have."""
    shown = [(key, title) for key, title in _MEASURES if any(key in t.measures for t in trials)]
    rows: list[tuple[float | str, ...]] = []
    for robot in dict.fromkeys(t.robot for t in trials):
        own = [t.measures for t in trials if t.robot == robot]
        worst = (max((float(m[key]) for m in own if key in m), default=math.nan) for key, _ in shown)
        rows.append((robot, *(f"{number:.3g}" for number in worst)))
    return ReportTable("Worst of all trials", ("robot", *(title for _, title in shown)), tuple(rows))


def make_failure_table(trials: Iterable[Trial]) -> ReportTable:
    """Return the table of all failures."""
    rows = tuple(
        (t.case, t.robot, t.what, t.skill, t.failure, shorten_reason(t.reason)) for t in trials if not t.done
    )
    return ReportTable("Failures", ("case", "robot", "object", "skill", "class", "reason"), rows)


def make_trial_numbers(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return success, failures and all trials as JSON data."""
    return {
        "robots": {
            one.robot: {
                "objects": one.objects,
                "done": one.done,
                "out_of_reach": one.excused,
                "rate": as_json(one.rate),
                "step_ms": as_json(
                    dict(zip(("mean", "sd", "p99", "worst", "wall"), _milliseconds(one), strict=True))
                ),
            }
            for one in summarize_robots(trials)
        },
        "failures": [t.as_data() for t in trials if not t.done],
        "trials": [t.as_data() for t in trials],
    }


def make_success_figure(trials: Sequence[Trial], measure: str, label: str) -> Figure:
    """Return the figure of success over a measure, one row of points for each robot."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        robots = list(dict.fromkeys(t.robot for t in trials))
        colors = {"": "0.7", "collision": "tab:red", "reach": "tab:blue", "time": "tab:orange", "other": "k"}
        for failure, color in colors.items():
            own = [t for t in trials if t.failure == failure and measure in t.measures]
            # Points of one robot are spread by skill, so that opening and closing do not hide each other.
            y = [robots.index(t.robot) + (0.12 if t.skill == "close" else -0.12) for t in own]
            marker, size = ("|", 60) if not failure else ("o", 30)
            axes.scatter(
                [t.measures[measure] for t in own], y, c=color, s=size, marker=marker, label=failure or "done"
            )
        axes.set_yticks(range(len(robots)), robots)
        axes.set_xlabel(label)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)

    return Figure(draw, (9.0, 3.5))


def shorten_reason(reason: str) -> str:
    """Return a reason on one line of limited length."""
    line = " ".join(reason.split())
    return line if len(line) <= _LONGEST_REASON else f"{line[: _LONGEST_REASON - 1]}…"


def _milliseconds(one: RobotSummary) -> tuple[float, ...]:
    steps = one.steps
    return tuple(round(v, 4) for v in (steps.mean, steps.deviation, steps.p99, steps.worst, steps.wall))
