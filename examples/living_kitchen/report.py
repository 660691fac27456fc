"""Tables of tracking and identification results."""

from __future__ import annotations

import math

from .identify import DIRECTED_FAMILIES, axis_error
from .simulation import Simulation
from .track import TrackingQuality

Table = tuple[tuple[str, str], list[tuple[str, str]]]


def tabulate_tracking(simulation: Simulation, quality: TrackingQuality) -> Table:
    """Return head and rows: errors of markers and track, its consistency, the duration of an update."""
    return ("the kitchen, tracked", f"{len(simulation.kitchen_tracker.tracker.symbols)} DoF"), [
        ("markers are off by", format_length(quality.marker)),
        ("the track is off by", format_length(quality.mean)),
        ("at most", format_length(quality.most)),
        ("NEES, 1 is honest", f"{quality.nees:.2f}"),
        ("an update takes", f"{1e3 * quality.seconds:.2f} ms"),
    ]


def tabulate_identification(simulation: Simulation) -> Table:
    """Return head and rows: the identified joint of the mechanism, its uncertainty and its error."""
    learner, head = simulation.learner, ("the stranger, learned", simulation.mechanism.name)
    found = learner.result
    if found is None:
        return head, [("poses", str(len(learner.part_positions)))]
    best = found.best
    likely = [fit for fit in found.fits if fit.probability > 0.005]
    rows = [
        ("poses", str(len(learner.part_positions))),
        *((fit.family, f"{fit.probability:.3f}") for fit in likely),
    ]
    if found.is_ambiguous:
        rows.append(("conclusion", "cannot tell"))
    elif best.family in DIRECTED_FAMILIES:
        angle, distance, _ = axis_error(best, *simulation.mechanism.axis)
        sigma = math.degrees(max(best.deviation("axis.x"), best.deviation("axis.y")))
        rows.append(("axis", f"± {sigma:.1f}°, off by {math.degrees(angle):.1f}°"))
        if "point.x" in best.coordinates:
            sigma = max(best.deviation("point.x"), best.deviation("point.y"))
            rows.append(("its place", f"± {format_length(sigma)}, off by {format_length(distance)}"))
    if simulation.part_error is not None:
        rows.append(("the tracked part is off by", format_length(simulation.part_error)))
    return head, rows


def format_length(length: float) -> str:
    """Format a length [m] in millimetres."""
    return "–" if math.isnan(length) else f"{1e3 * length:.0f} mm"
