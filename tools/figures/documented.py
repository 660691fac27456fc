"""Every table of figures on the pages: its command, its short form, and the rule of each column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from kineverse_studies.bench import BENCHMARKS

from . import short_forms
from .rules import EXTREME, TIME, ByRow, Count, CountOf, Key, Largest, Mean, Rule, Same, Share, Unchecked
from .short_forms import (
    CALIBRATED_DRAWS,
    CALIBRATED_DRIVES,
    CHECK_SEED,
    FIG4_CONFIGURATIONS,
    HAND_EYES,
    LOCKBOXES,
    STREAMS,
    TYPE_CASES,
    Tables,
)


@dataclass(frozen=True)
class DocumentedTable:
    """Table between marks on a page.

    Attributes
    ----------
    name
        Name of the mark.
    page
        Page in ``docs/``.
    command
        Command that makes it, with ``--markdown``.
    title
        Beginning of the title under which the command prints it.
    rules
        Rule of each column of the page; the page has these columns in this order.
    short
        Short form of the command; None for benchmarks, whose rows alone are compared, in ``tests/bench``,
        and for what takes its time, of which ``tests/live`` has a short form.
    has_all_rows
        False if the short form has some of the rows.
    data
        Path in the folder of other people's data that the command needs; empty for none.
    """

    name: str
    page: str
    command: str
    title: str
    rules: Mapping[str, Rule]
    short: Callable[[], Tables] | None = None
    has_all_rows: bool = True
    data: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the page."""
        return tuple(self.rules)


KEY, SAME, LARGEST = Key(), Same(), Largest()
FOLLOWS = Unchecked("it follows from others")
FEWER = Unchecked("the short form has fewer")

# Coordinates of both kitchens: 15 drawers and 8 hinges.
_ALL, _SHIFTS, _TURNS = (count * FIG4_CONFIGURATIONS for count in (23, 15, 8))
# Spreads of |q̂ - q| and (q̂ - q)²/σ² over configurations, as measured: those of a normal distribution are .76
# and 1.41. That of a root mean square is half of that of the squares.
_ERROR, _ERROR_UNSURE = 1.2, 4.0
_NEES_TRACKER, _NEES_PAPERS = 1.5, 4.2
_MEASUREMENTS = 6 * 41 * 24 * FIG4_CONFIGURATIONS


def _by_filter(tracker: float, papers: float, samples: int) -> Rule:
    return ByRow("filter", {"Tracker": Mean(tracker, samples), "papers' filter": Mean(papers, samples)})


_NOISES = ("5 cm, 7.5°", "10 cm, 15°", "15 cm, 22.5°", "20 cm, 30°")
_VARIANT = ByRow(
    "variant",
    # After one step, some hinges end more than a radian off.
    {"": Mean(_ERROR, _ALL), "one": Mean(_ERROR_UNSURE, _ALL)},
)
_AUTHORS_KITCHEN = "iai_kitchen/iai_kitchen/urdf_obj/IAI_kitchen.urdf"
_FIG4_AUTHORS = f"kineverse reproduce fig4 --model {_AUTHORS_KITCHEN}"

FIG4 = (
    DocumentedTable(
        "fig4-authors",
        "experiments.md",
        _FIG4_AUTHORS,
        "The papers' filter",
        {
            "noise": KEY,
            "mean": Mean(_ERROR, _ALL),
            "authors' code": SAME,
            "off by": FOLLOWS,
            "max, by seed": EXTREME,
            "authors' code, one run": SAME,
        },
        short_forms.fig4_authors,
        data=_AUTHORS_KITCHEN,
    ),
    DocumentedTable(
        "fig4-variants",
        "experiments.md",
        _FIG4_AUTHORS,
        "What the mean errors",
        {"variant": KEY, **dict.fromkeys(_NOISES, _VARIANT)},
        short_forms.fig4_authors,
        has_all_rows=False,
        data=_AUTHORS_KITCHEN,
    ),
    DocumentedTable(
        "fig4-errors",
        "experiments.md",
        "kineverse reproduce fig4",
        "Errors against noise",
        {
            "noise": KEY,
            "filter": KEY,
            "mean": Mean(_ERROR, _ALL),
            "max": EXTREME,
            "NEES": _by_filter(_NEES_TRACKER, _NEES_PAPERS, _ALL),
        },
        short_forms.fig4,
    ),
    DocumentedTable(
        "fig4-times",
        "experiments.md",
        "kineverse reproduce fig4 --quick",
        "Errors against noise",
        {"noise": KEY, "filter": KEY, "time [ms]": TIME, "its sd": TIME, "its median": TIME},
        short_forms.fig4,
    ),
    DocumentedTable(
        "fig4-kinds",
        "experiments.md",
        "kineverse reproduce fig4",
        "Root mean square errors",
        {
            "noise": KEY,
            "shifts [mm]: papers' filter": Mean(0.8, _SHIFTS),
            "shifts [mm]: Tracker": Mean(0.8, _SHIFTS),
            "turns [deg]: papers' filter": Mean(0.8, _TURNS),
            "turns [deg]: Tracker": Mean(1.0, _TURNS),
        },
        short_forms.fig4,
    ),
    DocumentedTable(
        "fig4-consistency",
        "experiments.md",
        "kineverse reproduce fig4",
        "Gaussian noise on each axis",
        {
            "noise": KEY,
            "filter": KEY,
            "NEES": _by_filter(_NEES_TRACKER, _NEES_PAPERS, _ALL),
            "NEES, all": _by_filter(_NEES_TRACKER, _NEES_PAPERS, _ALL),
            "NIS": Mean(1.42, _MEASUREMENTS),
            "band": Unchecked("it is narrower for more measurements"),
            "RMSE/bound": _by_filter(0.75, 2.0, _ALL),
        },
        short_forms.fig4,
    ),
)

