"""What was measured, for people."""

from __future__ import annotations

import math

from kineverse.experiments.report import Table

from .accuracy import FILTERS, REPORTED_MAX, REPORTED_MEAN
from .consistency import INSIDE, Consistency
from .durations import REPORTED, Duration
from .protocol import OBSERVATIONS
from .results import Results

NAMES = {"published": "papers' filter", "proper": "Tracker"}

_KINDS = (("shifting", 1e3), ("turning", 180 / math.pi))
"""Kinds of coordinates, and what makes [mm] and [deg] of [m] and [rad]."""


def tables(results: Results) -> tuple[Table, ...]:
    """Return all tables, what the papers report first."""
    return (
        _against_reports(results),
        _against_noise(results),
        _by_kind(results),
        _against_size(results),
        _variants(results),
        _consistency(results),
        _mechanisms(results),
    )


def _against_reports(results: Results) -> Table:
    rows = []
    for errors, mean, largest in zip(results.errors, REPORTED_MEAN, REPORTED_MAX, strict=True):
        found = errors.summary("published")
        off = f"{100 * (found['mean'] / mean - 1):+.1f} %"
        maxima = f"{min(found['maxima']):.3f} … {max(found['maxima']):.3f}"
        rows.append((str(errors.noise), _fixed(found["mean"]), _fixed(mean), off, maxima, f"{largest:.3f}"))
    return Table(
        f"The papers' filter: |q̂ - q| after {OBSERVATIONS} observations, m and rad together like the papers "
        f"(configurations: {results.configurations}, seeds: {len(results.seeds)})",
        ("noise", "mean", "authors' code", "off by", "max, by seed", "authors' code, one run"),
        tuple(rows),
    )


def _against_noise(results: Results) -> Table:
    rows = []
    for errors, (_, times) in zip(results.errors, results.by_noise, strict=True):
        for who in FILTERS:
            found = errors.summary(who)
            values = (_fixed(found[key]) for key in ("mean", "sd", "max"))
            nees = f"{errors.nees[who]:.2f}"
            rows.append((str(errors.noise), NAMES[who], *values, nees, *_ms(times[who])))
    return Table(
        "Errors against noise, and the time of one prediction and update",
        ("noise", "filter", "mean", "sd", "max", "NEES", "time [ms]", "sd", "median"),
        tuple(rows),
    )


def _by_kind(results: Results) -> Table:
    turning = results.scene.turning
    kinds = [(~turning, 1e3), (turning, 180 / math.pi)]
    rows = []
    for errors in results.errors:
        cells = [
            f"{unit * errors.rms(who, where):.2f}" if where.any() else "-"
            for where, unit in kinds
            for who in FILTERS
        ]
        rows.append((str(errors.noise), *cells))
    titles = (f"{what}: {NAMES[who]}" for what in ("shifts [mm]", "turns [deg]") for who in FILTERS)
    return Table(
        "Root mean square errors of what shifts and what turns",
        ("noise", *titles),
        tuple(rows),
    )


def _against_size(results: Results) -> Table:
    strongest = results.errors[-1]
    rows = []
    for dof, times in results.by_size:
        means = (_fixed(strongest.summary(who, slice(dof))["mean"]) for who in FILTERS)
        rows.append((str(dof), *means, *(cell for who in FILTERS for cell in _ms(times[who]))))
    titles = (title for who in FILTERS for title in (f"{NAMES[who]} [ms]", "sd", "median"))
    return Table(
        f"Against degrees of freedom, at {strongest.noise}; the papers stay below {REPORTED:g} ms",
        ("DoF", *(f"{NAMES[who]}: mean error" for who in FILTERS), *titles),
        tuple(rows),
    )


def _variants(results: Results) -> Table:
    return Table(
        "What the mean errors of the papers' filter depend on",
        ("variant", *(str(errors.noise) for errors in results.errors)),
        tuple((name, *map(_fixed, means)) for name, means in results.variants.items()),
    )


def _consistency(results: Results) -> Table:
    return Table(
        f"Gaussian noise on each axis: NEES per state (1 is right) of truths {INSIDE:g}σ inside the limits "
        "and of all, NIS and its 95 % band, and errors over the Cramér-Rao bound",
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
            (str(noise), NAMES[who], *_judgement(found))
            for noise, by_filter in results.consistency.items()
            for who, found in by_filter.items()
        ),
    )


def _judgement(found: Consistency) -> tuple[str, ...]:
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


def _mechanisms(results: Results) -> Table:
    rows = []
    for followed in results.mechanisms:
        for who in FILTERS:
            found = followed.by_filter[who]
            values = _fixed(found.mean), _fixed(found.max), f"{found.nees:.2f}", f"{found.lost_percent:.0f}"
            rows.append((followed.mechanism, str(followed.noise), NAMES[who], *values))
    return Table(
        "Mechanisms that are no joints: |q̂ - q| [rad], [m]; lost: a step to where the model has no value",
        ("mechanism", "noise", "filter", "mean", "max", "NEES", "lost [%]"),
        tuple(rows),
    )


def _fixed(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _ms(duration: Duration) -> tuple[str, ...]:
    return f"{duration.mean:.3f}", f"{duration.sd:.3f}", f"{duration.median:.3f}"
