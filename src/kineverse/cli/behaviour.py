"""What two models do, however they are made: where their frames are, and how far they move."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kineverse.formats.export.additions import added_frames
from kineverse.model.delta import poses_apart
from kineverse.model.samples import Array, Samples
from kineverse.model.view import ModelView
from kineverse.symbols import Symbol

STATES = 100


@dataclass(frozen=True, slots=True)
class Apart:
    """A frame that is elsewhere: at worst, by how much [m], [rad]; infinite if on one side it is nowhere."""

    frame: str
    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class Range:
    """Limits (lower, upper) that differ, of a position [m], [rad] or a speed [m/s], [rad/s]."""

    name: str
    before: tuple[float, float]
    after: tuple[float, float]


class Behaviour:
    """What two models do differently, by more than a tolerance.

    Attributes
    ----------
    frames, freedoms
        Names of frames and degrees of freedom, by whether they are ``added``, ``removed`` or ``common``.
    helpers
        Frames that only one has because of its format, which are not counted: neither added nor removed.
    apart
        Frames of both that are elsewhere in the world in one of the sampled states, the worst first.
    ranges
        Limits that differ, of degrees of freedom that both have.
    largest
        The largest distance [m] and angle [rad] of any frame, in the tolerance or not.
    states
        In how many states poses were compared.
    """

    def __init__(self, before: ModelView, after: ModelView, tolerance: float) -> None:
        self.tolerance = tolerance
        self.helpers = [*added_frames(before, after), *added_frames(after, before)]
        self.frames = _sides(
            *([name for name in model.frames if name not in self.helpers] for model in (before, after))
        )
        old, new = ({str(s): s for s in model.degrees_of_freedom} for model in (before, after))
        self.freedoms = _sides(list(old), list(new))
        samples = Samples(before, after, count=STATES)
        self.states = samples.size
        found = [
            Apart(frame, *_worst(*poses))
            for frame, poses in zip(
                self.frames["common"],
                _paired(samples, before, after, self.frames["common"]),
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
            Range(str(s), limits, others)
            for name in self.freedoms["common"]
            for s in (old[name], old[name].derivative())
            if not _alike(
                limits := before.limits(s), others := after.limits(_counterpart(s, new[name])), tolerance
            )
        ]

    @property
    def equal(self) -> bool:
        """Whether they do the same."""
        sides = (self.frames, self.freedoms)
        return not (self.apart or self.ranges or any(s["added"] or s["removed"] for s in sides))


def _sides(before: list[str], after: list[str]) -> dict[str, list[str]]:
    old, new = set(before), set(after)
    return {
        "removed": [name for name in before if name not in new],
        "added": [name for name in after if name not in old],
        "common": [name for name in before if name in new],
    }


def _paired(
    samples: Samples, before: ModelView, after: ModelView, frames: list[str]
) -> list[tuple[Array, ...]]:
    """Return, for each frame, its poses in both models, (states, 4, 4) each."""
    poses = samples.values([model.fk(frame) for frame in frames for model in (before, after)])
    return list(zip(poses[::2], poses[1::2], strict=True))


def _worst(
    one: Array,
    other: Array,
) -> tuple[float, float]:
    distances, angles = poses_apart(one, other)
    return float(distances.max()), float(angles.max())


def _counterpart(symbol: Symbol, position: Symbol) -> Symbol:
    return position.derivative() if symbol.order else position


def _alike(one: tuple[float, float], other: tuple[float, float], tolerance: float) -> bool:
    return all(
        a == b or math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance)
        for a, b in zip(one, other, strict=True)
    )
