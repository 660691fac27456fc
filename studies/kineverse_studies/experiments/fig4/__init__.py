"""``fig4``: tracking a kitchen from poses of its parts (2020 paper, IV-A; 2022 paper, IV-B, Fig. 4).

The papers' filter and :class:`kineverse.estimation.Tracker` get the same observations. In addition to the
papers' plots, errors are compared with the Cramér-Rao bound and with the covariance of each filter, under
Gaussian noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.formats import load
from kineverse.view.plots import Figure
from kineverse_studies.experiments.registry import Options, Progress
from kineverse_studies.experiments.report import Report, ReportTable, format_fixed, make_table

from . import accuracy, protocol

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True)
class Fig4Results:
    model: str  # name of the model, and the model with its observed frames
    scene: protocol.ObservedModel
    seeds: tuple[int, ...]  # seeds, and number of configurations of each
    configurations: int
    errors: tuple[accuracy.Errors, ...]
    variants: Mapping[str, list[float]]
    by_size: list[tuple[int, dict[str, protocol.Duration]]]
    by_noise: list[tuple[protocol.PoseNoise, dict[str, protocol.Duration]]]
    consistency: Mapping[protocol.PoseNoise, dict[str, accuracy.FilterConsistency]]
    mechanisms: list[accuracy.MechanismErrors]

    def numbers(self) -> dict[str, Any]:
        reported = zip(self.errors, accuracy.REPORTED_MEAN, accuracy.REPORTED_MAX, strict=True)
        return {
            "model": self.model,
            "degrees_of_freedom": len(self.scene.symbols),
            "symbols": [str(s) for s in self.scene.symbols],
            "seeds": self.seeds,
            "configurations": self.configurations,
            "observations": protocol.OBSERVATIONS,
            "errors": [
                _by_noise(
                    errors.noise,
                    {name: errors.summary(name) | {"nees": errors.nees[name]} for name in accuracy.FILTERS},
                )
                | {"reported_mean": mean, "reported_max": largest}
                for errors, mean, largest in reported
            ],
            "by_degrees_of_freedom": [
                {"degrees_of_freedom": dof}
                | {
                    name: {
                        "errors": [e.summary(name, slice(dof)) for e in self.errors],
                        "milliseconds": times[name],
                    }
                    for name in accuracy.FILTERS
                }
                for dof, times in self.by_size
            ],
            "milliseconds_by_noise": [_by_noise(noise, times) for noise, times in self.by_noise],
            "variants": self.variants,
            "consistency": [
                _by_noise(noise, {name: c.as_data() for name, c in by_filter.items()})
                for noise, by_filter in self.consistency.items()
            ],
            "mechanisms": [
                {"mechanism": one.mechanism} | _by_noise(one.noise, one.by_filter) for one in self.mechanisms
            ],
            "paper": {"milliseconds_below": protocol.REPORTED},
        }


def _by_noise(noise: protocol.PoseNoise, by_filter: Mapping[str, Any]) -> dict[str, Any]:
    return {"position": noise.position, "orientation": noise.orientation, **by_filter}


FILTER_NAMES = {"published": "papers' filter", "proper": "Tracker"}
_KINDS = (("shifting", 1e3), ("turning", 180 / math.pi))
"""Kinds of coordinates, with the factors from [m] to [mm] and from [rad] to [deg]."""


def make_tables(results: Fig4Results) -> tuple[ReportTable, ...]:
    strongest = results.errors[-1]
    turning = results.scene.turning
    kinds = [(~turning, 1e3), (turning, 180 / math.pi)]
    names = [FILTER_NAMES[name] for name in accuracy.FILTERS]
    reported = zip(results.errors, accuracy.REPORTED_MEAN, accuracy.REPORTED_MAX, strict=True)
    means = {
        dof: [strongest.summary(name, slice(dof))["mean"] for name in accuracy.FILTERS]
        for dof, _ in results.by_size
    }
    return (
        ReportTable(
            f"The papers' filter: |q̂ - q| after {protocol.OBSERVATIONS} observations, m and rad together "
            f"like the papers (configurations: {results.configurations}, seeds: {len(results.seeds)})",
            ("noise", "mean", "authors' code", "off by", "max, by seed", "authors' code, one run"),
            tuple(_reported_row(*row) for row in reported),
        ),
        ReportTable(
            "Errors against noise [m, rad], and the processor time of one prediction and update",
            ("noise", "filter", "mean", "sd", "max", "NEES", "time [ms]", "its sd", "its median"),
            tuple(
                (
                    str(errors.noise),
                    FILTER_NAMES[name],
                    *(format_fixed(errors.summary(name)[key], 4) for key in ("mean", "sd", "max")),
                    format_fixed(errors.nees[name]),
                    *_format_ms(times[name]),
                )
                for errors, (_, times) in zip(results.errors, results.by_noise, strict=True)
                for name in accuracy.FILTERS
            ),
        ),
        ReportTable(
            "Root mean square errors of what shifts and what turns",
            ("noise", *(f"{what}: {name}" for what in ("shifts [mm]", "turns [deg]") for name in names)),
            tuple(
                (
                    str(errors.noise),
                    *(
                        format_fixed(errors.rms(name, where), 2, unit) if where.any() else "-"
                        for where, unit in kinds
                        for name in accuracy.FILTERS
                    ),
                )
                for errors in results.errors
            ),
        ),
        ReportTable(
            f"Against degrees of freedom, at {strongest.noise} (errors: m, rad; the papers: below "
            f"{protocol.REPORTED:g} ms)",
            (
                "DoF",
                *(f"{name}: mean error" for name in names),
                *(title for name in names for title in (f"{name} [ms]", "sd", "median")),
            ),
            tuple(
                (
                    str(dof),
                    *(format_fixed(mean, 4) for mean in means[dof]),
                    *(cell for name in accuracy.FILTERS for cell in _format_ms(times[name])),
                )
                for dof, times in results.by_size
            ),
        ),
        ReportTable(
            "What the mean errors [m, rad] of the papers' filter depend on",
            ("variant", *(str(errors.noise) for errors in results.errors)),
            tuple((name, *(format_fixed(mean, 4) for mean in row)) for name, row in results.variants.items()),
        ),
        _consistency_table(results),
        _mechanism_table(results),
    )


def _reported_row(errors: accuracy.Errors, mean: float, largest: float) -> tuple[str, ...]:
    found = errors.summary("published")
    maxima = f"{min(found['maxima']):.3f} … {max(found['maxima']):.3f}"
    off = f"{100 * (found['mean'] / mean - 1):+.1f} %"
    return (
        str(errors.noise),
        format_fixed(found["mean"], 4),
        format_fixed(mean, 4),
        off,
        maxima,
        f"{largest:.3f}",
    )


def _consistency_table(results: Fig4Results) -> ReportTable:
    def of_kind(found: accuracy.FilterConsistency, kind: str, unit: float) -> str:
        return f"{unit * found.rms[kind]:.2f}, {unit * found.bound[kind]:.2f}" if kind in found.rms else "-"

    columns: dict[str, Callable[[tuple[protocol.PoseNoise, str, accuracy.FilterConsistency]], str]] = {
        "noise": lambda one: str(one[0]),
        "filter": lambda one: FILTER_NAMES[one[1]],
        "NEES": lambda one: format_fixed(one[2].nees_inside, 3),
        "NEES, all": lambda one: format_fixed(one[2].nees, 3),
        "NIS": lambda one: format_fixed(one[2].nis, 4),
        "band": lambda one: "-" if math.isnan(one[2].nis) else "{:.4f} … {:.4f}".format(*one[2].nis_band),
        "RMSE/bound": lambda one: format_fixed(one[2].over_bound, 3),
        "shifts: RMSE, bound [mm]": lambda one: of_kind(one[2], *_KINDS[0]),
        "turns: RMSE, bound [deg]": lambda one: of_kind(one[2], *_KINDS[1]),
    }
    title = (
        "Gaussian noise on each axis: NEES per state (1 is right) of truths "
        f"{accuracy.INTERIOR_DEVIATIONS:g}σ inside the limits and of all, NIS and its 95 % band, "
        "and errors over the Cramér-Rao bound"
    )
    items = (
        (noise, name, one) for noise, found in results.consistency.items() for name, one in found.items()
    )
    return make_table(title, items, columns)


def _mechanism_table(results: Fig4Results) -> ReportTable:
    columns: dict[str, Callable[[tuple[accuracy.MechanismErrors, str, accuracy.CoordinateErrors]], str]] = {
        "mechanism": lambda one: one[0].mechanism,
        "noise": lambda one: str(one[0].noise),
        "filter": lambda one: FILTER_NAMES[one[1]],
        "mean": lambda one: format_fixed(one[2].mean, 4),
        "max": lambda one: format_fixed(one[2].max, 4),
        "NEES": lambda one: f"{one[2].nees:.2f}",
        "lost [%]": lambda one: f"{one[2].lost_percent:.0f}",
    }
    title = "Mechanisms that are no joints: |q̂ - q| [rad], [m]; lost: a step to where the model has no value"
    return make_table(
        title,
        ((one, name, one.by_filter[name]) for one in results.mechanisms for name in accuracy.FILTERS),
        columns,
    )


def _format_ms(duration: protocol.Duration) -> tuple[str, ...]:
    return f"{duration.mean:.3f}", f"{duration.sd:.3f}", f"{duration.median:.3f}"


FIGURE_SIZE = (13.0, 8.0)
_COLORS = {"published": "tab:orange", "proper": "tab:blue"}


def draw_results(canvas: Canvas, results: Fig4Results) -> None:
    (noise, size), (time, consistency) = canvas.subplots(2, 2)
    places = np.arange(len(results.errors))
    sizes = [dof for dof, _ in results.by_size]
    gaussian = np.arange(len(results.consistency))
    for name in accuracy.FILTERS:
        label, color = FILTER_NAMES[name], _COLORS[name]
        found = [errors.summary(name) for errors in results.errors]
        for key, style in (("max", "^"), ("mean", "o-"), ("sd", ":")):
            noise.plot(places, [f[key] for f in found], style, color=color, label=f"{label}: {key}")
        for errors, style in zip(results.errors[::3], ("-", "--"), strict=True):
            means = [errors.summary(name, slice(dof))["mean"] for dof in sizes]
            size.plot(sizes, means, style, color=color, label=f"{label}, {errors.noise}")
        for key, style in (("mean", "o-"), ("sd", ":"), ("median", "--")):
            values = [getattr(by_filter[name], key) for _, by_filter in results.by_size]
            time.plot(sizes, values, style, color=color, markersize=4, label=f"{label}: {key}")
        statistics = [by_filter[name] for by_filter in results.consistency.values()]
        nees, ratio = [c.nees_inside for c in statistics], [c.over_bound for c in statistics]
        consistency.plot(gaussian, nees, "o-", color=color, label=f"{label}: NEES per state")
        consistency.plot(gaussian, ratio, "s--", color=color, label=f"{label}: RMSE over Cramér-Rao")
    noise.plot(places, accuracy.REPORTED_MAX, "k+", label="authors' code: max of one run")
    noise.plot(places, accuracy.REPORTED_MEAN, "kx", label="authors' code: mean")
    noise.set(title="error against noise", ylabel="|q̂ - q| [m], [rad]", yscale="log")
    noise.set_ylim(bottom=1.5e-3)
    noise.set_xticks(places, [str(errors.noise) for errors in results.errors])
    noise.legend(fontsize="small", ncols=2)
    size.set(title="mean error against degrees of freedom", xlabel="degrees of freedom")
    size.set(ylabel="|q̂ - q| [m], [rad]")
    size.set_ylim(bottom=0)
    size.legend(fontsize="small", loc="upper left")
    time.axhline(protocol.REPORTED, color="0.6", label="the papers stay below")
    time.set(title="time of one prediction and update", ylabel="[ms]", yscale="log")
    time.set(xlabel="degrees of freedom")
    time.legend(fontsize="small", ncols=2)
    consistency.axhspan(0.9, 1.1, color="0.9", zorder=0)
    consistency.set(title="consistency, Gaussian noise on each axis: 1 is right", yscale="log")
    consistency.set_xticks(gaussian, list(map(str, results.consistency)))
    consistency.legend(fontsize="small")


OPTIONS = ("quick", "model")
TIMED = 40  # number of configurations that are timed


def run(progress: Progress, options: Options) -> Report:
    """Track the model; ``quick`` takes one seed of four, and a tenth of the configurations."""
    model = options.model or "kitchen"
    scene = protocol.make_observed_model(load(model))
    seeds = range(1) if options.quick else range(4)
    configurations = protocol.CONFIGURATIONS // 10 if options.quick else protocol.CONFIGURATIONS
    timed = max(1, TIMED // 10) if options.quick else TIMED
    results = Fig4Results(
        model=model,
        scene=scene,
        seeds=tuple(seeds),
        configurations=configurations,
        errors=accuracy.measure_errors(scene, seeds, configurations, progress),
        variants=accuracy.measure_variants(scene, seeds, configurations, progress),
        by_size=protocol.time_updates_by_size(scene, timed, progress),
        by_noise=[
            (noise, protocol.time_updates(scene, noise, timed))
            for noise in progress(protocol.LEVELS, "fig4: time", "level")
        ],
        consistency=accuracy.measure_consistency(scene, seeds, configurations, progress),
        mechanisms=accuracy.measure_mechanisms(configurations // 3, progress),
    )
    return Report(
        name="fig4",
        title=f"Tracking {len(scene.symbols)} degrees of freedom of '{model}' (2022 paper, Fig. 4)",
        tables=make_tables(results),
        numbers=results.numbers(),
        figure=Figure(lambda canvas: draw_results(canvas, results), FIGURE_SIZE),
    )
