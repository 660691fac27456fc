"""Results of benchmarks: measurements, and their ratios."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

Status: TypeAlias = Literal["met", "missed", "missing", "no bar"]


@dataclass(frozen=True, slots=True)
class Measurement:
    """Times of one contender.

    Attributes
    ----------
    name
        Whose it is.
    unit
        ``s`` for times, or what is counted.
    samples
        A number for each round; a single one for what does not vary.
    """

    name: str
    unit: str
    samples: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median time."""
        return statistics.median(self.samples)

    @property
    def best(self) -> float:
        """Best time, without disturbance."""
        return min(self.samples)


@dataclass(frozen=True, slots=True)
class Bar:
    """Target of a figure: at least, or at most, the limit."""

    limit: float
    at_least: bool

    def met_by(self, value: float) -> bool:
        """Return whether a figure reaches the target."""
        return value >= self.limit if self.at_least else value <= self.limit

    def __str__(self) -> str:
        return f"{'>=' if self.at_least else '<='} {self.limit:g}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """A figure made of measurements, and the bar it is held to.

    Attributes
    ----------
    name
        What it says.
    value
        The figure; None if a peer is missing.
    unit
        ``x`` for ratios, else as in measurements.
    bar
        What it is to reach, in the same unit; None if it is for information.
    ours, theirs
        Where it is a ratio of speeds: whose they are; empty where it is something else.
    """

    name: str
    value: float | None
    unit: str
    bar: Bar | None = None
    ours: str = ""
    theirs: str = ""

    @property
    def status(self) -> Status:
        """True if the target is reached."""
        if self.value is None:
            return "missing"
        if self.bar is None:
            return "no bar"
        return "met" if self.bar.met_by(self.value) else "missed"


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Result of a benchmark.

    Attributes
    ----------
    name
        The benchmark.
    work
        Description of the work.
    measurements
        Results of the contenders.
    comparisons
        Ratios of measurements.
    missing
        Missing peers, each with the advice to install it.
    """

    name: str
    work: str
    measurements: tuple[Measurement, ...]
    comparisons: tuple[Comparison, ...]
    missing: tuple[str, ...] = ()


def compare_speed(
    measured: Mapping[str, Measurement], ours: str, theirs: str, at_least: float | None = None
) -> Comparison:
    """Return the speed relative to a peer.

    It is the median, over the rounds, of the ratio within a round, as a machine that slows down for a while
    does so for both.

    Parameters
    ----------
    measured
        The measurements by name.
    ours, theirs
        Names of two of them; the second may be missing.
    at_least
        The bar.
    """
    bar = None if at_least is None else Bar(at_least, at_least=True)
    name = f"{ours}, beside {theirs}"
    if theirs not in measured:
        return Comparison(name, None, "x", bar, ours, theirs)
    pairs = zip(measured[theirs].samples, measured[ours].samples, strict=True)
    ratio = statistics.median(their / our for their, our in pairs)
    return Comparison(name, ratio, "x", bar, ours, theirs)


def bound_median(measurement: Measurement, limit: float) -> Comparison:
    """Return the median of a measurement, held to a limit in its own unit."""
    return Comparison(measurement.name, measurement.median, measurement.unit, Bar(limit, at_least=False))
