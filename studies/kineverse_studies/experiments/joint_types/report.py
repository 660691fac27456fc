"""Report of the joint-type experiment: tables, numbers and figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.estimation.identification.noise_estimation import UNKNOWN_NOISE
from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable

from .answers import CASES, Setting, TypeAnswer, identify_cases
from .samples import (
    BETA,
    COUNTS,
    LEVERS,
    MOVING,
    ORIENTATIONS,
    POSITIONS,
    RANGES,
    SEED,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Answers = Mapping[Setting, Sequence[TypeAnswer]]

OPTIONS = ("quick",)
QUICK_CASES = 30
FIGURE_SIZE = (13.0, 5.0)

TARGETS = {Setting(True, False): (0.92, 0.02), Setting(True, True): (0.98, 0.002)}
"""Least share of right answers, and largest share of wrong sure ones, of the settings that have a target."""

PROBABILITIES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
RATIOS = (0.0, 1 / 8, 1 / 2, 2.0, 8.0, math.inf)
"""Bins of probabilities, and of ratios of position to orientation noise, relative to 5 mm : 1°."""


def run(progress: Progress, options: Options) -> Report:
    """Identify the cases; with the option ``quick`` a few of them."""
    return report_answers(identify_cases(QUICK_CASES if options.quick else CASES, progress))


def report_answers(answers: Answers) -> Report:
    """Return the report on the answers."""
    count = max(len(some) for some in answers.values())
    return Report(
        name="joint-types",
        title=f"Types of {count} random hinges and sliders",
        tables=(
            _target_table(answers),
            _binned_table(
                "How often an answer of some probability is right", "probability", answers, PROBABILITIES, _p
            ),
            _binned_table(
                "By ratio of position to orientation noise, over 5 mm : 1 deg",
                "ratio",
                answers,
                RATIOS,
                noise_ratio,
            ),
            _noise_table(answers),
            _error_table(answers),
        ),
        numbers={
            "seed": SEED,
            "cases": {
                "count": COUNTS,
                "position": POSITIONS,
                "orientation": ORIENTATIONS,
                "range": RANGES,
                "beta": BETA,
                "lever": LEVERS,
                "moving": MOVING,
            },
            "answers": {
                setting.title: [_numbers(answer) for answer in some] for setting, some in answers.items()
            },
        },
        figure=Figure(lambda canvas: draw_answers(canvas, answers), FIGURE_SIZE),
    )


def noise_ratio(answer: TypeAnswer) -> float:
    """Return the ratio of position to orientation noise over 5 mm : 1°; 1 without orientations."""
    position, orientation = np.divide(answer.truth, UNKNOWN_NOISE).tolist()
    return 1.0 if math.isnan(orientation) else position / orientation


def share_right(answers: Sequence[TypeAnswer]) -> float:
    """Return the share of right answers; NaN without answers."""
    return sum(answer.is_right for answer in answers) / len(answers) if answers else math.nan


def share_of_sure_errors(answers: Sequence[TypeAnswer]) -> float:
    """Return the share of wrong sure answers; NaN without answers."""
    errors = sum(answer.is_sure and not answer.is_right for answer in answers)
    return errors / len(answers) if answers else math.nan


def _p(answer: TypeAnswer) -> float:
    return answer.probability


def _target_table(answers: Answers) -> ReportTable:
    rows = []
    for setting, some in answers.items():
        right, wrong = share_right(some), share_of_sure_errors(some)
        least, most = TARGETS.get(setting, (None, None))
        sure = sum(answer.is_sure for answer in some) / len(some)
        asked, holds = "-", "-"
        if least is not None and most is not None:
            asked = f"{100 * least:g}, at most {100 * most:g}"
            holds = "yes" if right >= least and wrong <= most else "no"
        rows.append((setting.title, 100 * right, 100 * sure, 100 * wrong, asked, holds))
    return ReportTable(
        "Right types, sure answers and wrong sure answers",
        ("given", "right [%]", "sure [%]", "sure and wrong [%]", "asked for", "holds"),
        tuple(rows),
    )


def _binned_table(
    title: str, name: str, answers: Answers, edges: Sequence[float], of: Callable[[TypeAnswer], float]
) -> ReportTable:
    rows = []
    for low, high in pairwise(edges):
        cells: list[float | str] = []
        for some in answers.values():
            chosen = [answer for answer in some if low < of(answer) <= high]
            wrong = sum(answer.is_sure and not answer.is_right for answer in chosen)
            cells.append(f"{100 * share_right(chosen):.1f} of {len(chosen)} ({wrong})" if chosen else "-")
        rows.append((f"{low:.3g} to {high:.3g}", *cells))
    titles = tuple(f"{setting.title} [%]" for setting in answers)
    return ReportTable(f"{title} (sure errors)", (name, *titles), tuple(rows))


def _noise_table(answers: Answers) -> ReportTable:
    rows = []
    for setting, some in answers.items():
        for kind, name in enumerate(("position", "orientation")):
            ratios = np.array([answer.noise[kind] / answer.truth[kind] for answer in some if answer.noise])
            ratios = ratios[np.isfinite(ratios)]
            if len(ratios):
                quantiles = np.quantile(ratios, (0.05, 0.5, 0.95)).tolist()
                rows.append((setting.title, name, *quantiles))
    return ReportTable(
        "Estimated noise over the true one",
        ("given", "noise of", "5 % quantile", "median", "95 % quantile"),
        tuple(rows),
    )


def _error_table(answers: Answers) -> ReportTable:
    rows = tuple(
        (
            setting.title,
            float(answer.number),
            answer.true,
            answer.family,
            f"{100 * answer.probability:.2f}",
            float(answer.count),
            1e3 * answer.truth.position,
            math.degrees(answer.truth.orientation),
        )
        for setting, some in answers.items()
        if setting in TARGETS
        for answer in some
        if answer.is_sure and not answer.is_right
    )
    head = ("given", "case", "true", "answer", "probability [%]", "N", "noise [mm]", "noise [deg]")
    return ReportTable("Wrong sure answers from poses", head, rows or (("-",) * len(head),))


def draw_answers(canvas: Canvas, answers: Answers) -> None:
    """Draw the shares of right answers by probability and by ratio of the noise."""
    calibration, ratios = canvas.subplots(1, 2)
    for setting, some in answers.items():
        for axes, of, edges in (
            (calibration, _p, PROBABILITIES),
            (ratios, noise_ratio, np.geomspace(1 / 64, 64, 7)),
        ):
            bins = [[answer for answer in some if low < of(answer) <= high] for low, high in pairwise(edges)]
            full = [chosen for chosen in bins if chosen]
            across = [float(np.median([of(answer) for answer in chosen])) for chosen in full]
            style = "-o" if setting.poses else ":o"
            axes.plot(across, [100 * share_right(chosen) for chosen in full], style, label=setting.title)
    calibration.plot([0.0, 1.0], [0.0, 100.0], color="0.7", linewidth=1.0)
    calibration.set(xlabel="probability", ylabel="right [%]", title="calibration", xlim=(0.3, 1.01))
    ratios.set(xscale="log", xlabel="position to orientation noise over 5 mm : 1°", title="by ratio")
    ratios.legend(loc="lower left")


def _numbers(answer: TypeAnswer) -> dict[str, Any]:
    return {
        "case": answer.number,
        "true": answer.true,
        "family": answer.family,
        "probability": answer.probability,
        "sure": answer.is_sure,
        "count": answer.count,
        "true_noise": _finite(answer.truth),
        "noise": None if answer.noise is None else _finite(answer.noise),
    }


def _finite(values: Sequence[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]
