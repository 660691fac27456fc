"""``stream``: a door that a hand opens, tracked at 30 Hz with correlated errors and outliers.

Trackers are told nothing but the noise. They are compared with a textbook filter whose process noise is
chosen with hindsight, and which starts at the truth. The monitor tests the model in the same streams.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.estimation import ImplausibleError, ObservedPose, PlausibilityMonitor, Tracker, pose_covariance
from kineverse.estimation.tracking.process_model import Process
from kineverse.expressions.expression import array
from kineverse.formats import load
from kineverse.lie import Array, exp_so3, pose_difference, retract, rotation_z, transform
from kineverse.model.model import Model
from kineverse.view.plots import Figure

from .registry import Options, Progress
from .report import Report, ReportTable, format_fixed, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

DOOR = "kitchen/fridge_door"
FRAMES = (DOOR, "kitchen/fridge_door_handle")
"""Coordinate of the door, and the two frames on it that carry markers."""
RATE = 30.0  # looks per second
POSITION, ORIENTATION = 0.004, math.radians(1.5)
"""Standard deviations of each coordinate of a marker [m] and about each axis [rad]."""
OPENED, HALF_SHUT, MOVING_TIME = 10.0, 34.0, 3.5
"""Times at which a hand begins to open and to half shut the door, and the duration of each motion [s]."""
OPEN_ANGLE, HALF_SHUT_ANGLE = 1.3, 0.65  # angles of the open and of the half shut door [rad]


@dataclass(frozen=True)
class StreamErrors:
    correlation: float = 0.95
    share: float = 0.7
    dropouts: float = 0.15  # fractions of markers that are missing, and that are somewhere else
    outliers: float = 0.05
    reach: float = 2.0  # outliers are uniform in a cube of this edge about the marker [m], in any orientation


@dataclass(frozen=True, eq=False)
class Stream:
    times: Array  # times of the looks (N,) [s]
    angles: Array  # true angles of the door (N,) [rad]
    poses: Array  # measured poses of the markers (N, 2, 4, 4)
    seen: npt.NDArray[np.bool_]  # true where a marker was seen, and where its pose is an outlier (N, 2)
    gross: npt.NDArray[np.bool_]

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """True while the door turns (N,)."""
        speed = np.abs(np.gradient(self.angles, self.times))
        return np.asarray(speed > 1e-6)

    def look(self, k: int) -> dict[str, Array]:
        return {frame: self.poses[k, i] for i, frame in enumerate(FRAMES) if self.seen[k, i]}


def hand_motion(times: Array) -> Array:
    """Return the angles (N,) of a door that a hand opens, and later half shuts, smoothly (minimum jerk)."""

    def share(began: float) -> Array:
        t = np.clip((times - began) / MOVING_TIME, 0.0, 1.0)
        return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))

    return OPEN_ANGLE * share(OPENED) - (OPEN_ANGLE - HALF_SHUT_ANGLE) * share(HALF_SHUT)


def simulate_stream(
    model: Model, angles: Array, random: np.random.Generator, errors: StreamErrors | None = None
) -> Stream:
    """Return a stream of looks at a door with the given angles (N,), one for each look."""
    errors = StreamErrors() if errors is None else errors
    count = len(angles)
    true = np.stack(
        [compile(model.fk(f), [model.symbol(DOOR)]).batch(angles[:, None]) for f in FRAMES], axis=1
    )
    deviations = np.array([POSITION] * 3 + [ORIENTATION] * 3)
    noise = correlated_errors(count, (len(FRAMES), 6), random, errors) * deviations
    poses = retract(true, noise)
    gross = random.random((count, len(FRAMES))) < errors.outliers
    wrong = int(gross.sum())
    away = random.uniform(-errors.reach / 2, errors.reach / 2, (wrong, 3))
    turns = exp_so3(random.uniform(0, math.pi, (wrong, 1)) * _directions(random, wrong))
    poses[gross] = transform(turns, true[gross][:, :3, 3] + away)
    seen = random.random((count, len(FRAMES))) >= errors.dropouts
    return Stream(np.arange(count) / RATE, angles, poses, seen, gross)


def correlated_errors(
    count: int, shape: tuple[int, ...], random: np.random.Generator, errors: StreamErrors
) -> Array:
    """Return errors of unit variance (count, *shape): a stationary first-order process and white noise."""
    white = random.standard_normal((count, *shape))
    slow = np.empty((count, *shape))
    slow[0] = random.standard_normal(shape)
    innovation = math.sqrt(1.0 - errors.correlation**2) * random.standard_normal((count, *shape))
    for k in range(1, count):
        slow[k] = errors.correlation * slow[k - 1] + innovation[k]
    return math.sqrt(errors.share) * slow + math.sqrt(1.0 - errors.share) * white


def _directions(random: np.random.Generator, count: int) -> Array:
    vectors = random.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


GATE = 22.46  # χ² with six degrees of freedom that is exceeded once in a thousand
Markers = Callable[[float], Array]  # function that returns the poses of the markers (2, 4, 4) at an angle
_STEP = 1e-6


def run_gated_filter(stream: Stream, markers: Markers, acceleration: float) -> tuple[Array, Array]:
    """Return angles and their variances after each look (N,), (N,); it starts at the true angle."""
    noise = np.diag([POSITION**2] * 3 + [ORIENTATION**2] * 3)
    x, p, before = np.array([stream.angles[0], 0.0]), np.diag([0.01, 0.01]), float(stream.times[0])
    angles, variances = [], []
    for k, now in enumerate(stream.times.tolist()):
        dt = now - before
        before, move = now, np.array([[1.0, dt], [0.0, 1.0]])
        x = move @ x
        p = move @ p @ move.T + acceleration * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        for i in np.flatnonzero(stream.seen[k]).tolist():
            expected = markers(float(x[0]))[i]
            slope = pose_difference(markers(float(x[0]) + _STEP)[i], expected) / _STEP
            residual, jacobian = pose_difference(stream.poses[k, i], expected), np.zeros((6, 2))
            jacobian[:, 0] = slope
            spread = jacobian @ p @ jacobian.T + noise
            if float(residual @ np.linalg.solve(spread, residual)) > GATE:
                continue
            gain = p @ jacobian.T @ np.linalg.inv(spread)
            x, p = x + gain @ residual, (np.eye(2) - gain @ jacobian) @ p
        angles.append(float(x[0]))
        variances.append(float(p[0, 0]))
    return np.array(angles), np.array(variances)


DURATION = 60.0  # length of a stream [s]
ACCELERATIONS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Noise of the textbook filter [rad²/s³]; that with the least error while moving counts."""
PROCESSES: tuple[Process, ...] = ("position", "velocity")
_SETTLED = 1.0
_WRONG = 5.0


