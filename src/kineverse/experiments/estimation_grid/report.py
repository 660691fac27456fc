"""What the estimation grid says, as tables and numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from kineverse.experiments.estimation_grid.figure import SIZE, draw_grid
from kineverse.experiments.estimation_grid.fits import SAMPLES, SEED, fit_all, grid, quick_grid
from kineverse.experiments.estimation_grid.results import (
    LEAST_RIGHT,
    MOST_OVER,
    NEAR,
    TELLING,
    Result,
    Summary,
    summarise,
)
from kineverse.experiments.estimation_grid.samples import LEVER, TO_AXIS, Cell
from kineverse.experiments.options import Options
from kineverse.experiments.registry import Progress
from kineverse.experiments.report import Figure, Report, Table

OPTIONS = ("quick",)

QUICK_SAMPLES = 10
WORST = 10


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
        tables=(_bars(total), _by_noise(results), _by_range(results), _worst(results)),
        numbers={
            "seed": SEED,
            "geometry": {"parent_to_axis": TO_AXIS, "axis_to_child": LEVER},
            "bars": {"near_deg": NEAR, "telling_deg": TELLING, "ratio": MOST_OVER, "right": LEAST_RIGHT},
            "summary": {name: _plain(getattr(total, name)) for name in Summary.__dataclass_fields__},
            "cells": [_numbers(result) for result in results],
        },
        figure=Figure(lambda canvas: draw_grid(canvas, results), SIZE),
    )


def _bars(total: Summary) -> Table:
    return Table(
        "What is asked for, and what came out",
        ("", "measured", "asked for", "holds"),
        (
            (
                f"RMS of the direction over its bound, where that is below {NEAR:g} deg",
                total.ratio,
                f"<= {MOST_OVER:g}",
                _holds(total.ratio <= MOST_OVER),
            ),
            (
                "RMS of the place over its bound, in the same cells",
                total.place_ratio,
                f"<= {MOST_OVER:g}",
                _holds(total.place_ratio <= MOST_OVER),
            ),
            (
                f"cells above {MOST_OVER:g}, of {total.near}",
                float(total.over),
                f"{total.over_by_chance:.1f} by chance",
                _holds(total.over <= total.over_by_chance + 3.0 * math.sqrt(total.over_by_chance)),
            ),
            ("divergences", float(total.diverged), "0", _holds(total.diverged == 0)),
            (
                f"right type, where the bound is below {TELLING:g} deg",
                total.right,
                f">= {LEAST_RIGHT:g}",
                _holds(total.right >= LEAST_RIGHT),
            ),
            ('told rather than "cannot tell", in the same cells', total.told, "-", "-"),
            ("told, and wrong, in all cells", float(total.told_wrong), "-", "-"),
        ),
    )


def _by_noise(results: Sequence[Result]) -> Table:
    rows = [
        (joint, 1e3 * position, math.degrees(orientation), *_cells(chosen))
        for (joint, position, orientation), chosen in _grouped(
            results, lambda cell: (cell.joint, cell.position, cell.orientation)
        )
    ]
    return Table("By noise of both poses", ("joint", "noise [mm]", "noise [deg]", *_HEAD), tuple(rows))


def _by_range(results: Sequence[Result]) -> Table:
    rows = [
        (joint, said(joint, reach), *_cells(chosen))
        for (joint, reach), chosen in _grouped(results, lambda cell: (cell.joint, cell.range))
    ]
    return Table("By range of the motion", ("joint", "range", *_HEAD), tuple(rows))


_HEAD = ("fits", "near", "RMS/bound", "place", "worst cell", "right", "told", "diverged")


def _cells(results: Sequence[Result]) -> tuple[float | str, ...]:
    part = summarise(results)
    near = f"{part.near} of {part.cells}"
    ratios = (
        _dash(part.ratio),
        _dash(part.place_ratio),
        _dash(part.worst),
        _dash(part.right),
        _dash(part.told),
    )
    return (float(part.fits), near, *ratios, float(part.diverged))


def _worst(results: Sequence[Result]) -> Table:
    near = sorted((r for r in results if r.bound < NEAR), key=lambda r: -r.ratio)[:WORST]
    return Table(
        f"The cells farthest above their bounds, of those below {NEAR:g} deg",
        ("joint", "noise [mm]", "noise [deg]", "N", "range", "bound [deg]", "RMS/bound", "right"),
        tuple(
            (
                r.cell.joint,
                1e3 * r.cell.position,
                math.degrees(r.cell.orientation),
                float(r.cell.count),
                said(r.cell.joint, r.cell.range),
                r.bound,
                r.ratio,
                float(r.right.mean()),
            )
            for r in near
        ),
    )


def said(joint: str, reach: float) -> str:
    """Return a range in words."""
    return f"{math.degrees(reach):.0f} deg" if joint == "revolute" else f"{100 * reach:.0f} cm"


def _grouped(results: Iterable[Result], key: Any) -> Iterable[tuple[Any, list[Result]]]:
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result.cell), []).append(result)
    return groups.items()


def _numbers(result: Result) -> dict[str, Any]:
    cell: Cell = result.cell
    taken = {name: result.called.count(name) for name in sorted(set(result.called))}
    return {
        "joint": cell.joint,
        "position_noise": cell.position,
        "orientation_noise_deg": math.degrees(cell.orientation),
        "count": cell.count,
        "range": cell.range,
        "samples": len(result.degrees),
        "bound_deg": result.bound,
        "ratio": _plain(result.ratio),
        "place_ratio": _plain(result.place_ratio),
        "above_by_chance": result.by_chance,
        "right": float(result.right.mean()),
        "told": float(result.told.mean()),
        "told_wrong": int((result.told & ~result.right).sum()),
        "taken_for": taken,
        "diverged": result.diverged,
    }


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _dash(value: float) -> float | str:
    return value if math.isfinite(value) else "-"


def _holds(does: bool) -> str:
    return "yes" if does else "no"