STURM = (
    DocumentedTable(
        "sturm",
        "experiments.md",
        "kineverse reproduce sturm --data sturm_tracks",
        "What is asked for",
        {"": KEY, "measured": SAME, "asked for": SAME, "holds": SAME},
        short_forms.sturm,
        data="sturm_tracks",
    ),
    DocumentedTable(
        "sturm-missed",
        "experiments.md",
        "kineverse reproduce sturm --data sturm_tracks",
        "Missed",
        {"recording": KEY, "shows": SAME},
        short_forms.sturm,
        data="sturm_tracks",
    ),
    DocumentedTable(
        "sturm-statements",
        "experiments.md",
        "kineverse reproduce sturm --data sturm_tracks",
        "All poses of each recording",
        {"noise": KEY, "right": Count(), "sure and wrong": Count(), "cannot tell": Count()},
        short_forms.sturm_statements,
        data="sturm_tracks",
    ),
)

# Errors with a correlation of .95 from look to look are independent after some 20. The hand moves for 7 s.
_MOVING, _RESTING = 10 * STREAMS, 60 * STREAMS

STREAM = (
    DocumentedTable(
        "stream-tracking",
        "experiments.md",
        "kineverse reproduce stream",
        "Tracking",
        {
            "process": KEY,
            "RMSE moving [mrad]": Mean(0.71, _MOVING),
            "RMSE at rest [mrad]": Mean(0.71, _RESTING),
            "NEES": Mean(1.41, _RESTING),
            "worst stream": EXTREME,
            "silently lost [s]": LARGEST,
            "update [ms CPU]": TIME,
            "99 of 100 within": TIME,
        },
        short_forms.stream_tracking,
    ),
    DocumentedTable(
        "stream-monitoring",
        "experiments.md",
        "kineverse reproduce stream",
        "Monitor",
        {
            "door": KEY,
            "streams": FEWER,
            "alarms": Count(of="streams"),
            "looks from 45° to the alarm": Unchecked("the median of one is that one"),
            "worst": LARGEST,
            "look [ms CPU]": TIME,
        },
        short_forms.stream_monitoring,
    ),
)

_CASES = Share(TYPE_CASES, is_part=True)
JOINTS = (
    DocumentedTable(
        "joint-types",
        "experiments.md",
        "kineverse reproduce joint-types",
        "Right types",
        {
            "given": KEY,
            "right [%]": _CASES,
            "sure [%]": _CASES,
            "sure and wrong [%]": _CASES,
            "asked for": SAME,
        },
        short_forms.joint_types,
    ),
    DocumentedTable(
        "estimation-grid",
        "experiments.md",
        "kineverse reproduce estimation-grid --quick",
        "What is asked for",
        {
            "": KEY,
            "measured": ByRow(
                "",
                {
                    # Of 72 fits, those with a bound below 10° or 5°.
                    "RMS": Mean(1.0, 40),
                    "cells over": Unchecked("it depends on the number of samples of a cell"),
                    "divergences": LARGEST,
                    "right type": Share(25, whole=1.0),
                    "told rather": Share(25, whole=1.0),
                    "told, and wrong": Count(),
                },
            ),
            "asked for": ByRow("", {"": SAME, "cells over": FOLLOWS}),
        },
        short_forms.estimation_grid,
    ),
)