@dataclass(frozen=True, eq=False)
class TrackedStream:
    stream: Stream
    angles: Array  # estimates and their variances (N,)
    variances: Array
    lost: Array  # true where the filter says that it is lost (N,)
    seconds: Array  # CPU time of each update (N,) [s]; empty if it was not measured

    @property
    def errors(self) -> Array:
        """Errors of the angle (N,) [rad]."""
        return self.angles - self.stream.angles

    @property
    def longest_silently_lost(self) -> float:
        """Longest time with errors beyond five stated deviations that is not said to be lost [s]."""
        wrong = (np.abs(self.errors) > _WRONG * np.sqrt(self.variances)) & ~self.lost.astype(bool)
        longest = run = 0
        for each in wrong.tolist():
            run = run + 1 if each else 0
            longest = max(longest, run)
        return longest / RATE


@dataclass(frozen=True)
class TrackingSummary:
    name: str
    moving: float  # root mean square error while the door moves, and at rest after the first second [rad]
    resting: float
    nees: float  # mean normalised estimation error squared after the first second, over each whole stream
    worst_nees: float  # the same of the stream where it is farthest from 1
    silently_lost: float  # longest time that a filter was lost without saying so [s]
    lost: float  # share of the time that it said to be lost
    mean_time: float  # CPU time of an update: mean, and what one in a hundred exceeds [s]
    high_time: float


