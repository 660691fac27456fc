"""Plausibility monitor on streams: false alarms, CPU time of a look, and looks until an alarm."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from kineverse.estimation import PlausibilityMonitor, pose_covariance
from kineverse.lie import Array, rotation_z
from kineverse.model.model import Model

from .observations import (
    DOOR,
    FRAMES,
    ORIENTATION,
    POSITION,
    RATE,
    Stream,
    StreamErrors,
    hand_motion,
    simulate_stream,
)

TURNED = np.pi / 4
"""Angle of the door from which looks until an alarm are counted [rad]."""

PERIOD = 60.0
"""Time after which the hand's motion repeats [s]."""

WHITE = StreamErrors(correlation=0.0, share=0.0)
"""Errors without correlation, with dropouts and outliers."""

# Time in which the hand shuts the door before its motion repeats [s].
_SHUTTING = 3.5

MakeStream: TypeAlias = Callable[[Model, np.random.Generator, float, StreamErrors | None], Stream]


@dataclass(frozen=True)
class MonitoringRow:
    """Results of the monitor on streams of one kind."""

    case: str  # description of the streams
    runs: int  # number of streams, and of looks in all of them until the alarms
    looks: int
    alarms: int  # number of streams with an alarm
    median: float
    worst: float
    cpu: float  # mean CPU time of a look and its 99th percentile [ms]
    cpu_99: float

    def __str__(self) -> str:
        after = (
            "" if np.isnan(self.median) else f", {self.median:.0f} looks after 45° (worst {self.worst:.0f})"
        )
        return (
            f"{self.case}: alarms in {self.alarms} of {self.runs} streams ({self.looks} looks){after}; "
            f"{self.cpu:.2f} ms a look (p99 {self.cpu_99:.2f})"
        )


def measure_monitoring(
    model: Model, seeds: int = 20, minutes: float = 6.0, displacements: tuple[float, ...] = (0.02, 0.01)
) -> list[MonitoringRow]:
    """Run the monitor over streams of a door as modelled, and of doors with a displaced axis."""
    long, short = 60.0 * minutes, PERIOD
    rows = [
        _measure("as modelled", model, seeds, long, _as_modelled, None),
        _measure("as modelled, white noise", model, seeds, long / 6.0, _as_modelled, WHITE),
    ]
    for size in displacements:
        for where, errors in (("", None), (", white noise", WHITE)):
            case = f"axis {100.0 * size:.0f} cm off{where}"
            rows.append(_measure(case, model, seeds, short, _displaced(size, True), errors))
            rows.append(_measure(f"{case}, door too", model, seeds, short, _displaced(size, False), errors))
    return rows


def repeated_motion(times: Array) -> Array:
    """Return angles (N,) of a door whose hand motion repeats each :data:`PERIOD`, shut in between [rad]."""
    within = np.mod(times, PERIOD)
    share = np.clip((within - (PERIOD - _SHUTTING)) / _SHUTTING, 0.0, 1.0)
    return np.asarray(hand_motion(within) * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)))


def _as_modelled(
    model: Model, random: np.random.Generator, duration: float, errors: StreamErrors | None
) -> Stream:
    times = np.arange(round(duration * RATE)) / RATE
    return simulate_stream(model, repeated_motion(times), random, errors)


def _displaced(size: float, same_when_shut: bool) -> MakeStream:
    """Return a maker of streams of a door with a displaced axis.

    The shut door is at its modelled place if ``same_when_shut``; otherwise the door is displaced too.
    """

    def make(
        model: Model, random: np.random.Generator, duration: float, errors: StreamErrors | None
    ) -> Stream:
        stream = _as_modelled(model, random, duration, errors)
        direction = random.uniform(0.0, 2.0 * np.pi)
        offset = size * np.array([np.cos(direction), np.sin(direction), 0.0])
        away = np.broadcast_to(offset, (len(stream.times), 3))
        if same_when_shut:
            # A rotation about a displaced axis is q ↦ R q + (1 - R) d.
            away = away - rotation_z(stream.angles) @ offset
        shut = model.fk(FRAMES[0])({DOOR: 0.0})
        poses = stream.poses.copy()
        poses[:, :, :3, 3] += (away @ shut[:3, :3].T)[:, None]
        return replace(stream, poses=poses)

    return make


def _measure(
    case: str, model: Model, seeds: int, duration: float, make: MakeStream, errors: StreamErrors | None
) -> MonitoringRow:
    delays: list[float] = []
    spent: list[float] = []
    for seed in range(seeds):
        stream = make(model, np.random.default_rng(seed), duration, errors)
        turned = int(np.argmax(stream.angles >= TURNED))
        monitor = PlausibilityMonitor(model, FRAMES, noise=pose_covariance(POSITION, ORIENTATION))
        delay = np.inf
        for k, at in enumerate(stream.times):
            look = stream.look(k)
            began = time.thread_time()
            alarm = monitor.update(look, at=at)
            spent.append(1e3 * (time.thread_time() - began))
            if alarm:
                delay = float(k - turned)
                break
        delays.append(delay)
    alarms = int(np.isfinite(delays).sum())
    median, worst = (float(np.median(delays)), float(np.max(delays))) if alarms else (np.nan, np.nan)
    return MonitoringRow(
        case,
        seeds,
        len(spent),
        alarms,
        median,
        worst,
        float(np.mean(spent)),
        float(np.percentile(spent, 99)),
    )
