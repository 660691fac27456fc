"""Text about a live system for people: its processes and the age of their news, and what is done and why."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Final, NamedTuple

from kineverse.exchange.state import StateReader

from .streams import (
    ACTIVITY,
    CAMERA,
    COMMANDS,
    LEARNER,
    ROBOT,
    SUPERVISOR,
    TRACKER,
    TRUTH,
    ActivityNote,
    LearnerNote,
    ProcessRow,
    RobotNote,
    SupervisorNote,
    TrackerNote,
    read_note,
)

SOURCES: Final[Mapping[str, tuple[str, ...]]] = {
    "world": (ROBOT, CAMERA, TRUTH),
    "track": (TRACKER,),
    "learn": (LEARNER,),
    "behave": (ACTIVITY, COMMANDS),
    "live": (SUPERVISOR,),
}
"""Sources by the process that publishes them."""

PATIENCE: Final[Mapping[str, float]] = {
    ROBOT: 0.5, TRUTH: 0.5, TRACKER: 0.5, ACTIVITY: 2.0, LEARNER: 5.0, SUPERVISOR: 3.0,
}  # fmt: skip
"""Age of the news of a source from which on its process counts as frozen [s].

A camera that sees nothing, and a robot that nobody moves, are silent rightly.
"""

SERVER: Final = "serve"
_UNSEEN = 3.0  # time for which a coordinate may be unseen before it is said [s]
_MOST_NAMES, _MOST_RESULTS = 3, 3


class ProcessStatus(NamedTuple):
    """Process of a live system."""

    name: str
    state: str
    load: str  # share of a core
    starts: str
    news: str  # ages of its sources
    is_well: bool


HEAD: Final = ("process", "state", "CPU", "starts", "age of news")


def list_processes(
    ages: Mapping[str, float],
    supervisor: SupervisorNote | None = None,
    *,
    known: Collection[str] = (),
    is_online: bool = True,
) -> list[ProcessStatus]:
    """Return the processes of a live system.

    They are told by the ages of the sources that are there [s], and by the supervisor, if there is one. Of
    the known sources, those that are there no longer are gone. The model server is online if it answers.
    """
    rows = {} if supervisor is None else {row.name: row for row in supervisor.rows}
    found = []
    for name in dict.fromkeys((SERVER, *rows, *SOURCES)):
        sources = [source for source in SOURCES.get(name, ()) if source in ages or source in known]
        if name == SERVER and not is_online:
            found.append(ProcessStatus(name, "gone", "", "", "", False))
        elif name in rows or sources:
            found.append(_describe_process(name, rows.get(name), sources, ages))
    return found


def _describe_process(
    name: str, row: ProcessRow | None, sources: Iterable[str], ages: Mapping[str, float]
) -> ProcessStatus:
    gone = [source for source in sources if source not in ages and source in PATIENCE]
    silent = max((ages[s] for s in sources if ages.get(s, 0.0) > PATIENCE.get(s, math.inf)), default=0.0)
    state = "running" if row is None else row.state
    if state == "running" and (gone or silent):
        state = "gone" if gone and not silent else f"frozen for {silent:.0f} s"
    return ProcessStatus(
        name,
        state,
        "" if row is None or math.isnan(row.cpu) else f"{row.cpu:.0%}",
        "" if row is None else str(1 + row.restarts),
        ", ".join(f"{source} {format_age(ages[source])}" for source in sources if source in ages),
        state == "running",
    )


def format_age(age: float) -> str:
    """Return an age [s] as people read it."""
    return f"{1e3 * age:.0f} ms" if age < 1.0 else f"{age:.0f} s"


def describe_activity(note: ActivityNote | None) -> list[str]:
    """Return lines about what a behaviour does and why; the first one is what it does."""
    if note is None:
        return ["nothing is done: no behaviour is there"]
    lines = [f"{note.behaviour}: {note.doing}" if note.doing else note.behaviour]
    lines += [f"why: {note.why}"] if note.why else []
    lines += [f"phase: {note.phase}"] if note.phase else []
    if note.done or note.failed:
        lines.append(f"so far {note.done} done, {note.failed} failed")
    for result in reversed(note.results[-_MOST_RESULTS:]):
        ended = "done" if result.done else f"failed, {result.reason}"
        lines.append(f"{result.skill} {result.what}: {ended} ({result.seconds:.0f} s)")
    return lines + ([f"last: {note.last}"] if note.last and not note.results else [])


def describe_robot(robot: RobotNote | None, activity: ActivityNote | None = None) -> list[str]:
    """Return lines about force, time and late steps."""
    if robot is None:
        return []
    pace = [] if math.isnan(robot.force) else [f"force {robot.force:.0f} N"]
    pace += [f"real-time factor {robot.factor:.3f}", f"late {_share(robot.late, robot.ticks)} of ticks"]
    if activity is not None and activity.steps:
        pace[-1] += f", {_share(activity.late, activity.steps)} of control"
    counts = {"left out": robot.dropped, "commands too old": robot.refused}
    pace += [f"{what} {count}" for what, count in counts.items() if count]
    stopped = [f"stopped: {robot.stopped}"] if robot.stopped else []
    return [*stopped, " · ".join(pace)]


def describe_tracker(tracker: TrackerNote | None, now: float) -> list[str]:
    """Return lines about what is not known at a time of the robot [s]."""
    if tracker is None:
        return ["nothing is tracked: where things are is not known"]
    lost = set(tracker.lost)
    unseen = {name for name, at in tracker.seen.items() if now - at > _UNSEEN} - lost
    return [f"{what}: {_name(names)}" for what, names in (("lost", lost), ("unseen", unseen)) if names]


def describe_learner(learner: LearnerNote | None) -> list[str]:
    """Return lines about what is learned, what is doubted, and what is proposed."""
    if learner is None:
        return []
    lines = [f"learner: {learner.problem}"] if learner.problem else []
    for part in learner.watched:
        sure = "" if not part.family else f", {part.family} with {part.probability:.0%}"
        lines.append(f"learns {part.frame}: {part.state}{sure}")
    lines += [f"implausible: {tag}: {why}" for tag, why in learner.alarms.items()]
    for row in learner.proposals:
        lines.append(f"proposed: {row.what}" + (f" (waits for {row.waits})" if row.waits else ""))
    return [*lines, f"learned last: {learner.last}"] if learner.last else lines


def describe_all(reader: StateReader) -> list[str]:
    """Return all lines about the streams of a reader."""
    newest = reader.newest(ROBOT)
    robot, activity = read_note(reader, ROBOT, RobotNote), read_note(reader, ACTIVITY, ActivityNote)
    lines = describe_activity(activity) + describe_robot(robot, activity)
    if newest is not None:
        lines += describe_tracker(read_note(reader, TRACKER, TrackerNote), newest.stamp)
    return lines + describe_learner(read_note(reader, LEARNER, LearnerNote))


def _share(part: int, whole: int) -> str:
    return f"{part / max(whole, 1):.1%}"


def _name(names: Collection[str]) -> str:
    first = sorted(names)[:_MOST_NAMES]
    more = len(names) - len(first)
    return ", ".join(first) + (f" and {more} more" if more else "")
