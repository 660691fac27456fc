"""How a life went, in the words and numbers of tables."""

from __future__ import annotations

import math

from .axis_uncertainty import WITH_AXIS, error
from .simulation import Life
from .track import Figures

Table = tuple[tuple[str, str], list[tuple[str, str]]]


def table_of_tracking(life: Life, figures: Figures) -> Table:
    """Return head and rows: how far markers and beliefs were off, how honest these are, what they cost."""
    return ("the kitchen, tracked", f"{len(life.following.tracker.symbols)} DoF"), [
        ("markers are off by", millimetres(figures.marker)),
        ("the track is off by", millimetres(figures.mean)),
        ("at most", millimetres(figures.most)),
        ("NEES, 1 is honest", f"{figures.nees:.2f}"),
        ("an update takes", f"{1e3 * figures.seconds:.2f} ms"),
    ]


def table_of_learning(life: Life) -> Table:
    """Return head and rows: what was learned of the stranger, how sure that is, and how far off."""
    learner, head = life.learner, ("the stranger, learned", life.stranger.name)
    found = learner.found
    if found is None:
        return head, [("poses", str(len(learner.seen)))]
    best = found.best
    likely = [fit for fit in found.fits if fit.probability > 0.005]
    rows = [("poses", str(len(learner.seen))), *((fit.family, f"{fit.probability:.3f}") for fit in likely)]
    if found.is_ambiguous:
        rows.append(("conclusion", "cannot tell"))
    elif best.family in WITH_AXIS:
        angle, distance, _ = error(best, *life.stranger.axis)
        sigma = math.degrees(max(best.deviation("axis.x"), best.deviation("axis.y")))
        rows.append(("axis", f"± {sigma:.1f}°, off by {math.degrees(angle):.1f}°"))
        if "point.x" in best.coordinates:
            sigma = max(best.deviation("point.x"), best.deviation("point.y"))
            rows.append(("its place", f"± {millimetres(sigma)}, off by {millimetres(distance)}"))
    if life.part_error is not None:
        rows.append(("the tracked part is off by", millimetres(life.part_error)))
    return head, rows


def millimetres(length: float) -> str:
    """Return a length [m] in millimetres."""
    return "–" if math.isnan(length) else f"{1e3 * length:.0f} mm"