def make_streams(
    model: Model, seeds: Iterable[int], progress: Progress, duration: float = DURATION
) -> list[Stream]:
    angles = hand_motion(np.arange(round(duration * RATE)) / RATE)
    seeds = progress(list(seeds), "stream: observations", "seed")
    return [simulate_stream(model, angles, np.random.default_rng(seed)) for seed in seeds]


def make_door_tracker(model: Model, process: Process) -> Tracker:
    noise = pose_covariance(POSITION, ORIENTATION)
    tracker = Tracker(
        model, [ObservedPose(frame, covariance=noise) for frame in FRAMES], process=process, outliers=True
    )
    tracker.wait()
    return tracker


def track_stream(tracker: Tracker, stream: Stream) -> TrackedStream:
    tracker = tracker.copy()
    looks = [stream.look(k) for k in range(len(stream.times))]
    angles, variances, lost, seconds = [], [], [], []
    for look, at in zip(looks, stream.times.tolist(), strict=True):
        began = time.process_time()
        estimate = tracker.update(look, at=at)
        angles.append(estimate.state[DOOR])
        seconds.append(time.process_time() - began)
        variances.append(estimate.deviation[DOOR] ** 2)
        lost.append(estimate.lost)
    return TrackedStream(stream, np.array(angles), np.array(variances), np.array(lost), np.array(seconds))


def run_trackers(
    model: Model, streams: Sequence[Stream], progress: Progress
) -> dict[str, list[TrackedStream]]:
    results: dict[str, list[TrackedStream]] = {}
    for process in PROCESSES:
        tracker = make_door_tracker(model, process)
        results[process] = [
            track_stream(tracker, stream) for stream in progress(streams, f"stream: {process}", "stream")
        ]
    results["textbook"] = run_textbook_filter(model, streams, progress)
    return results


def run_textbook_filter(model: Model, streams: Sequence[Stream], progress: Progress) -> list[TrackedStream]:
    poses = compile(
        array([entry for frame in FRAMES for entry in model.fk(frame).reshape(16)]), [model.symbol(DOOR)]
    )

    def markers(angle: float) -> Array:
        return np.asarray(poses(np.array([angle]))).reshape(len(FRAMES), 4, 4)

    tried = []
    for acceleration in progress(ACCELERATIONS, "stream: textbook filter", "noise"):
        found = []
        for stream in streams:
            angles, variances = run_gated_filter(stream, markers, acceleration)
            found.append(TrackedStream(stream, angles, variances, np.zeros(len(angles)), np.empty(0)))
        tried.append(found)
    return min(tried, key=lambda found: summarize_tracking("", found).moving)


def summarize_tracking(name: str, results: Sequence[TrackedStream]) -> TrackingSummary:
    moving = np.concatenate([r.errors[r.stream.moving] for r in results])
    resting = np.concatenate([r.errors[~r.stream.moving & (r.stream.times > _SETTLED)] for r in results])
    nees = [float(np.mean((r.errors**2 / r.variances)[r.stream.times > _SETTLED])) for r in results]
    seconds = np.concatenate([r.seconds for r in results])
    return TrackingSummary(
        name,
        float(np.sqrt(np.mean(moving**2))),
        float(np.sqrt(np.mean(resting**2))),
        float(np.mean(nees)),
        max(nees, key=lambda each: abs(np.log(each))),
        max(r.longest_silently_lost for r in results),
        float(np.mean([r.lost.mean() for r in results])),
        float(seconds.mean()) if len(seconds) else np.nan,
        float(np.percentile(seconds, 99)) if len(seconds) else np.nan,
    )


def summarize_trackers(results: Mapping[str, Sequence[TrackedStream]]) -> list[TrackingSummary]:
    return [summarize_tracking(name, found) for name, found in results.items()]


TURNED = np.pi / 4  # angle of the door from which looks until an alarm are counted [rad]
PERIOD = 60.0  # time after which the hand's motion repeats [s]
WHITE = StreamErrors(correlation=0.0, share=0.0)  # errors without correlation, with dropouts and outliers
_SHUTTING = 3.5  # time in which the hand shuts the door before its motion repeats [s]


