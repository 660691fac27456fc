"""``geometry``: what is near, with distances, points and normals, while things move step by step."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from kineverse.geometry import Scene
from kineverse.geometry.sweep_native import sweep_library

from .agreement import Array, check_agreement
from .crowd import LINKS, RADIUS, RULES, crowd
from .crowd_peers import Finder, Mujoco, MujocoPairs, OurScene, PlainCoal
from .kitchen_robot import KitchenRobot, kitchen_robot
from .peers import Field, advice, installed
from .result import Bar, Comparison, Measurement, Result, at_most, faster
from .room_peers import BulletInRoom, MujocoInRoom, Room
from .settings import Settings
from .timing import Contender, race

OURS, COAL = "kineverse", "coal and numpy"
SEARCH, PAIRS, BULLET = "mujoco, mj_collision", "mujoco, mj_geomDistance and numpy", "bullet"
UPDATE, QUERY = "update", "query"

_EXACT, _CURVED, _MARGINS = 1e-6, 1e-4, 3e-3
"""How far distances may be apart [m]: of polytopes and capsules; of whatever a robot has; of Bullet with
its margins."""

_NEAR, _WHOLE = 0.06, " without rules, within .06 m"
"""A radius [m] at which the robot's own links, many of which always overlap, are most of what is found."""

_CHECKED = 20


@dataclass(frozen=True)
class Entry:
    """Someone who finds what is near, and how exact that is [m]."""

    name: str
    finder: Finder
    accuracy: float