_WORST: Mapping[str, Rule] = {
    "robot": KEY,
    "limits violated [own unit]": Largest(least=1e-9),
    "contact losses": LARGEST,
    "penetration [mm]": LARGEST,
    "jitter [m/s, rad/s]": LARGEST,
}
_PUSH: Mapping[str, Rule] = {"skill": KEY, "robot": KEY}


def _table_of_trials(
    name: str, command: str, title: str, rules: Mapping[str, Rule], short: Callable[[], Tables]
) -> DocumentedTable:
    return DocumentedTable(
        name, "experiments.md", f"kineverse reproduce {command}", title, rules, short, has_all_rows=False
    )


_KITCHEN = partial(short_forms.kitchen, "kitchen/oven_left_drawer")

MANIPULATION = (
    _table_of_trials(
        "kitchen",
        "kitchens --model kitchen",
        "Objects that were",
        {
            "robot": KEY,
            "DoF": SAME,
            "objects": FEWER,
            "done": Count(of="objects"),
            **dict.fromkeys(("out of reach", "collision", "reach", "time", "other"), Count()),
        },
        _KITCHEN,
    ),
    _table_of_trials(
        "kitchen-worst",
        "kitchens --model kitchen",
        "Worst of all",
        {**_WORST, "grasp error [mm]": LARGEST},
        _KITCHEN,
    ),
    _table_of_trials(
        "kitchen-steps",
        "kitchens --model kitchen",
        "Control steps [ms]",
        {"robot": KEY, **dict.fromkeys(("CPU mean", "median", "p99", "worst"), TIME)},
        _KITCHEN,
    ),
    DocumentedTable(
        "live",
        "experiments.md",
        "kineverse reproduce live",
        "Opened and closed in real time",
        {
            "robot": KEY,
            "object": KEY,
            **dict.fromkeys(("skills", "done"), SAME),
            **dict.fromkeys(
                (
                    "time of one [s]",
                    "error of the estimate [mm], [mrad]",
                    "force [N]",
                    "reading to estimate [ms]",
                    "real-time factor",
                    "late steps [%]",
                    "restarts",
                ),
                Unchecked("it is measured in real time, in half an hour"),
            ),
        },
    ),
    _table_of_trials(
        "push",
        "table1-push",
        "Starts and bars",
        {
            **_PUSH,
            "objects": FEWER,
            **dict.fromkeys(("shut", "from the papers' start", "within all bars"), Count(of="objects")),
        },
        short_forms.pushes,
    ),
    _table_of_trials(
        "push-worst",
        "table1-push",
        "Worst of all",
        {**_WORST, "pressed [mm]": LARGEST},
        short_forms.pushes,
    ),
    _table_of_trials(
        "push-steps",
        "table1-push",
        "Control steps beside the papers",
        {**_PUSH, "CPU mean": TIME, "worst": TIME, "paper mean": SAME},
        short_forms.pushes,
    ),
)

LOCKBOX = (
    DocumentedTable(
        "lockbox",
        "experiments.md",
        f"kineverse reproduce lockbox --count {LOCKBOXES}",
        "Random boxes",
        {
            "trends": KEY,
            "locks": KEY,
            "parts": Unchecked("the short form has one"),
            "opened": CountOf(),
            "steps (median)": FEWER,
            "CPU of a step [µs]": TIME,
        },
        short_forms.lockbox,
        has_all_rows=False,
    ),
    DocumentedTable(
        "lockbox-plans",
        "experiments.md",
        f"kineverse reproduce lockbox --count {LOCKBOXES}",
        "Plans",
        {
            "boxes": KEY,
            "parts": Unchecked("the short form has one"),
            **dict.fromkeys(("found", "refuted", "undecided", "wrong"), Count()),
            "moves (most)": LARGEST,
            "planning [ms]": TIME,
            "(longest)": TIME,
        },
        short_forms.lockbox,
    ),
    DocumentedTable(
        "lockbox-unknown",
        "experiments.md",
        f"kineverse reproduce lockbox --count {LOCKBOXES}",
        "Unknown locks",
        {
            "boxes": KEY,
            "opened": CountOf(),
            "tries (mean)": FEWER,
            "(most)": LARGEST,
            "systematic, depth first": FEWER,
            "breadth first": FEWER,
        },
        short_forms.lockbox,
    ),
)

