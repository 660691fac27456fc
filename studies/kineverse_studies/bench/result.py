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
        Contender.
    unit
        ``s`` for times, else the unit of the count.
    samples
        A number for each round; a single one if it does not vary.
    """

    name: str
    unit: str
    samples: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median of the samples."""
        return statistics.median(self.samples)

    @property
    def best(self) -> float:
        """Least of the samples."""
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
    """Figure computed from measurements, and its target.

    Attributes
    ----------
    name
        Description.
    value
        The figure; None if a peer is missing.
    unit
        ``x`` for ratios, else as in measurements.
    bar
        Target in the same unit; None if there is none.
    ours, theirs
        Contenders of a ratio of speeds; empty for other figures.
    """

    name: str
    value: float | None
    unit: str
    bar: Bar | None = None
    ours: str = ""
    theirs: str = ""

    @property
    def status(self) -> Status:
        """Status of the figure: target met or missed, peer missing, or no target."""
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
        Measurements of all contenders.
    comparisons
        Figures computed from them.
    missing
        A line for each missing peer, with advice.
    """

    name: str
    work: str
    measurements: tuple[Measurement, ...]
    comparisons: tuple[Comparison, ...]
    missing: tuple[str, ...] = ()


def compare_speed(
    measured: Mapping[str, Measurement], ours: str, theirs: str, at_least: float | None = None
) -> Comparison:
    """Return the speed of a contender relative to a peer.

    It is the median over the rounds of the ratio within a round, because a temporary slowdown of the machine
    affects both.
    """
    bar = None if at_least is None else Bar(at_least, at_least=True)
    name = f"{ours}, beside {theirs}"
    if theirs not in measured:
        return Comparison(name, None, "x", bar, ours, theirs)
    pairs = zip(measured[theirs].samples, measured[ours].samples, strict=True)
    ratio = statistics.median(their / our for their, our in pairs)
    return Comparison(name, ratio, "x", bar, ours, theirs)


def bound_median(measurement: Measurement, limit: float) -> Comparison:
    """Return the median of a measurement, with an upper limit in its unit as the target."""
    return Comparison(measurement.name, measurement.median, measurement.unit, Bar(limit, at_least=False))
