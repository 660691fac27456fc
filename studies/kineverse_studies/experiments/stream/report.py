"""Report of the streams: tables, numbers and figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.view.plots import Figure
from kineverse_studies.experiments.report import Report, ReportTable

from .monitoring import MonitoringRow
from .observations import ORIENTATION, POSITION
from .tracking import TrackedStream, TrackingSummary, summarize_trackers

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FIGURE_SIZE = (11.0, 8.0)


def make_report(tracked: Mapping[str, Sequence[TrackedStream]], monitored: Sequence[MonitoringRow]) -> Report:
    """Return the report of trackers by name, and of the monitor."""
    summaries = summarize_trackers(tracked)
    count = len(next(iter(tracked.values())))
    return Report(
        name="stream",
        title=(
            f"A door that a hand moves, seen by two markers at 30 Hz: {1000 * POSITION:.0f} mm, "
            f"{math.degrees(ORIENTATION):.1f}°, correlated errors, dropouts, outliers"
        ),
        tables=(_tracking_table(summaries, count), monitoring_table(monitored)),
        numbers={
            "tracking": [_numbers(asdict(summary)) for summary in summaries],
            "monitoring": [_numbers(asdict(row)) for row in monitored],
        },
        figure=Figure(lambda canvas: draw_stream(canvas, tracked), FIGURE_SIZE),
    )


def _numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }


def _tracking_table(summaries: Sequence[TrackingSummary], count: int) -> ReportTable:
    return ReportTable(
        f"Tracking, {count} streams of a minute",
        (
            "process",
            "RMSE moving [mrad]",
            "RMSE at rest [mrad]",
            "NEES",
            "worst stream",
            "silently lost [s]",
            "lost [%]",
            "update [ms CPU]",
            "99 of 100 within",
        ),
        tuple(
            (
                summary.name,
                f"{1000 * summary.moving:.2f}",
                f"{1000 * summary.resting:.2f}",
                f"{summary.nees:.2f}",
                f"{summary.worst_nees:.2f}",
                f"{summary.silently_lost:.2f}",
                f"{100 * summary.lost:.1f}",
                _milliseconds(summary.mean_time),
                _milliseconds(summary.high_time),
            )
            for summary in summaries
        ),
    )


def _milliseconds(seconds: float) -> str:
    return "-" if math.isnan(seconds) else f"{1000 * seconds:.2f}"


def monitoring_table(rows: Sequence[MonitoringRow]) -> ReportTable:
    """Return the table of the monitor."""
    return ReportTable(
        "Monitor of the model's plausibility",
        (
            "door",
            "streams",
            "alarms",
            "looks from 45° to the alarm",
            "worst",
            "look [ms CPU]",
            "99 of 100 within",
        ),
        tuple(
            (
                row.case,
                row.runs,
                row.alarms,
                "-" if math.isnan(row.median) else f"{row.median:.0f}",
                "-" if math.isnan(row.worst) else f"{row.worst:.0f}",
                f"{row.cpu:.2f}",
                f"{row.cpu_99:.2f}",
            )
            for row in rows
        ),
    )


def draw_stream(canvas: Canvas, tracked: Mapping[str, Sequence[TrackedStream]]) -> None:
    """Draw the first stream: the angle, and the error of each filter with its stated deviation."""
    top, *others = canvas.subplots(1 + len(tracked), 1, sharex=True)
    first = next(iter(tracked.values()))[0].stream
    top.plot(first.times, np.degrees(first.angles), color="0.2")
    top.set(ylabel="door [°]", title="one stream")
    for axes, (name, results) in zip(others, tracked.items(), strict=True):
        found = results[0]
        spread = np.degrees(np.sqrt(found.variances))
        axes.fill_between(first.times, -2 * spread, 2 * spread, color="tab:blue", alpha=0.2, linewidth=0.0)
        axes.plot(first.times, np.degrees(found.errors), color="tab:blue", linewidth=0.8)
        axes.set(ylabel=f"{name}\nerror [°]", ylim=(-2.5, 2.5))
    others[-1].set(xlabel="time [s]")
