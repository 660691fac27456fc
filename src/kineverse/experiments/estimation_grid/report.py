"""What the estimation grid says, as tables and numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

from kineverse.experiments.estimation_grid.figure import SIZE, draw_grid
from kineverse.experiments.estimation_grid.fits import SAMPLES, SEED, fit_all, grid, quick_grid
from kineverse.experiments.estimation_grid.results import (
    LEAST_RIGHT,
    MOST_OVER,
    NEAR,
    TELLING,
    Ratios,
    Result,
    Summary,
    rms,
    summarise,
)
from kineverse.experiments.estimation_grid.samples import LEVER, TO_AXIS, Cell
from kineverse.experiments.options import Options
from kineverse.experiments.registry import Progress
from kineverse.experiments.report import Figure, Report, Table

OPTIONS = ("quick",)

QUICK_SAMPLES = 10
WORST = 10

Key = TypeVar("Key", bound=Hashable)
Cells = tuple[float | str, ...]


def run(progress: Progress, options: Options) -> Report:
    """Fit the grid; a few cells of it, with fewer samples, if it has to be quick."""
    cells, samples = (quick_grid(), QUICK_SAMPLES) if options.quick else (grid(), SAMPLES)
    return report(fit_all(cells, samples, progress))


def report(results: Sequence[Result]) -> Report:
    """Return the report on what came out."""
    total = summarise(results)
    return Report(
        name="estimation-grid",
        title=f"Hinges and sliders from noisy poses: {total.fits} fits in {total.cells} cells",
        tables=(_bars(total), _by_noise(results), _by_range(results), _by_count(results), _worst(results)),
        numbers={
            "seed": SEED,
            "geometry": {"parent_to_axis": TO_AXIS, "axis_to_child": LEVER},
            "bars": {"near_deg": NEAR, "telling_deg": TELLING, "ratio": MOST_OVER, "right": LEAST_RIGHT},
            "summary": _plain(asdict(total)),
            "cells": [_numbers(result) for result in results],
        },
        figure=Figure(lambda canvas: draw_grid(canvas, results), SIZE),
    )


def _bars(total: Summary) -> Table:
    by_chance = total.over_by_chance
    chance = f"{by_chance:.1f} by chance"
    return Table(
        "What is asked for, and what came out",
        ("", "measured", "asked for", "holds"),
        (
            *_errors("the Cramér-Rao bound", total.bound),
            *_errors("what can be attained", total.attainable),
            (
                f"cells over {MOST_OVER:g} of what can be attained",
                float(total.attainable.over),
                chance,
                _holds(total.attainable.over <= by_chance + 3.0 * math.sqrt(by_chance)),
            ),
            ("divergences", float(total.diverged), "0", _holds(total.diverged == 0)),
            _right("right type, the Cramér-Rao bound", total.right),
            _right("right type, what can be attained", total.right_attainable),
            (f'told rather than "cannot tell", the bound below {TELLING:g} deg', _dash(total.told), "-", "-"),
            ("told, and wrong, anywhere", float(total.told_wrong), "-", "-"),
        ),
    )


def _errors(what: str, ratios: Ratios) -> tuple[Cells, ...]:
    """Return the rows on errors over a bound."""
    asked = f"<= {MOST_OVER:g}"
    return tuple(
        (
            f"RMS of the {part} over {what}, that below {NEAR:g} deg",
            _dash(ratio),
            asked,
            _holds(ratio <= MOST_OVER),
        )
        for part, ratio in (("direction", ratios.direction), ("place", ratios.place))
    )


def _right(what: str, part: float) -> Cells:
    return (f"{what} below {TELLING:g} deg", _dash(part), f">= {LEAST_RIGHT:g}", _holds(part >= LEAST_RIGHT))


_HEAD = ("fits", "RMS/bound", "RMS/attainable", "place/attainable", "right", "told", "diverged")


def _by_noise(results: Sequence[Result]) -> Table:
    return Table(
        f"By noise of both poses; errors where what they are held against is below {NEAR:g} deg",
        ("joint", "noise [mm]", "noise [deg]", *_HEAD),
        tuple(
            (joint, 1e3 * position, math.degrees(orientation), *_cells(chosen))
            for (joint, position, orientation), chosen in _grouped(
                results, lambda cell: (cell.joint, cell.position, cell.orientation)
            )
        ),
    )


def _by_range(results: Sequence[Result]) -> Table:
    groups = _grouped(results, lambda cell: (cell.joint, cell.range))
    rows = tuple((joint, said(joint, reach), *_cells(chosen)) for (joint, reach), chosen in groups)
    return Table("By range of the motion", ("joint", "range", *_HEAD), rows)


def _by_count(results: Sequence[Result]) -> Table:
    groups = _grouped(results, lambda cell: (cell.joint, cell.count))
    rows = tuple((joint, float(count), *_cells(chosen)) for (joint, count), chosen in groups)
    return Table("By number of observations", ("joint", "N", *_HEAD), rows)


def _cells(results: Sequence[Result]) -> Cells:
    part = summarise(results)
    numbers = (
        part.bound.direction,
        part.attainable.direction,
        part.attainable.place,
        part.right,
        part.told,
    )
    return (float(part.fits), *map(_dash, numbers), float(part.diverged))


def _worst(results: Sequence[Result]) -> Table:
    near = sorted((r for r in results if r.attainable < NEAR), key=lambda r: -r.attained)[:WORST]
    return Table(
        f"The cells farthest above what can be attained, where that is below {NEAR:g} deg",
        (
            "joint",
            "noise [mm]",
            "noise [deg]",
            "N",
            "range",
            "bound [deg]",
            "attainable",
            "RMS [deg]",
            "right",
        ),
        tuple(
            (
                r.cell.joint,
                1e3 * r.cell.position,
                math.degrees(r.cell.orientation),
                float(r.cell.count),
                said(r.cell.joint, r.cell.range),
                r.bound,
                r.attainable,
                rms(r.degrees),
                float(r.right.mean()),
            )
            for r in near
        ),
    )


def said(joint: str, reach: float) -> str:
    """Return a range in words."""
    return f"{math.degrees(reach):.0f} deg" if joint == "revolute" else f"{100 * reach:.0f} cm"


def _grouped(results: Iterable[Result], key: Callable[[Cell], Key]) -> Iterable[tuple[Key, list[Result]]]:
    groups: dict[Key, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result.cell), []).append(result)
    return groups.items()


def _numbers(result: Result) -> dict[str, Any]:
    cell = result.cell
    return {
        "joint": cell.joint,
        "position_noise": cell.position,
        "orientation_noise_deg": math.degrees(cell.orientation),
        "count": cell.count,
        "range": cell.range,
        "samples": len(result.degrees),
        "bound_deg": result.bound,
        "attainable_deg": result.attainable,
        "rms_deg": _plain(rms(result.degrees)),
        "bound_m": _plain(rms(result.bound_metres)),
        "attainable_m": _plain(rms(result.attainable_metres)),
        "rms_m": _plain(rms(result.metres)),
        "above_by_chance": result.by_chance,
        "right": float(result.right.mean()),
        "told": float(result.told.mean()),
        "told_wrong": int((result.told & ~result.right).sum()),
        "taken_for": {name: result.called.count(name) for name in sorted(set(result.called))},
        "diverged": result.diverged,
    }


def _plain(value: Any) -> Any:
    """Return values as JSON has them: nothing for what is not finite."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _dash(value: float) -> float | str:
    return value if math.isfinite(value) else "-"


def _holds(does: bool) -> str:
    return "yes" if does else "no"
