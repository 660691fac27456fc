"""Comparison of models by poses and limits at sampled states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from kineverse.lie import Array
from kineverse.model.compare import measure_pose_distances
from kineverse.model.model_view import ModelView
from kineverse.model.sampling import StateSamples
from kineverse.symbols import Symbol

COMPARED_STATES = 100


@dataclass(frozen=True, slots=True)
class PoseDifference:
    """Largest pose difference of one frame [m], [rad]; infinite if one of the poses does not exist."""

    frame: str
    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class LimitDifference:
    """Different limits (lower, upper) of a position [m], [rad] or a speed [m/s], [rad/s]."""

    name: str
    before: tuple[float, float]
    after: tuple[float, float]


class BehaviourComparison:
    """Differences in poses and limits between two models, beyond a tolerance."""

    def __init__(self, before: ModelView, after: ModelView, tolerance: float) -> None:
        self.tolerance = tolerance
        self.helpers = [*find_helper_frames(before, after), *find_helper_frames(after, before)]
        self.frames = _partition_names(
            *([name for name in model.frames if name not in self.helpers] for model in (before, after))
        )
        old, new = ({str(s): s for s in model.degrees_of_freedom} for model in (before, after))
        self.freedoms = _partition_names(list(old), list(new))
        samples = StateSamples(before, after, count=COMPARED_STATES)
        self.states = samples.size
        found = [
            PoseDifference(frame, *_largest_pose_difference(*poses))
            for frame, poses in zip(
                self.frames["common"],
                _paired_poses(samples, before, after, self.frames["common"]),
                strict=True,
            )
        ]
        self.largest = (
            max((a.distance for a in found), default=0.0),
            max((a.angle for a in found), default=0.0),
        )
        self.apart = sorted(
            (a for a in found if max(a.distance, a.angle) > tolerance), key=lambda a: (-a.distance, -a.angle)
        )
        self.ranges = [
            LimitDifference(str(s), limits, others)
            for name in self.freedoms["common"]
            for s in (old[name], old[name].derivative())
            if not _limits_equal(
                limits := before.limits(s), others := after.limits(_matching_symbol(s, new[name])), tolerance
            )
        ]

    @property
    def equal(self) -> bool:
        """True if there are no differences beyond the tolerance."""
        sides = (self.frames, self.freedoms)
        return not (self.apart or self.ranges or any(s["added"] or s["removed"] for s in sides))


def _partition_names(before: list[str], after: list[str]) -> dict[str, list[str]]:
    old, new = set(before), set(after)
    return {
        "removed": [name for name in before if name not in new],
        "added": [name for name in after if name not in old],
        "common": [name for name in before if name in new],
    }


def _paired_poses(
    samples: StateSamples, before: ModelView, after: ModelView, frames: list[str]
) -> list[tuple[Array, ...]]:
    """Return the poses of each frame in both models, shape (states, 4, 4) each."""
    poses = samples.values([model.fk(frame) for frame in frames for model in (before, after)])
    return list(zip(poses[::2], poses[1::2], strict=True))


def _largest_pose_difference(
    one: Array,
    other: Array,
) -> tuple[float, float]:
    distances, angles = measure_pose_distances(one, other)
    return float(distances.max()), float(angles.max())


def _matching_symbol(symbol: Symbol, position: Symbol) -> Symbol:
    return position.derivative() if symbol.order else position


def _limits_equal(one: tuple[float, float], other: tuple[float, float], tolerance: float) -> bool:
    return all(
        a == b or math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance)
        for a, b in zip(one, other, strict=True)
    )


def find_helper_frames(model: ModelView, original: ModelView) -> list[str]:
    """Return the frames that a writer or a reader had to add to the original model.

    They have no body. Either they are between two frames that are parent and child in the original, with the
    name of their coordinate or a name below that of the child; or they are leaves with the name of their only
    coordinate.
    """
    candidates = {name for name in model.frames if name not in original.frames and name not in model.bodies}
    found = set(_find_links_between(model, original, candidates)) if candidates else set()
    parents = {frame.parent for frame in model.frames.values()}
    found.update(name for name in candidates - parents if _is_carrier(model, name))
    return [name for name in model.frames if name in found]


def _find_links_between(model: ModelView, original: ModelView, candidates: set[str]) -> Iterator[str]:
    for lower, frame in original.frames.items():
        if lower not in model.frames:
            continue
        chain = []
        above = model.frames[lower].parent
        while above in candidates and _has_helper_name(model, above, lower):
            chain.append(above)
            above = model.frames[above].parent
        if above == frame.parent:
            yield from chain


def _has_helper_name(model: ModelView, name: str, lower: str) -> bool:
    movers = (name, name.removesuffix("_joint"))
    return name.startswith(f"{lower}/") or any(mover in model.articulations for mover in movers)


def _is_carrier(model: ModelView, name: str) -> bool:
    moving = [s for s in model.fk(name, model.frames[name].parent).symbols if s.has_derivative]
    return len(moving) == 1 and name in (moving[0].path, f"{moving[0].path}/carrier")