@dataclass(frozen=True)
class MonitoringRow:
    case: str  # description of the streams
    runs: int  # number of streams, and of looks in all of them until the alarms
    looks: int
    alarms: int  # number of streams with an alarm
    median: float
    worst: float
    cpu: float  # mean CPU time of a look and its 99th percentile [ms]
    cpu_99: float


def measure_monitoring(
    model: Model, seeds: int = 20, minutes: float = 6.0, displacements: tuple[float, ...] = (0.02, 0.01)
) -> list[MonitoringRow]:
    """Run the monitor over streams of a door as modelled, and of doors with a displaced axis."""
    long, short = 60.0 * minutes, PERIOD
    rows = [
        _measure("as modelled", model, seeds, long, None),
        _measure("as modelled, white noise", model, seeds, long / 6.0, WHITE),
        _measure("as modelled, 10 % outliers", model, seeds, long / 6.0, StreamErrors(outliers=0.1)),
        # The axis is off at first, and the monitor goes on after the repair.
        _measure("repaired, axis 3 cm off before", model, seeds, long, None, 0.03, False, True),
    ]
    for size in displacements:
        for where, errors in (("", None), (", white noise", WHITE)):
            case = f"axis {100.0 * size:.0f} cm off{where}"
            rows.append(_measure(case, model, seeds, short, errors, size))
            rows.append(_measure(f"{case}, door too", model, seeds, short, errors, size, False))
    return rows


def repeated_motion(times: Array) -> Array:
    """Return angles (N,) of a door whose hand motion repeats each :data:`PERIOD`, shut in between [rad]."""
    within = np.mod(times, PERIOD)
    share = np.clip((within - (PERIOD - _SHUTTING)) / _SHUTTING, 0.0, 1.0)
    return np.asarray(hand_motion(within) * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)))


def _simulate(
    model: Model,
    random: np.random.Generator,
    duration: float,
    errors: StreamErrors | None,
    displacement: float,
    same_when_shut: bool,
) -> Stream:
    """Return a stream of a displaced axis [m]; the shut door is at its modelled place, or displaced too."""
    times = np.arange(round(duration * RATE)) / RATE
    stream = simulate_stream(model, repeated_motion(times), random, errors)
    if not displacement:
        return stream
    direction = random.uniform(0.0, 2.0 * np.pi)
    offset = displacement * np.array([np.cos(direction), np.sin(direction), 0.0])
    away = np.broadcast_to(offset, (len(stream.times), 3))
    if same_when_shut:
        # A rotation about a displaced axis is q ↦ R q + (1 - R) d.
        away = away - rotation_z(stream.angles) @ offset
    shut = model.fk(FRAMES[0])({DOOR: 0.0})
    poses = stream.poses.copy()
    poses[:, :, :3, 3] += (away @ shut[:3, :3].T)[:, None]
    return replace(stream, poses=poses)


def _measure(
    case: str,
    model: Model,
    seeds: int,
    duration: float,
    errors: StreamErrors | None,
    displacement: float = 0.0,
    same_when_shut: bool = True,
    is_repaired: bool = False,
) -> MonitoringRow:
    delays: list[float] = []
    spent: list[float] = []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        stream = _simulate(model, random, duration, errors, displacement, same_when_shut)
        turned = int(np.argmax(stream.angles >= TURNED))
        served = model.copy() if is_repaired else model
        monitor = PlausibilityMonitor(served, FRAMES, noise=pose_covariance(POSITION, ORIENTATION))
        wrong = is_repaired
        delays.append(np.inf)
        for k, at in enumerate(stream.times):
            look = stream.look(k)
            began = time.thread_time()
            alarm = monitor.update(look, at=at)
            spent.append(1e3 * (time.thread_time() - began))
            if wrong:
                wrong = k % RATE != 0 or not _repair(served, monitor)
            elif alarm:
                delays[-1] = float(k - turned)
                break
    alarms = int(np.isfinite(delays).sum())
    median, worst = (float(np.median(delays)), float(np.max(delays))) if alarms else (np.nan, np.nan)
    cpu = float(np.mean(spent)), float(np.percentile(spent, 99))
    return MonitoringRow(case, seeds, len(spent), alarms, median, worst, *cpu)


