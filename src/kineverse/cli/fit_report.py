"""What was learned from poses, in words and as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.cli.table import figure, table

if TYPE_CHECKING:
    from kineverse.cli.fit import Learned, Noise
    from kineverse.estimation import Fit, Found
    from kineverse.estimation.recording import Pair

_SHOWN = 1e-4
"""Less probable families are counted, not listed."""

_LISTED = 10
"""Of more poses that do not fit only the first are listed."""


def as_text(source: str, pair: Pair, learned: Learned) -> str:
    """Return what was found: the joint, how sure that is, and what else it could be."""
    found, best, count = learned.found, learned.fit, len(pair.child_poses)
    said = f"{best.family}, {_percent(best.probability)}"
    if found.cannot_tell:
        said = f"{found}\nThe most probable one: {said}"
    what = "poses" if pair.child_poses.ndim == 3 else "positions"
    lines = [
        f"{pair.child} in {pair.parent}: {count} {what} ({source})",
        *_chosen(learned.judged, count),
        f"noise: {_noise(learned.noise)}",
        "",
        said,
        *(f"  {name:10}{value}" for name, value in _parts(best)),
        *_misfits(best.outlying, count, what),
        *_turned(best, pair),
        "",
        *_ranking(found),
    ]
    return "\n".join(lines)


def as_json(pair: Pair, learned: Learned) -> dict[str, Any]:
    """Return everything that was found, as plain values."""
    found, noise = learned.found, learned.noise
    return {
        "parent": pair.parent,
        "child": pair.child,
        "count": len(pair.child_poses),
        "judged": learned.judged,
        "orientations": pair.child_poses.ndim == 3,
        "noise": {"position": noise.position, "orientation": noise.orientation, "given": noise.given},
        "told": not found.cannot_tell,
        "family": found.best.family,
        "says": str(found),
        "outliers": list(learned.fit.outlying),
        "fits": [_fit(fit) for fit in (learned.fit, *found.fits[1:])],
    }


def _chosen(judged: int, count: int) -> list[str]:
    if judged == count:
        return []
    return [f"judged by {judged} of them, as errors of neighbours are alike (--thin {count} takes all)"]


def _noise(noise: Noise) -> str:
    angle = "" if noise.orientation is None else f" and {figure(math.degrees(noise.orientation), 3)} deg"
    how = "as given" if noise.given else "estimated"
    return f"{figure(1e3 * noise.position, 3)} mm{angle}, {how}"


def _parts(fit: Fit) -> list[tuple[str, str]]:
    """Return the parameters of a joint in words, with standard deviations."""
    parts = []
    for name in ("axis", "normal"):
        if name in fit.parameters:
            spread = _spread(fit, "axis.x", "axis.y")
            parts.append((name, f"{_triple(fit, name)}   ± {figure(math.degrees(spread), 2)} deg"))
    for name in ("point", "centre"):
        if name in fit.parameters:
            spread = _spread(fit, "point.x", "point.y", "point.z")
            parts.append((name, f"{_triple(fit, name)} m   ± {figure(1e3 * spread, 2)} mm"))
    if "pitch" in fit.parameters:
        pitch, spread = 1e3 * float(fit.parameters["pitch"]), 1e3 * fit.deviation("pitch")
        parts.append(("pitch", f"{figure(pitch)} mm per revolution   ± {figure(spread, 2)} mm"))
    for low, high, spread, turns in ranges(fit):
        scale, unit = (math.degrees(1.0), "deg") if turns else (1e3, "mm")
        ends = f"{figure(scale * low)} … {figure(scale * high)} {unit}"
        parts.append(("seen", f"{ends}   ± {figure(scale * spread, 2)} {unit} at each end"))
    left = f"{figure(1e3 * fit.rms[0], 3)} mm"
    if fit.residuals.shape[1] > 3:
        left += f", {figure(math.degrees(fit.rms[1]), 3)} deg"
    return [*parts, ("left over", f"{left} rms")]


def _misfits(outliers: Sequence[int], count: int, what: str) -> list[str]:
    """Return which poses do not fit at all, from 0, in words."""
    if not outliers:
        return []
    numbers = ", ".join(map(str, outliers[:_LISTED]))
    more = ", …" if len(outliers) > _LISTED else ""
    do = "does" if len(outliers) == 1 else "do"
    return [f"  {len(outliers)} of {count} {what} {do} not fit: {numbers}{more} (counted from 0)"]


def _turned(fit: Fit, pair: Pair) -> list[str]:
    """Return that turns may have been counted wrongly."""
    from kineverse.cli.fit import MOST_TURNED

    if not pair.timed or fit.turned < MOST_TURNED:
        return []
    most = figure(math.degrees(fit.turned), 3)
    return [f"  from one to the next it turns by up to {most} deg: it may be more turns, or fewer"]


def ranges(fit: Fit) -> list[tuple[float, float, float, bool]]:
    """Return of each joint value the least and the largest seen, their deviation, and if it is an angle."""
    found = []
    for k, component in enumerate(fit.motion.freedom.joints):
        values, deviations = fit.joint_values[fit.right, k], fit.deviations[fit.right, k]
        ends = [int(np.argmin(values)), int(np.argmax(values))]
        spread = float(deviations[ends].max())
        found.append((float(values[ends[0]]), float(values[ends[1]]), spread, component >= 3))
    return found


def _ranking(found: Found) -> list[str]:
    shown = [fit for fit in found.fits if fit.probability >= _SHOWN]
    rows: list[tuple[str, ...]] = []
    for fit in shown:
        angle = figure(math.degrees(fit.rms[1]), 3) if fit.residuals.shape[1] > 3 else "-"
        position = figure(1e3 * fit.rms[0], 3)
        rows.append(
            (fit.family, _percent(fit.probability), figure(fit.log_evidence, 6), position, angle, fit.reason)
        )
    head: tuple[str, ...] = ("joint", "probability", "log evidence", "left [mm]", "left [deg]", "not known")
    if not any(fit.reason for fit in shown):
        head, rows = head[:-1], [row[:-1] for row in rows]
    lines = [table(head, rows, "<>>>>")]
    rest = [fit.family for fit in found.fits if fit.probability < _SHOWN]
    return [*lines, f"not: {', '.join(rest)}"] if rest else lines


def _fit(fit: Fit) -> dict[str, Any]:
    return {
        "family": fit.family,
        "probability": fit.probability,
        "log_evidence": fit.log_evidence,
        "told": fit.told,
        "reason": fit.reason,
        "parameters": {name: np.asarray(value).tolist() for name, value in fit.parameters.items()},
        "deviations": {name: fit.deviation(name) for name in fit.coordinates},
        "frame": fit.frame.tolist(),
        "ranges": [
            {"lower": low, "upper": high, "deviation": spread, "unit": "rad" if turns else "m"}
            for low, high, spread, turns in ranges(fit)
        ],
        "rms": {"position": fit.rms[0], "orientation": fit.rms[1] if fit.residuals.shape[1] > 3 else None},
    }


def _spread(fit: Fit, *coordinates: str) -> float:
    """Return the root of the sum of variances of those coordinates that there are."""
    return math.hypot(*(fit.deviation(name) for name in coordinates if name in fit.coordinates))


def _triple(fit: Fit, name: str) -> str:
    return " ".join(f"{x:.4f}" for x in np.asarray(fit.parameters[name]))


def _percent(probability: float) -> str:
    """Return a probability in percent, and no 100 where something else is possible."""
    percent = 100.0 * probability
    return f"{min(percent, 99.99):.4g} %" if probability < 1.0 else "100 %"
