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
        for key, style in (("max", "^"), ("mean", "o-"), ("sd", ":")):
            axes.plot(
                places, [f[key] for f in found], style, color=_COLORS[who], label=f"{NAMES[who]}: {key}"
            )
    axes.plot(places, REPORTED_MAX, "k+", label="authors' code: max of one run")
    axes.plot(places, REPORTED_MEAN, "kx", label="authors' code: mean")
    axes.set(title="error against noise", ylabel="|q̂ - q| [m], [rad]", yscale="log")
    axes.set_ylim(bottom=1.5e-3)
    axes.set_xticks(places, [str(errors.noise) for errors in results.errors])
    axes.legend(fontsize="small", ncols=2)


def _against_size(axes: Any, results: Results) -> None:
    sizes = [dof for dof, _ in results.by_size]
    for who in FILTERS:
        for errors, style in zip(results.errors[::3], ("-", "--"), strict=True):
            means = [errors.summary(who, slice(dof))["mean"] for dof in sizes]
            axes.plot(sizes, means, style, color=_COLORS[who], label=f"{NAMES[who]}, {errors.noise}")
    axes.set(title="mean error against degrees of freedom", xlabel="degrees of freedom")
    axes.set(ylabel="|q̂ - q| [m], [rad]")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize="small", loc="upper left")


def _times(axes: Any, results: Results) -> None:
    sizes = [dof for dof, _ in results.by_size]
    for who in FILTERS:
        times = [by_filter[who] for _, by_filter in results.by_size]
        for key, style in (("mean", "o-"), ("sd", ":"), ("median", "--")):
            values = [getattr(time, key) for time in times]
            axes.plot(sizes, values, style, color=_COLORS[who], markersize=4, label=f"{NAMES[who]}: {key}")
    axes.axhline(REPORTED, color="0.6", label="the papers stay below")
    axes.set(
        title="time of one prediction and update", xlabel="degrees of freedom", ylabel="[ms]", yscale="log"
    )
    axes.legend(fontsize="small", ncols=2)


def _consistency(axes: Any, results: Results) -> None:
    places = np.arange(len(results.consistency))
    for who in FILTERS:
        found = [by_filter[who] for by_filter in results.consistency.values()]
        nees, ratio = [c.nees_inside for c in found], [c.over_bound for c in found]
        axes.plot(places, nees, "o-", color=_COLORS[who], label=f"{NAMES[who]}: NEES per state")
        axes.plot(places, ratio, "s--", color=_COLORS[who], label=f"{NAMES[who]}: RMSE over Cramér-Rao")
    axes.axhspan(0.9, 1.1, color="0.9", zorder=0)
    axes.set(title="consistency, Gaussian noise on each axis: 1 is right", yscale="log")
    axes.set_xticks(places, [str(noise) for noise in results.consistency])
    axes.legend(fontsize="small")