def _repair(model: Model, monitor: PlausibilityMonitor) -> bool:
    """Return True if a report replaces a joint, which takes an alarm and enough of the motion."""
    try:
        return bool(monitor.report().repair(model)) if monitor.implausible_since else False
    except ImplausibleError:
        return False


FIGURE_SIZE = (11.0, 8.0)


def make_report(tracked: Mapping[str, Sequence[TrackedStream]], monitored: Sequence[MonitoringRow]) -> Report:
    summaries = summarize_trackers(tracked)
    count = len(next(iter(tracked.values())))
    table = make_table(
        f"Tracking, {count} streams of a minute",
        summaries,
        {
            "process": lambda s: s.name,
            "RMSE moving [mrad]": lambda s: format_fixed(s.moving, 2, 1e3),
            "RMSE at rest [mrad]": lambda s: format_fixed(s.resting, 2, 1e3),
            "NEES": lambda s: format_fixed(s.nees),
            "worst stream": lambda s: format_fixed(s.worst_nees),
            "silently lost [s]": lambda s: format_fixed(s.silently_lost),
            "lost [%]": lambda s: format_fixed(s.lost, 1, 100),
            "update [ms CPU]": lambda s: format_fixed(s.mean_time, 2, 1e3),
            "99 of 100 within": lambda s: format_fixed(s.high_time, 2, 1e3),
        },
    )
    return Report(
        name="stream",
        title=(
            f"A door that a hand moves, seen by two markers at 30 Hz: {1000 * POSITION:.0f} mm, "
            f"{math.degrees(ORIENTATION):.1f}°, correlated errors, dropouts, outliers"
        ),
        tables=(table, monitoring_table(monitored)),
        numbers={"tracking": summaries, "monitoring": monitored},
        figure=Figure(lambda canvas: draw_stream(canvas, tracked), FIGURE_SIZE),
    )


def monitoring_table(rows: Sequence[MonitoringRow]) -> ReportTable:
    return make_table(
        "Monitor of the model's plausibility",
        rows,
        {
            "door": lambda row: row.case,
            "streams": lambda row: row.runs,
            "alarms": lambda row: row.alarms,
            "looks from 45° to the alarm": lambda row: format_fixed(row.median, 0),
            "worst": lambda row: format_fixed(row.worst, 0),
            "look [ms CPU]": lambda row: format_fixed(row.cpu),
            "99 of 100 within": lambda row: format_fixed(row.cpu_99),
        },
    )


def draw_stream(canvas: Canvas, tracked: Mapping[str, Sequence[TrackedStream]]) -> None:
    """Draw the first stream: the angle, and the error of each filter with its stated deviation."""
    top, *others = canvas.subplots(1 + len(tracked), 1, sharex=True)
    first = next(iter(tracked.values()))[0].stream
    top.plot(first.times, np.degrees(first.angles), color="0.2")
    top.set(ylabel="door [°]", title="one stream")
    for axes, (name, results) in zip(others, tracked.items(), strict=True):
        found = results[0]
        spread = np.degrees(np.sqrt(found.variances))
        axes.fill_between(first.times, -2 * spread, 2 * spread, color="tab:blue", alpha=0.2, linewidth=0.0)
        axes.plot(first.times, np.degrees(found.errors), color="tab:blue", linewidth=0.8)
        axes.set(ylabel=f"{name}\nerror [°]", ylim=(-2.5, 2.5))
    others[-1].set(xlabel="time [s]")


OPTIONS = ("quick",)
SEEDS, QUICK_SEEDS = 20, 2
MINUTES, QUICK_MINUTES = 6.0, 1.0  # length of each stream of the monitor [min]


def run(progress: Progress, options: Options) -> Report:
    """Track and monitor the streams; the option ``quick`` reduces 20 seeds to 2, and their length."""
    model = load("kitchen")
    seeds = QUICK_SEEDS if options.quick else SEEDS
    tracked = run_trackers(model, make_streams(model, range(seeds), progress), progress)
    minutes = QUICK_MINUTES if options.quick else MINUTES
    return make_report(tracked, measure_monitoring(model, seeds, minutes))
