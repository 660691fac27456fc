"""Planning with holds: an arm opens a fridge that it holds, and two arms a drawer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from kineverse.compilation import compile
from kineverse.control import Hold
from kineverse.formats import load
from kineverse.geometry import RULES, Rule, rules_as_data
from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse.planning import Planner
from kineverse.spatial import rpy, translation
from kineverse.state import State

from .harness import Bar, Comparison, Measurement, Progress, bound_median
from .planning_problems import Attempt, AttemptSummary

SECONDS, SOON = 10.0, 0.1  # largest time of a search, and the time in which nearly all are to be solved [s]
MEDIAN, LEAST_SOON, RESIDUAL = 1e-3, 95.0, 1e-5
"""Targets: median time of the search at the fridge, with its path shortened, polished and certified [s],
share solved soon of what is solved [%], residual of holds [m], [rad]."""
STARTS = 5  # number of starts at each place of the base, each with a goal of its own
_TRIES, _PATIENCE = 300, 0.2
"""Largest number of places of the base, and time of the search for grasps at each [s]."""
_BETWEEN = (0.25, 0.5, 0.75)  # fractions of edges at which residuals are measured as well


@dataclass(frozen=True)
class HeldMotion:
    robot: str
    joint: str  # joint of the door or drawer in the shipped kitchen
    closed: float  # its positions at the start and the goal [m], [rad]
    opened: float
    hands: Mapping[str, tuple[float, ...]]
    handle: str
    moving: tuple[str, ...]  # patterns of the coordinates that move, the joint besides
    # ranges of the base's x, y [m] and angle [rad], shape (2, 3)
    base: tuple[tuple[float, float, float], tuple[float, float, float]]

    @cached_property
    def model(self) -> Model:
        model = load(self.robot)
        with model.edit() as edit:
            edit.include("kitchen", "kitchen")
            for k, (*where, roll, pitch, yaw) in enumerate(self.hands.values()):
                edit.add_frame(f"grasp{k}", self.handle, translation(*where) @ rpy(roll, pitch, yaw))
            kitchen = Rule("kitchen/*", "kitchen/*", why="it is closed when the robot comes")
            edit.write(RULES, rules_as_data([kitchen]))
        return model


MOTIONS: Mapping[str, HeldMotion] = {
    "fridge held by an arm": HeldMotion(
        "fetch",
        "kitchen/fridge_door",
        0.03,
        1.2,
        {"fetch/gripper_link": (0.04, 0.0, 0.0, np.pi / 2, 0.0, np.pi)},
        "kitchen/fridge_door_handle",
        ("fetch/torso*", "fetch/shoulder*", "fetch/upper*", "fetch/elbow*", "fetch/forearm*", "fetch/wrist*"),
        ((0.1, -1.9, -0.6), (0.7, -1.0, 0.6)),
    ),
    "drawer held by two arms": HeldMotion(
        "pr2",
        "kitchen/island_middle_upper_drawer",
        0.02,
        0.3,
        {
            "pr2/l_gripper_palm_link": (0.22, -0.12, 0.0, np.pi / 2, 0.0, np.pi),
            "pr2/r_gripper_palm_link": (0.22, 0.12, 0.0, np.pi / 2, 0.0, np.pi),
        },
        "kitchen/island_middle_upper_drawer_handle",
        ("pr2/torso*", "pr2/*_shoulder*", "pr2/*_upper*", "pr2/*_elbow*", "pr2/*_forearm*", "pr2/*_wrist*"),
        ((-0.3, -0.2, np.pi - 0.3), (0.1, 0.2, np.pi + 0.3)),
    ),
}
"""Motions by name."""


@dataclass
class HeldResults:
    name: str
    attempts: list[Attempt] = field(default_factory=list)
    residual: float = 0.0  # largest residual of the holds at points of the paths, and between them [m], [rad]
    residual_between: float = 0.0
    tried: int = 0  # number of places of the base that were tried to find these

    @property
    def summary(self) -> AttemptSummary:
        return AttemptSummary(f"kineverse, {self.name}", self.attempts)

    def measurements(self) -> Iterator[Measurement]:
        """Yield times, shares and residuals; nothing if no place of the base is found."""
        if not self.attempts:
            return
        yield from self.summary.measurements()
        yield from self._residuals()

    def _residuals(self) -> Iterator[Measurement]:
        name = f"{self.summary.name}: residual of the hold"
        yield Measurement(f"{name} at points", "m, rad", (self.residual,))
        yield Measurement(f"{name} between points", "m, rad", (self.residual_between,))

    def comparisons(self) -> Iterator[Comparison]:
        """Yield the figures with targets; without values if no place of the base is found."""
        summary = self.summary
        if not self.attempts:
            yield Comparison(f"{summary.name}: median", None, "s", Bar(MEDIAN, at_least=False))
            return
        if any(a.found for a in self.attempts):
            whole = summary.times(judged=True)
            if self.name.startswith("fridge"):
                yield bound_median(Measurement(f"{summary.name}: median", "s", (summary.median,)), MEDIAN)
            name = f"{summary.name}: solved in {1e3 * SOON:g} ms of those solved in {SECONDS:g} s"
            soon = 100.0 * float(np.mean(whole <= SOON))
            yield Comparison(name, soon, "%", Bar(LEAST_SOON, at_least=True))
        yield from (bound_median(residual, RESIDUAL) for residual in self._residuals())


def run_held_motion(name: str, places: int, progress: Progress, seed: int = 0) -> HeldResults:
    """Return attempts at a motion from random places of the base where both ends have free grasps."""
    motion, results = MOTIONS[name], HeldResults(name)
    model, joint = motion.model, motion.model.symbol(motion.joint)
    planner = Planner(model, move=(*motion.moving, joint))
    holds = [planner.hold(hand, f"grasp{k}", mask="xyz rx ry") for k, hand in enumerate(motion.hands)]
    base = [model.symbol(f"{motion.robot}/base/{c}") for c in ("x", "y", "angle")]
    residuals = [compile(hold.expression, (*base, *planner.symbols)) for hold in holds]
    random = np.random.default_rng(seed)

    def largest_residual(place: Array, Q: Array) -> float:
        rows = np.hstack([np.tile(place, (len(Q), 1)), Q])
        return max(float(np.abs(f.batch(rows)).max(initial=0.0)) for f in residuals)

    for number in progress(range(places), f"planning, {name}", "place"):
        found = None
        while found is None and results.tried < _TRIES:
            results.tried += 1
            place = random.uniform(*motion.base)
            planner.place(model.default_state() | State(dict(zip(base, place.tolist(), strict=True))))
            found = _find_ends(planner, holds, Hold(joint, motion.closed), Hold(joint, motion.opened), number)
        if found is None:
            break
        if number == 0:
            # Programs are compiled, or loaded, once for a robot and its holds.
            planner.plan(found[0][0], found[1][0], along=holds, seconds=0.0)
        for k, (start, goal) in enumerate(zip(*found, strict=True)):
            path = planner.plan(start, goal, along=holds, seconds=SECONDS, seed=STARTS * number + k)
            results.attempts.append(
                Attempt(path.found, path.search_seconds, path.seconds, path.points, path.why)
            )
            if path.found:
                a, b = path.points[:-1], path.points[1:]
                between = np.vstack([a + t * (b - a) for t in _BETWEEN])
                results.residual = max(results.residual, largest_residual(place, path.points))
                results.residual_between = max(results.residual_between, largest_residual(place, between))
    return results


def _find_ends(
    planner: Planner, holds: Sequence[Hold], closed: Hold, opened: Hold, seed: int
) -> tuple[Array, Array] | None:
    """Return grasps at starts and goals, as many (K, n) of each; None if there are none."""
    ends = [
        planner.solutions([*holds, end], count=STARTS, seconds=_PATIENCE, seed=seed)
        for end in (closed, opened)
    ]
    count = min(map(len, ends))
    return (ends[0][:count], ends[1][:count]) if count else None
