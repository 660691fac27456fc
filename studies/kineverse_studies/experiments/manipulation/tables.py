"""Tables and figures of trials."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from kineverse.view.plots import Figure
from kineverse_studies.experiments.report import ReportTable

from .columns import COLUMNS, QUALITY, ROW, SUCCESS, TIMES, Column
from .trials import Trial, as_json, group_trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_LONGEST_REASON = 90
_TIMED = (
    "Control steps [ms]: everything from the state to the command, distance queries included, "
    "without the world, planning and base placement"
)


def make_trial_tables(
    trials: Sequence[Trial], title: str, more: Iterable[ReportTable] = ()
) -> tuple[ReportTable, ...]:
    """Return the tables of trials: success, times, quality, excepted pairs and failures."""
    tables = (
        make_group_table(title, trials, (*ROW, *SUCCESS)),
        *more,
        make_group_table(_TIMED, trials, (*ROW[:3], *TIMES)),
        make_group_table("Worst of all trials", trials, (*ROW[:3], *QUALITY)),
        make_exception_table(trials),
        make_failure_table(trials),
    )
    return tuple(table for table in tables if table.rows)


def make_group_table(
    title: str, trials: Sequence[Trial], columns: Sequence[Column], by: Sequence[str] = ()
) -> ReportTable:
    """Return a table with a row for each robot, world and noise, and value of further attributes.

    Columns that are empty in all rows, and that of the noise if there is none, are left out.
    """
    groups = group_trials(trials, *by, *(column.key for column in ROW))
    columns = [c for c in columns if c.key != "noise" or any(t.noise for t in trials)]
    rows = [
        (*map(str, key[: len(by)]), *(column.cell(own) for column in columns)) for key, own in groups.items()
    ]
    head = (*by, *(column.title for column in columns))
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    return ReportTable(
        title, tuple(head[k] for k in kept), tuple(tuple(row[k] for k in kept) for row in rows)
    )


def make_exception_table(trials: Iterable[Trial]) -> ReportTable:
    """Return the table of the pairs of bodies whose penetration does not count.

    Bodies of one robot or of one piece of furniture are listed with those that they always overlap; those of
    a gripper with the object that it grasps or pushes.
    """
    rows = []
    for (robot,), own in group_trials(trials, "robot").items():
        pairs: dict[str, dict[str, None]] = {}
        for pair in (pair for t in own for pair in t.measures.get("excepted", ())):
            (head, a), (other, b) = (name.partition("/")[::2] for name in pair)
            if head == other:
                pairs.setdefault(f"{head}: {a}", {})[b] = None
            else:
                pairs.setdefault("handle that is grasped or pushed", {})[f"{head}: {a}"] = None
        rows += [(robot, body, ", ".join(others)) for body, others in pairs.items()]
    return ReportTable("Pairs whose penetration does not count", ("robot", "body", "with"), tuple(rows))


def make_failure_table(trials: Iterable[Trial]) -> ReportTable:
    """Return the table of all failures."""
    rows = tuple(
        (t.case, t.robot, t.world, t.what, t.skill, t.failure, shorten_reason(t.reason))
        for t in trials
        if not t.done
    )
    head = ("case", "robot", "world", "object", "skill", "class", "reason")
    return ReportTable("Failures", head, rows)


def make_trial_numbers(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the columns of all robots and worlds, failures, and all trials as JSON data."""
    groups = group_trials(trials, *(column.key for column in ROW))
    data = [t.as_data() for t in trials]
    return {
        "cpu_seconds": sum(float(t.measures.get("cpu_seconds", 0.0)) for t in trials),
        "robots": [{c.key: as_json(c.of(own)) for c in COLUMNS} for own in groups.values()],
        "failures": [one for one in data if not one["done"]],
        "trials": data,
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