CHECKS = (
    DocumentedTable(
        "checks",
        "checks.md",
        f"kineverse reproduce checks --seed {CHECK_SEED}",
        "Broken models",
        {"break": KEY, "kind of break": KEY, "found": CountOf(), "named rightly": CountOf()},
        short_forms.checks,
    ),
)

# Benchmarks that take minutes.
_QUICKER = ("document", "geometry", "inverse_kinematics", "control")
# They need robots and problems of other people, and minutes: they are on no page.
_LEFT_OUT = ("planning", "examples")

BENCH = tuple(
    DocumentedTable(
        f"bench-{name}",
        "benchmarks.md",
        f"kineverse bench {name}{' --quick' if name in _QUICKER else ''}",
        f"{name}:",
        {name: KEY, "median": TIME, "best": TIME, "takes": TIME},
    )
    for name in BENCHMARKS
    if name not in _LEFT_OUT
)

_BYTES = ByRow("message", {"a second": Unchecked("few seconds say little"), "": Mean(0.1, 4)})
_COSTS = "make faults ARGS=costs"

DEPLOYMENT = (
    DocumentedTable(
        "costs",
        "deployment.md",
        _COSTS,
        "Costs",
        {"message": KEY, "up [B]": _BYTES, "down [B]": _BYTES, "server [µs]": TIME, "relay [µs]": TIME},
        short_forms.costs_of_messages,
    ),
    DocumentedTable(
        "on-paper",
        "deployment.md",
        _COSTS,
        "On paper",
        {
            **dict.fromkeys(("sites", "clients", "edits/s", "way"), KEY),
            **dict.fromkeys(("server's CPU [%]", "server sends [Mbit/s]", "site gets [Mbit/s]"), FOLLOWS),
        },
        short_forms.costs_of_messages,
    ),
)

_CONVERSION = "kineverse reproduce conversion"
_ROBOTS = Unchecked("the short form has few models, and other versions of engines may be installed")

CONVERSION = (
    DocumentedTable(
        "conversion-engines",
        "export.md",
        _CONVERSION,
        "Engines",
        {
            "format": KEY,
            "engine": _ROBOTS,
            "files": _ROBOTS,
            "all equal": SAME,
            "refused": _ROBOTS,
            "largest distance [m]": EXTREME,
            "largest angle [rad]": EXTREME,
        },
        short_forms.conversion,
    ),
    DocumentedTable(
        "conversion-models",
        "export.md",
        _CONVERSION,
        "Models in each format",
        {"model": KEY, **dict.fromkeys(("frames", "DoF", "URDF", "MJCF", "SDF"), SAME)},
        short_forms.conversion,
        has_all_rows=False,
    ),
)

_CALIBRATION = "kineverse reproduce calibration"
# Spreads of a root mean square over the parameters of a draw, which are correlated: measured. Errors of a
# hand-eye calibration have long tails, those of OpenCV's above all.
_OVER_BOUND = ByRow("calibrated", {"wheels": Mean(0.6, CALIBRATED_DRIVES), "": Mean(0.25, CALIBRATED_DRAWS)})
_NEES = ByRow("calibrated", {"wheels": Mean(1.0, CALIBRATED_DRIVES), "": Mean(0.5, CALIBRATED_DRAWS)})
_HAND_EYE = Mean(1.0, HAND_EYES)

CALIBRATION = (
    DocumentedTable(
        "calibration-hand-eye",
        "calibration.md",
        _CALIBRATION,
        "Pose of a camera",
        {
            "looks, spread": KEY,
            "error": KEY,
            "ours": _HAND_EYE,
            **dict.fromkeys(("Tsai", "Park", "Horaud"), _HAND_EYE),
            **dict.fromkeys(("Andreff", "Daniilidis"), Mean(4.0, HAND_EYES)),
        },
        short_forms.calibration,
    ),
    DocumentedTable(
        "calibration",
        "calibration.md",
        _CALIBRATION,
        "Errors of calibrated parameters",
        {
            "calibrated": KEY,
            "parameters": SAME,
            "draws": FEWER,
            "error / bound": _OVER_BOUND,
            "NEES / dof": _NEES,
            "of a wheel [%]": ByRow("calibrated", {"wheels": Mean(0.6, CALIBRATED_DRIVES), "": SAME}),
            "time [ms]": TIME,
        },
        short_forms.calibration,
    ),
)

DOCUMENTED = (
    *(*FIG4, *STURM, *STREAM, *JOINTS, *CALIBRATION, *MANIPULATION, *LOCKBOX, *BENCH, *DEPLOYMENT),
    *(*CONVERSION, *CHECKS),
)
"""All tables, in the order of the pages."""
