"""``fig4``: tracking a kitchen from poses of its parts (2020 paper, IV-A; 2022 paper, IV-B, Fig. 4).

The papers' filter and :class:`kineverse.estimation.Tracker` get the same observations. In addition to the
papers' plots, errors are compared with the Cramér-Rao bound and with the covariance of each filter, under
Gaussian noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.formats import load
from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable

from .accuracy import (
    FILTERS,
    INTERIOR_DEVIATIONS,
    REPORTED_MAX,
    REPORTED_MEAN,
    Errors,
    FilterConsistency,
    MechanismErrors,
    measure_consistency,
    measure_errors,
    measure_mechanisms,
    measure_variants,
)
from .protocol import (
    CONFIGURATIONS,
    LEVELS,
    OBSERVATIONS,
    REPORTED,
    Duration,
    ObservedModel,
    PoseNoise,
    make_observed_model,
    time_updates,
    time_updates_by_size,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True)
class Fig4Results:
    """Results of all parts of the experiment, see the modules of this package."""

    model: str  # name of the model, and the model with its observed frames
    scene: ObservedModel
    seeds: tuple[int, ...]  # seeds, and number of configurations of each
    configurations: int
    errors: tuple[Errors, ...]  # see :mod:`.accuracy`, :mod:`.consistency`, :mod:`.mechanisms`
    variants: Mapping[str, list[float]]
    by_size: list[tuple[int, dict[str, Duration]]]
    by_noise: list[tuple[PoseNoise, dict[str, Duration]]]
    consistency: Mapping[PoseNoise, dict[str, FilterConsistency]]
    mechanisms: list[MechanismErrors]

    def numbers(self) -> dict[str, Any]:
        """Return the results as JSON data, by filter, with null for NaN."""
        return {
            "model": self.model,
            "degrees_of_freedom": len(self.scene.symbols),
            "symbols": [str(s) for s in self.scene.symbols],
            "seeds": list(self.seeds),
            "configurations": self.configurations,
            "observations": OBSERVATIONS,
            "errors": [
                {
                    **_noise_to_json(errors.noise),
                    **{
                        filter_name: {**errors.summary(filter_name), "nees": errors.nees[filter_name]}
                        for filter_name in FILTERS
                    },
                    "reported_mean": mean,
                    "reported_max": largest,
                }
                for errors, mean, largest in zip(self.errors, REPORTED_MEAN, REPORTED_MAX, strict=True)
            ],
            "by_degrees_of_freedom": [
                {
                    "degrees_of_freedom": dof,
                    **{
                        filter_name: self._at_size(dof, times[filter_name], filter_name)
                        for filter_name in FILTERS
                    },
                }
                for dof, times in self.by_size
            ],
            "milliseconds_by_noise": [
                {
                    **_noise_to_json(noise),
                    **{filter_name: asdict(times[filter_name]) for filter_name in FILTERS},
                }
                for noise, times in self.by_noise
            ],
            "variants": dict(self.variants),
            "consistency": [
                {
                    **_noise_to_json(noise),
                    **{filter_name: c.as_json() for filter_name, c in by_filter.items()},
                }
                for noise, by_filter in self.consistency.items()
            ],
            "mechanisms": [
                {
                    "mechanism": f.mechanism,
                    **_noise_to_json(f.noise),
                    **{
                        filter_name: _without_nan(asdict(f.by_filter[filter_name])) for filter_name in FILTERS
                    },
                }
                for f in self.mechanisms
            ],
            "paper": {"milliseconds_below": REPORTED},
        }

    def _at_size(self, dof: int, time: Duration, filter_name: str) -> dict[str, Any]:
        errors = [e.summary(filter_name, slice(dof)) for e in self.errors]
        return {"errors": errors, "milliseconds": asdict(time)}


def _noise_to_json(noise: PoseNoise) -> dict[str, float]:
    return {"position": noise.position, "orientation": noise.orientation}


def _without_nan(values: Mapping[str, float]) -> dict[str, float | None]:
    return {key: None if math.isnan(value) else value for key, value in values.items()}


FILTER_NAMES = {"published": "papers' filter", "proper": "Tracker"}
_KINDS = (("shifting", 1e3), ("turning", 180 / math.pi))
"""Kinds of coordinates, with the factors from [m] to [mm] and from [rad] to [deg]."""


def make_tables(results: Fig4Results) -> tuple[ReportTable, ...]:
    """Return all tables, first the one of published values."""
    return (
        _table_of_reported(results),
        _table_by_noise(results),
        _table_by_kind(results),
        _table_by_size(results),
        _table_of_variants(results),
        _table_of_consistency(results),
        _table_of_mechanisms(results),
    )


def _table_of_reported(results: Fig4Results) -> ReportTable:
    rows = []
    for errors, mean, largest in zip(results.errors, REPORTED_MEAN, REPORTED_MAX, strict=True):
        found = errors.summary("published")
        off = f"{100 * (found['mean'] / mean - 1):+.1f} %"
        maxima = f"{min(found['maxima']):.3f} … {max(found['maxima']):.3f}"
        rows.append(
            (
                str(errors.noise),
                _format_fixed(found["mean"]),
                _format_fixed(mean),
                off,
                maxima,
                f"{largest:.3f}",
            )
        )
    return ReportTable(
        f"The papers' filter: |q̂ - q| after {OBSERVATIONS} observations, m and rad together like the papers "
        f"(configurations: {results.configurations}, seeds: {len(results.seeds)})",
        ("noise", "mean", "authors' code", "off by", "max, by seed", "authors' code, one run"),
        tuple(rows),
    )


def _table_by_noise(results: Fig4Results) -> ReportTable:
    rows = []
    for errors, (_, times) in zip(results.errors, results.by_noise, strict=True):
        for filter_name in FILTERS:
            found = errors.summary(filter_name)
            values = (_format_fixed(found[key]) for key in ("mean", "sd", "max"))
            nees = f"{errors.nees[filter_name]:.2f}"
            rows.append(
                (str(errors.noise), FILTER_NAMES[filter_name], *values, nees, *_format_ms(times[filter_name]))
            )
    return ReportTable(
        "Errors against noise, and the processor time of one prediction and update",
        ("noise", "filter", "mean", "sd", "max", "NEES", "time [ms]", "its sd", "its median"),
        tuple(rows),
    )


def _table_by_kind(results: Fig4Results) -> ReportTable:
    turning = results.scene.turning
    kinds = [(~turning, 1e3), (turning, 180 / math.pi)]
    rows = []
    for errors in results.errors:
        cells = [
            f"{unit * errors.rms(filter_name, where):.2f}" if where.any() else "-"
            for where, unit in kinds
            for filter_name in FILTERS
        ]
        rows.append((str(errors.noise), *cells))
    titles = (
        f"{what}: {FILTER_NAMES[filter_name]}"
        for what in ("shifts [mm]", "turns [deg]")
        for filter_name in FILTERS
    )
    return ReportTable(
        "Root mean square errors of what shifts and what turns", ("noise", *titles), tuple(rows)
    )


def _table_by_size(results: Fig4Results) -> ReportTable:
    strongest = results.errors[-1]
    rows = []
    for dof, times in results.by_size:
        means = (_format_fixed(strongest.summary(filter_name, slice(dof))["mean"]) for filter_name in FILTERS)
        rows.append(
            (str(dof), *means, *(cell for filter_name in FILTERS for cell in _format_ms(times[filter_name])))
        )
    titles = (
        title for filter_name in FILTERS for title in (f"{FILTER_NAMES[filter_name]} [ms]", "sd", "median")
    )
    return ReportTable(
        f"Against degrees of freedom, at {strongest.noise}; the papers stay below {REPORTED:g} ms",
        ("DoF", *(f"{FILTER_NAMES[filter_name]}: mean error" for filter_name in FILTERS), *titles),
        tuple(rows),
    )


def _table_of_variants(results: Fig4Results) -> ReportTable:
    return ReportTable(
        "What the mean errors of the papers' filter depend on",
        ("variant", *(str(errors.noise) for errors in results.errors)),
        tuple((name, *map(_format_fixed, means)) for name, means in results.variants.items()),
    )


def _table_of_consistency(results: Fig4Results) -> ReportTable:
    return ReportTable(
        "Gaussian noise on each axis: NEES per state (1 is right) of truths "
        f"{INTERIOR_DEVIATIONS:g}σ inside the limits and of all, NIS and its 95 % band, "
        "and errors over the Cramér-Rao bound",
        (
            "noise",
            "filter",
            "NEES",
            "NEES, all",
            "NIS",
            "band",
            "RMSE/bound",
            "shifts: RMSE, bound [mm]",
            "turns: RMSE, bound [deg]",
        ),
        tuple(
            (str(noise), FILTER_NAMES[filter_name], *_consistency_row(found))
            for noise, by_filter in results.consistency.items()
            for filter_name, found in by_filter.items()
        ),
    )


def _consistency_row(found: FilterConsistency) -> tuple[str, ...]:
    counted = not math.isnan(found.nis)
    return (
        f"{found.nees_inside:.3f}",
        f"{found.nees:.3f}",
        f"{found.nis:.4f}" if counted else "-",
        "{:.4f} … {:.4f}".format(*found.nis_band) if counted else "-",
        f"{found.over_bound:.3f}",
        *(
            f"{unit * found.rms[kind]:.2f}, {unit * found.bound[kind]:.2f}" if kind in found.rms else "-"
            for kind, unit in _KINDS
        ),
    )


def _table_of_mechanisms(results: Fig4Results) -> ReportTable:
    rows = []
    for mechanism in results.mechanisms:
        for filter_name in FILTERS:
            found = mechanism.by_filter[filter_name]
            values = (
                _format_fixed(found.mean),
                _format_fixed(found.max),
                f"{found.nees:.2f}",
                f"{found.lost_percent:.0f}",
            )
            rows.append((mechanism.mechanism, str(mechanism.noise), FILTER_NAMES[filter_name], *values))
    return ReportTable(
        "Mechanisms that are no joints: |q̂ - q| [rad], [m]; lost: a step to where the model has no value",
        ("mechanism", "noise", "filter", "mean", "max", "NEES", "lost [%]"),
        tuple(rows),
    )


def _format_fixed(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _format_ms(duration: Duration) -> tuple[str, ...]:
    return f"{duration.mean:.3f}", f"{duration.sd:.3f}", f"{duration.median:.3f}"


FIGURE_SIZE = (13.0, 8.0)
_COLORS = {"published": "tab:orange", "proper": "tab:blue"}


def draw_results(canvas: Canvas, results: Fig4Results) -> None:
    """Draw the results on an empty figure."""
    (noise, size), (time, consistency) = canvas.subplots(2, 2)
    _plot_errors_by_noise(noise, results)
    _plot_errors_by_size(size, results)
    _plot_times(time, results)
    _plot_consistency(consistency, results)


def _plot_errors_by_noise(axes: Any, results: Fig4Results) -> None:
    places = np.arange(len(results.errors))
    for filter_name in FILTERS:
        found = [errors.summary(filter_name) for errors in results.errors]
        for key, style in (("max", "^"), ("mean", "o-"), ("sd", ":")):
            axes.plot(
                places,
                [f[key] for f in found],
                style,
                color=_COLORS[filter_name],
                label=f"{FILTER_NAMES[filter_name]}: {key}",
            )
    axes.plot(places, REPORTED_MAX, "k+", label="authors' code: max of one run")
    axes.plot(places, REPORTED_MEAN, "kx", label="authors' code: mean")
    axes.set(title="error against noise", ylabel="|q̂ - q| [m], [rad]", yscale="log")
    axes.set_ylim(bottom=1.5e-3)
    axes.set_xticks(places, [str(errors.noise) for errors in results.errors])
    axes.legend(fontsize="small", ncols=2)


def _plot_errors_by_size(axes: Any, results: Fig4Results) -> None:
    sizes = [dof for dof, _ in results.by_size]
    for filter_name in FILTERS:
        for errors, style in zip(results.errors[::3], ("-", "--"), strict=True):
            means = [errors.summary(filter_name, slice(dof))["mean"] for dof in sizes]
            axes.plot(
                sizes,
                means,
                style,
                color=_COLORS[filter_name],
                label=f"{FILTER_NAMES[filter_name]}, {errors.noise}",
            )
    axes.set(title="mean error against degrees of freedom", xlabel="degrees of freedom")
    axes.set(ylabel="|q̂ - q| [m], [rad]")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize="small", loc="upper left")


def _plot_times(axes: Any, results: Fig4Results) -> None:
    sizes = [dof for dof, _ in results.by_size]
    for filter_name in FILTERS:
        times = [by_filter[filter_name] for _, by_filter in results.by_size]
        for key, style in (("mean", "o-"), ("sd", ":"), ("median", "--")):
            values = [getattr(time, key) for time in times]
            axes.plot(
                sizes,
                values,
                style,
                color=_COLORS[filter_name],
                markersize=4,
                label=f"{FILTER_NAMES[filter_name]}: {key}",
            )
    axes.axhline(REPORTED, color="0.6", label="the papers stay below")
    axes.set(
        title="time of one prediction and update", xlabel="degrees of freedom", ylabel="[ms]", yscale="log"
    )
    axes.legend(fontsize="small", ncols=2)


def _plot_consistency(axes: Any, results: Fig4Results) -> None:
    places = np.arange(len(results.consistency))
    for filter_name in FILTERS:
        found = [by_filter[filter_name] for by_filter in results.consistency.values()]
        nees, ratio = [c.nees_inside for c in found], [c.over_bound for c in found]
        axes.plot(
            places,
            nees,
            "o-",
            color=_COLORS[filter_name],
            label=f"{FILTER_NAMES[filter_name]}: NEES per state",
        )
        axes.plot(
            places,
            ratio,
            "s--",
            color=_COLORS[filter_name],
            label=f"{FILTER_NAMES[filter_name]}: RMSE over Cramér-Rao",
        )
    axes.axhspan(0.9, 1.1, color="0.9", zorder=0)
    axes.set(title="consistency, Gaussian noise on each axis: 1 is right", yscale="log")
    axes.set_xticks(places, [str(noise) for noise in results.consistency])
    axes.legend(fontsize="small")


OPTIONS = ("quick", "model")
TIMED = 40  # number of configurations that are timed


def run(progress: Progress, options: Options) -> Report:
    """Track the model with both filters, by the papers' protocol and beyond it.

    The option ``quick`` reduces four seeds to one, and the configurations to a tenth.
    """
    model = options.model or "kitchen"
    scene = make_observed_model(load(model))
    seeds = range(1) if options.quick else range(4)
    configurations = CONFIGURATIONS // 10 if options.quick else CONFIGURATIONS
    timed = max(1, TIMED // 10) if options.quick else TIMED
    results = Fig4Results(
        model=model,
        scene=scene,
        seeds=tuple(seeds),
        configurations=configurations,
        errors=measure_errors(scene, seeds, configurations, progress),
        variants=measure_variants(scene, seeds, configurations, progress),
        by_size=time_updates_by_size(scene, timed, progress),
        by_noise=[
            (noise, time_updates(scene, noise, timed)) for noise in progress(LEVELS, "fig4: time", "level")
        ],
        consistency=measure_consistency(scene, seeds, configurations, progress),
        mechanisms=measure_mechanisms(configurations // 3, progress),
    )
    return Report(
        name="fig4",
        title=f"Tracking {len(scene.symbols)} degrees of freedom of '{model}' (2022 paper, Fig. 4)",
        tables=make_tables(results),
        numbers=results.numbers(),
        figure=Figure(lambda canvas: draw_results(canvas, results), FIGURE_SIZE),
    )
