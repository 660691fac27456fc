"""Output of ``kineverse demo``: a line of progress, a table of objects, JSON data."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.expressions.printing import format_number

from .output import join_lines, shorten_text

if TYPE_CHECKING:
    from kineverse.manipulation import OpenCloseReport, Outcome, Session
    from kineverse.manipulation.articulated_objects import ArticulatedObject

HEAD = (
    "object",
    "kind",
    "opened",
    "closed",
    "time",
    "grasp error",
    "estimate error",
    "step, median",
    "p99",
    "remark",
)
"""Titles of the table of objects."""
ALIGN = "<<>>>>>>><"
PAGE_HEAD = ("object", "opened", "closed", "time")
"""Titles of the table on the page."""
_REFRESH = 0.1
"""Least time between two states of the line of progress [s]."""
_LONGEST_REASON = 100


class ProgressLine:
    """Line of progress on standard error: rewritten while an object is handled, if that is a terminal."""

    def __init__(self, count: int) -> None:
        self._count, self._number, self._shown = count, 0, 0.0
        self._terminal = sys.stderr.isatty()

    def begin(self) -> None:
        """Begin the next object."""
        self._number += 1

    def update(self, session: Session, one: ArticulatedObject, opening: bool) -> None:
        """Show the phase and the value of an object, at most ten times a second."""
        now = time.monotonic()
        if self._terminal and now - self._shown >= _REFRESH:
            self._shown = now
            value = format_reading(one, session.world.state[one.coordinate])
            skill = "open" if opening else "close"
            text = f"{self._place} {one.coordinate}: {skill}, {session.phase}, {value}"
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def finish(self, report: OpenCloseReport) -> None:
        """Leave a line about a report."""
        self.clear()
        print(f"{self._place} {describe_report(report)}", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the line of an object that was not finished."""
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    @property
    def _place(self) -> str:
        return f"[{self._number:{len(str(self._count))}}/{self._count}]"


def describe_report(report: OpenCloseReport) -> str:
    """Return a sentence on an object."""
    one = report.object
    if report:
        how = "opened and closed, pushed in part," if report.pushed else "opened and closed"
        return f"{one.coordinate}: {how} in {report.seconds:.1f} s"
    value = format_reading(one, report.outcomes[-1].value)
    skill = "opened" if report.closed is None else "closed"
    return f"{one.coordinate}: not {skill}, at {value}. {join_lines(report.reason)}"


def format_row(report: OpenCloseReport) -> list[str]:
    """Return the cells of an object."""
    one, scale = report.object, 1e3 if report.object.kind == "drawer" else math.degrees(1.0)
    unit = "mm" if one.kind == "drawer" else "°"
    steps = 1e3 * np.array(report.steps) if report.steps else np.array([math.nan])
    remark = ("pushed in part" if report.pushed else "") if report else join_lines(report.reason)
    return [
        str(one.coordinate),
        one.kind,
        _format_outcome(one, report.opened),
        _format_outcome(one, report.closed),
        f"{report.seconds:.1f} s",
        "-" if math.isnan(report.grasp_error) else f"{1e3 * report.grasp_error:.2f} mm",
        f"{scale * report.estimate_error:.1f} {unit}".replace(" °", "°"),
        f"{np.median(steps):.2f} ms",
        f"{np.quantile(steps, 0.99):.2f} ms",
        shorten_text(remark, _LONGEST_REASON),
    ]


def format_page_row(report: OpenCloseReport) -> list[str]:
    """Return the cells of an object on the page."""
    name, _, opened, closed, seconds, *_ = format_row(report)
    return [name.rpartition("/")[2], opened, closed, seconds]


def describe_belief(session: Session, one: ArticulatedObject) -> str:
    """Return a line on the true and the believed value of an object."""
    drawer, symbol = one.kind == "drawer", one.coordinate
    scale, unit = (1e3, "mm") if drawer else (math.degrees(1.0), "°")
    space = " " if drawer else ""
    true, believed = scale * session.world.state[symbol], scale * session.state[symbol]
    if not (deviation := scale * session.deviation(symbol)):
        return f"at {true:.1f}{space}{unit}"
    return f"at {true:.1f}, believed at {believed:.1f} ± {deviation:.1f}{space}{unit}"


def report_as_data(report: OpenCloseReport) -> dict[str, Any]:
    """Return a report as JSON data: lengths in [m], angles in [rad], times in [s]; NaN is null."""
    one = report.object
    steps = np.array(report.steps)
    return {
        "what": str(one.coordinate),
        "kind": one.kind,
        "done": bool(report),
        "opened": _outcome_as_data(report.opened),
        "closed": _outcome_as_data(report.closed),
        "pushed": report.pushed,
        "seconds": report.seconds,
        "grasp_error": None if math.isnan(report.grasp_error) else report.grasp_error,
        "estimate_error": report.estimate_error,
        "steps": len(steps),
        "step_median": float(np.median(steps)) if len(steps) else None,
        "step_p99": float(np.quantile(steps, 0.99)) if len(steps) else None,
        "reason": report.reason,
    }


def format_reading(one: ArticulatedObject, value: float) -> str:
    """Return a value of an object's coordinate with its unit."""
    return f"{format_number(value, 3)} {'m' if one.kind == 'drawer' else 'rad'}"


def _format_outcome(one: ArticulatedObject, outcome: Outcome | None) -> str:
    if outcome is None:
        return "-"
    value = format_reading(one, outcome.value)
    return value if outcome else f"no, {value}"


def _outcome_as_data(outcome: Outcome | None) -> dict[str, Any] | None:
    if outcome is None:
        return None
    return {
        "done": outcome.done,
        "value": outcome.value,
        "seconds": outcome.seconds,
        "reason": outcome.reason,
    }
