"""The papers' Fig. 4 for both filters: error against noise and size, and time against size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .accuracy import FILTERS, REPORTED_MAX, REPORTED_MEAN
from .durations import REPORTED
from .results import Results
from .tables import NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

SIZE = (13.0, 8.0)

_COLORS = {"published": "tab:orange", "proper": "tab:blue"}


def draw(canvas: Canvas, results: Results) -> None:
    """Draw on an empty canvas."""
    (noise, size), (time, honest) = canvas.subplots(2, 2)
    _against_noise(noise, results)
    _against_size(size, results)
    _times(time, results)
    _consistency(honest, results)


def _against_noise(axes: Any, results: Results) -> None:
    places = np.arange(len(results.errors))
    for who in FILTERS:
        found = [errors.summary(who) for errors in results.errors]
        _mean_and_sd(axes, places, [f["mean"] for f in found], [f["sd"] for f in found], who)
        axes.plot(places, [f["max"] for f in found], "^", color=_COLORS[who], label=f"{NAMES[who]}: max")
    axes.plot(places, REPORTED_MEAN, "kx", label="authors' code: mean")
    axes.plot(places, REPORTED_MAX, "k+", label="authors' code: max of one run")
    axes.set(title="error against noise", ylabel="|q̂ - q| [m], [rad]", yscale="log")
    axes.set_xticks(places, [str(errors.noise) for errors in results.errors])
    axes.legend(fontsize="small", loc="lower right")


def _against_size(axes: Any, results: Results) -> None:
    sizes = [dof for dof, _ in results.by_size]
    for who in FILTERS:
        for errors, style in zip(results.errors[::3], ("-", "--"), strict=True):
            means = [errors.summary(who, slice(dof))["mean"] for dof in sizes]
            axes.plot(sizes, means, style, color=_COLORS[who], label=f"{NAMES[who]}, {errors.noise}")
    axes.set(
        title="mean error against degrees of freedom",
        xlabel="degrees of freedom",
        ylabel="|q̂ - q| [m], [rad]",
    )
    axes.set_ylim(bottom=0)
    axes.legend(fontsize="small", loc="center left")


def _times(axes: Any, results: Results) -> None:
    sizes = np.array([dof for dof, _ in results.by_size])
    for who in FILTERS:
        times = [by_filter[who] for _, by_filter in results.by_size]
        _mean_and_sd(axes, sizes, [t.mean for t in times], [t.sd for t in times], who)
    axes.axhline(REPORTED, color="0.6", linestyle=":", label="the papers, with 23: below")
    axes.set(
        title="time of one prediction and update", xlabel="degrees of freedom", ylabel="[ms]", yscale="log"
    )
    axes.legend(fontsize="small")


def _consistency(axes: Any, results: Results) -> None:
    places = np.arange(len(results.consistency))
    for who in FILTERS:
        found = [by_filter[who] for by_filter in results.consistency.values()]
        axes.plot(
            places,
            [c.nees_inside for c in found],
            "o-",
            color=_COLORS[who],
            label=f"{NAMES[who]}: NEES per state",
        )
        axes.plot(
            places,
            [c.over_bound for c in found],
            "s--",
            color=_COLORS[who],
            label=f"{NAMES[who]}: RMSE over Cramér-Rao",
        )
    axes.axhspan(0.9, 1.1, color="0.9", zorder=0)
    axes.set(title="consistency, Gaussian noise on each axis: 1 is right", yscale="log")
    axes.set_xticks(places, [str(noise) for noise in results.consistency])
    axes.legend(fontsize="small")


def _mean_and_sd(axes: Any, places: Any, mean: list[float], sd: list[float], who: str) -> None:
    """Draw means, with a band of one standard deviation that stays above a tenth of them on a log scale."""
    low = np.maximum(np.subtract(mean, sd), np.multiply(mean, 0.1))
    axes.fill_between(places, low, np.add(mean, sd), color=_COLORS[who], alpha=0.15, linewidth=0)
    axes.plot(places, mean, "o-", markersize=4, color=_COLORS[who], label=f"{NAMES[who]}: mean, sd")