def measure(settings: Settings) -> Result:
    """Measure an arm among boxes, among more boxes with as many near, and a robot in a kitchen."""
    sweep_library.prepare(wait=True)
    steps = min(settings.configurations, settings.steps)
    sizes = [settings.boxes // part for part in (30, 10, 3, 1)]
    field = Field()
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        arm = list(_among_boxes(field, Path(folder), steps))
        robot = kitchen_robot(steps)
        rooms = list(_in_a_room(robot))
        angles = crowd(steps=steps).angles
        check(arm, angles)
        check(rooms, robot.values)
        everything = [
            Entry(f"{robot.name}: {OURS}{_WHOLE}", OurScene(robot.whole_scene(), _NEAR), _CURVED),
            Entry(f"{robot.name}: {COAL}{_WHOLE}", PlainCoal(robot.whole_scene(), _NEAR), _CURVED),
        ]
        many = [
            Entry(f"{OURS} among {boxes} boxes", OurScene(_scene(Path(folder), boxes, steps)), _EXACT)
            for boxes in sizes
        ]
        field.contenders += [*_timed(arm, angles), *_timed(many, angles), *_timed(rooms, robot.values)]
        field.contenders += _timed(everything, robot.values)
        measured = race("geometry", field.contenders, settings.rounds, settings.progress)
    peers = (SEARCH, PAIRS, BULLET, COAL)
    room = {name: f"{robot.name}: {name}, {QUERY}" for name in (OURS, SEARCH, BULLET, COAL)}
    whole = f"{robot.name}: {OURS}{_WHOLE}, {QUERY}"
    return Result(
        name="geometry",
        work=(
            f"an arm of {LINKS} hulls, boxes and capsules among 60 boxes: all pairs within {RADIUS} m with "
            f"distance, points and normal, {steps} steps of about 0.002 rad a joint; a query is what comes "
            "after the update of the poses"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            at_most(measured[f"{OURS}, {QUERY}"], 40e-6),
            *(faster(measured, f"{OURS}, {QUERY}", f"{peer}, {QUERY}", 1.0) for peer in peers),
            *(faster(measured, f"{OURS}, {UPDATE}", f"{peer}, {UPDATE}") for peer in peers),
            faster(measured, room[OURS], room[SEARCH]),
            *(faster(measured, room[OURS], room[peer], 1.0) for peer in (BULLET, COAL)),
            at_most(measured[whole], 150e-6),
            faster(measured, whole, room[OURS]),
            faster(measured, whole, f"{robot.name}: {COAL}{_WHOLE}, {QUERY}", 1.0),
            _growth(measured, sizes),
        ),
        missing=tuple(field.missing),
    )


def check(entries: Sequence[Entry], rows: Array) -> None:
    """Compare what everybody finds at some states with what the first one finds.

    A pair that is found by one and not by another counts as being at the radius for the other, so that only
    those may be missing that are next to it. Depths in penetration are not compared: they count as touching.

    Raises
    ------
    DisagreementError
        If distances differ by more than the accuracy of either.
    """
    for row in rows[:: max(len(rows) // _CHECKED, 1)]:
        found = [_distances(entry.finder, row) for entry in entries]
        pairs = sorted({pair for each in found for pair in each})
        table = [np.array([each.get(pair, RADIUS) for pair in pairs]) for each in found]
        for entry, distances in zip(entries[1:], table[1:], strict=True):
            names = [(entries[0].name, [table[0]]), (entry.name, [distances])]
            check_agreement("geometry", names, entry.accuracy)


def _distances(finder: Finder, row: Array) -> dict[tuple[str, str], float]:
    finder.put(row)
    finder.find()
    least: dict[tuple[str, str], float] = {}
    for a, b, distance in finder.distances():
        pair = min(a, b), max(a, b)
        least[pair] = min(least.get(pair, RADIUS), max(distance, 0.0))
    return least


def _among_boxes(field: Field, folder: Path, steps: int) -> Iterator[Entry]:
    arm = crowd(steps=steps)
    yield Entry(OURS, OurScene(_scene(folder, 60, steps)), _EXACT)
    yield Entry(COAL, PlainCoal(_scene(folder, 60, steps)), _EXACT)
    if installed("mujoco"):
        yield Entry(SEARCH, Mujoco(arm), _EXACT)
        yield Entry(PAIRS, MujocoPairs(arm), _EXACT)
    else:
        field.admit("mujoco", list)
    if installed("pybullet"):
        from .bullet_crowd import Bullet

        yield Entry(BULLET, Bullet(arm), _MARGINS)
    else:
        field.missing.append(advice("pybullet"))


def _in_a_room(robot: KitchenRobot) -> Iterator[Entry]:
    """Yield who takes part where a robot moves; who does not is missed by :func:`_among_boxes`."""
    yield Entry(f"{robot.name}: {OURS}", OurScene(robot.scene()), _CURVED)
    yield Entry(f"{robot.name}: {COAL}", PlainCoal(robot.scene()), _CURVED)
    if installed("mujoco"):
        yield Entry(f"{robot.name}: {SEARCH}", MujocoInRoom(_room(robot)), _CURVED)
    if installed("pybullet"):
        yield Entry(f"{robot.name}: {BULLET}", BulletInRoom(_room(robot)), _MARGINS)


def _room(robot: KitchenRobot) -> Room:
    return Room(robot.scene(), robot.values[0], "robot/")


def _scene(folder: Path, boxes: int, steps: int) -> Scene:
    return Scene(crowd(boxes, steps).model(folder), rules=RULES)


def _timed(entries: Iterable[Entry], rows: Array) -> Iterator[Contender]:
    """Yield two contenders for each: both go through all states, and each counts its part of the time."""
    for entry in entries:
        yield Contender(f"{entry.name}, {UPDATE}", _sample(entry.finder, rows, whole=False))
        yield Contender(f"{entry.name}, {QUERY}", _sample(entry.finder, rows, whole=True))


def _sample(finder: Finder, rows: Array, whole: bool) -> Callable[[], float]:
    states = list(rows)

    def sample() -> float:
        put, find = finder.put, finder.find
        updating = asking = 0.0
        for state in states:
            start = perf_counter()
            put(state)
            there = perf_counter()
            find()
            asking += perf_counter() - there
            updating += there - start
        return (asking if whole else updating) / len(states)

    return sample


def _growth(measured: Mapping[str, Measurement], sizes: Sequence[int]) -> Comparison:
    few, many = (f"{OURS} among {boxes} boxes, {QUERY}" for boxes in (sizes[0], sizes[-1]))
    ratio = faster(measured, few, many)
    return Comparison(f"{many}, over {sizes[0]}, as many near", ratio.value, "x", Bar(2.0, at_least=False))
