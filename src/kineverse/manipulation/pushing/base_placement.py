"""Base placement for pushes: start states from which a push goes through, found by sampling and roll-outs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.compilation.build_queue import working_seconds
from kineverse.control import Goal, Hold, InverseKinematics, Target
from kineverse.control.tasks import Task
from kineverse.errors import KineverseError
from kineverse.lie import Array
from kineverse.manipulation.base_sampling import BaseSampler
from kineverse.state import State
from kineverse.symbols import Symbol

from .push_controller import Pushing

_STANDOFF = 0.03  # distance of the tip from the contact point at the start [m]
_TILT = math.radians(50.0)  # largest angle of the pusher's axis to the push at an exact start
_NEARBY = 0.12  # largest entry of the distance of the tip at a start that is not [m]
_MARGIN = 0.01
_LEAST_CLEARANCE = 1.5e-3
"""Least distance in a roll-out of pairs that may not touch [m]: pushes in worlds differ a little."""
_STARTS = 4  # number of arms from which inverse kinematics decides whether an arm that stands reaches a point
_CANDIDATES = 1.0  # largest difference of the score of contact points to the best one
_SOLVER_STARTS = 2, 1  # starts of inverse kinematics: to the point, and out of collisions from there
_DRAWS = 40  # number of times that a place is drawn at which the base touches nothing
_MOST_UNMOVED, _MOST_NO_FURTHER = 60, 120
"""Numbers of roll-outs without motion of the object, and without more of it, after which none is expected."""
_NOWHERE = 200  # number of samples after which the search ends if none could be rolled out
_REPORTED = 20  # number of samples from one text on the progress to the next
_NO_ROOM, _UNREACHED, _LATE = "too little room", "out of reach", "out of time"
_CLASSES = {_UNREACHED: "reach", _LATE: "time"}
_MOVED = 0.01  # motion of an object that counts as one [m], [rad]


@dataclass(frozen=True, slots=True, eq=False)
class PushStart:
    """Result of :func:`find_push_start`, true if a start was found."""

    state: State | None  # state of everything from which the push goes through; None if none was found
    samples: int  # number of sampled base poses
    reasons: Counter[str]  # number of samples by the reason of their failure
    steps: int  # number of steps of the push in the roll-out
    whole: bool = True  # whether the push reaches the target

    def __bool__(self) -> bool:
        return self.state is not None

    @property
    def failure(self) -> str:
        """Class of what most samples failed by: ``"reach"``, ``"time"`` or ``"collision"``; else empty."""
        if self or not self.reasons:
            return ""  # a start was found, or none was sampled
        return _CLASSES.get(self.reasons.most_common(1)[0][0], "collision")

    @property
    def why(self) -> str:
        """Text with the number of samples and the reasons of failures."""
        failed = ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common(6))
        result = f"Found after {self.samples} samples" if self else f"None of {self.samples} samples"
        return f"{result}; failed: {failed}." if failed else f"{result}."


def find_push_start(
    pushing: Pushing,
    state: State,
    *,
    samples: int = 400,
    seconds: float = 30.0,
    steps: int = 900,
    seed: int = 0,
    least: float = 1.0,
    accept: Callable[[State], str] = lambda start: "",
    report: Callable[[str], object] = lambda text: None,
) -> PushStart:
    """Return a start state of the robot from which a push goes through in a roll-out of its own prediction.

    A sample is a contact point and a place of the base in front of it, a free one if one is found. Inverse
    kinematics brings the pusher to the point, at first without collisions, in every other pair of samples
    with the base where it stands, which has to be free. If the base touches nothing then, the arm is led out
    of collisions, and the push is rolled out. The first one without lost contacts and penetration is taken.
    The search ends early after 60 roll-outs none of which moves the object, or 120 that move it no further
    than the best one before, and after 200 samples without a roll-out. Nothing is sampled where something is
    in the way of the object. Robots without a mobile base are sampled over their arms alone, at those points
    that are within reach.
    """
    worked, reasons = working_seconds(), Counter[str]()
    samples, seed = as_count("samples", samples, 1), as_count("seed", seed, 0)
    obstacle = pushing.find_obstacle(state)
    if obstacle is not None:  # wherever the robot stands
        reasons[f"{obstacle.body} at {obstacle.other}"] = 1
        return PushStart(None, 0, reasons, 0)
    sampler = _Sampler(pushing, state, np.random.default_rng(seed))
    if sampler.unreachable:
        reasons[_UNREACHED] = sampler.unreachable
        return PushStart(None, sampler.unreachable, reasons, 0)
    here, furthest, since = state[pushing.coordinate], 0.0, 0
    parts: list[tuple[float, int, State, int]] = []
    count = rolled = 0
    while count < samples and working_seconds() - worked <= seconds:
        if since >= (_MOST_NO_FURTHER if furthest else _MOST_UNMOVED) or (not rolled and count >= _NOWHERE):
            break
        if count and count % _REPORTED == 0:
            report(PushStart(None, count, reasons, 0).why)
        count += 1
        start = sampler.sample()
        if isinstance(start, str):
            reasons[start] += 1
            continue
        end, rolled = roll_out(pushing, start, steps), rolled + 1
        problem, distance = end.problem, abs(end.value - here)
        # A push that goes through and is not accepted says nothing about later ones.
        since = 0 if not problem or distance > furthest + _MOVED else since + 1
        furthest = max(furthest, distance) if distance > _MOVED else furthest
        if problem and problem != _NO_ROOM and distance >= least * abs(pushing.target - here):
            parts.append((-distance, count, start, end.steps))
        problem = problem or accept(start)
        if not problem:
            return PushStart(start, count, reasons, end.steps)
        reasons[problem] += 1
    for _, _, start, taken in sorted(parts, key=lambda part: part[:2]):
        if not accept(start):
            return PushStart(start, count, reasons, taken, False)
    return PushStart(None, count, reasons, 0)


class RollOut(NamedTuple):
    """Result of :func:`roll_out`."""

    problem: str  # why the push fails; empty if it goes through
    steps: int  # number of steps
    value: float  # value of the object's coordinate at the end [m], [rad]


def roll_out(pushing: Pushing, start: State, steps: int, tolerance: float = 0.015) -> RollOut:
    """Return how a push ends in its own prediction."""
    state, taken = start, 0
    pushing.reset()
    try:
        problem = pushing.first_contact(state) or str(pushing.find_obstacle(state) or "")
        while not problem and abs(state[pushing.coordinate] - pushing.target) >= tolerance:
            command = pushing.step(state)
            if pushing.losses:
                problem = "lost the contact"
            elif pushing.choice.blocked:
                problem = f"blocked at {state[pushing.coordinate]:.2f}"
            elif pushing.clearance < _LEAST_CLEARANCE:
                problem = _NO_ROOM
            elif taken + 1 == steps:
                problem = _LATE
            else:
                state = pushing.model.integrate(state, command.speeds, pushing.controller.dt)
                taken += 1
    except KineverseError as error:
        problem = type(error).__name__
    finally:
        pushing.reset()
    return RollOut(problem, taken, float(state[pushing.coordinate]))


class _Sampler:
    """Sampler of start states: a contact point, a base in front of it, and inverse kinematics."""

    def __init__(self, pushing: Pushing, state: State, generator: np.random.Generator) -> None:
        self._pushing, self._state, self._generator = pushing, state, generator
        model, tool = pushing.model, pushing.tool
        tip, axis = tool.locate_tip(model), tool.point_axis(model)
        self._point = Target("push/start/point", np.zeros(3))
        self._facing = Target("push/start/facing", np.array([1.0, 0.0, 0.0]))
        still = [s for s in model.degrees_of_freedom if not pushing.robot.moves(s)]
        exact: list[Task] = [Hold(tip, self._point.expression, name="tip")]
        if axis.gradient():
            exact.append(Goal(axis, self._facing.expression, name="facing", weight=0.1))
        nearby = Goal(tip, self._point.expression, name="tip")
        self.base = pushing.robot.planar_base
        # A pusher that cannot face the contact may still reach it with another part than its tip.
        goals: tuple[tuple[list[Task], float], ...] = (
            (exact, 2 * math.sin(_TILT / 2)), ([nearby], _NEARBY)
        )  # fmt: skip
        clear = [
            InverseKinematics(
                model, tasks, fixed=still, scene=pushing.scene, margin=_MARGIN, tolerance=tolerance
            )
            for tasks, tolerance in goals
        ]
        self._coordinates = clear[0].coordinates
        self._solvers: list[tuple[InverseKinematics, ...]] = [(last,) for last in clear]
        if self.base:
            # Steps out of collisions take most of the time, and seldom lead a base out of one.
            arm = all({s.position for s in e.gradient()} - {*self.base} for e in (tip, axis))
            self._solvers = [
                (InverseKinematics(model, tasks, fixed=[*still, *standing], tolerance=tolerance), last)
                for standing in ((self.base, ()) if arm else ((),))
                for (tasks, tolerance), last in zip(goals, clear, strict=True)
            ]
        self._tried = 0
        self._bases = BaseSampler(pushing.scene, pushing.robot, self.base, _MARGIN)
        self._points = pushing.surface.at(state)
        score = pushing.choice.score(self._points)
        good = np.flatnonzero(score > score.max() - _CANDIDATES)
        self.unreachable = 0
        if not self.base:
            free = InverseKinematics(model, [nearby], fixed=still, tolerance=_NEARBY)
            near = self._select_reachable(free, good)
            good, self.unreachable = (near, 0) if len(near) else (good, len(good))
        weights = np.exp(2.0 * (score[good] - score.max()))
        self._candidates, self._weights = good, weights / weights.sum()

    def sample(self) -> State | str:
        """Return a start state, or why there is none."""
        random, state = self._generator, self._state
        k = int(random.choice(self._candidates, p=self._weights))
        at = state.updated(self._arm())
        solvers = self._solvers[self._tried % len(self._solvers)]
        self._tried += 1
        if self.base:
            place, free = self._draw_place(k)
            # A base that moves may leave what it touches: below a flap most places are in cupboards.
            if not free and self.base[0] not in solvers[0].coordinates:
                return "no free place of the base"
            at = at.updated(dict(zip(self.base, place.tolist(), strict=True)))
        seed = int(random.integers(2**31))
        for starts, solver in zip(_SOLVER_STARTS, solvers, strict=False):
            reached = solver.solve(dict(at) | self._targets(k, solver), starts=starts, seed=seed)
            if not reached.solved:
                (obstacle,) = [name for name, _ in reached.obstacles.most_common(1)] or [_UNREACHED]
                return obstacle
            at = at.updated({s: reached.best[s] for s in solver.coordinates})
            if self.base and self._bases.find_touching([state], at.vector(self.base)[None])[0]:
                return "the base touches something"
        return at

    def _draw_place(self, k: int) -> tuple[Array, bool]:
        """Return a place (3,) of the base in front of a contact point, and whether it is free there."""
        point, normal = self._points.points[k, :2], self._points.normals[k, :2]
        states = [self._state]
        places = self._bases.draw(self._generator, states, point[None], normal[None], tries=_DRAWS)
        return places[0], not self._bases.find_touching(states, places)[0]

    def _select_reachable(
        self, solver: InverseKinematics, chosen: npt.NDArray[np.intp]
    ) -> npt.NDArray[np.intp]:
        """Return those of some contact points (indices) that an arm reaches from where it stands."""
        points = self._points.points[chosen] + _STANDOFF * self._points.normals[chosen]
        near, unknown = np.zeros(len(chosen), dtype=bool), np.ones(len(chosen), dtype=bool)
        while unknown.any():
            i = int(np.argmax(unknown))
            result = solver.solve(dict(self._state) | self._targets(int(chosen[i]), solver), starts=_STARTS)
            near[i], unknown[i] = result.solved, False
            # What is around a point that is far out of reach is so, too.
            around = result.residuals["tip"] - math.sqrt(3.0) * _NEARBY
            unknown &= np.linalg.norm(points - points[i], axis=1) > around
        return chosen[near]

    def _targets(self, k: int, solver: InverseKinematics) -> dict[Symbol, float]:
        point, normal = self._points.points[k], self._points.normals[k]
        values = self._point.values(point + _STANDOFF * normal) | self._facing.values(-normal)
        return {s: v for s, v in values.items() if s in solver.inputs}

    def _arm(self) -> dict[Symbol, float]:
        """Return random values of the coordinates between base and pusher, in every other sample."""
        if self._generator.random() < 0.5:
            return {}
        model = self._pushing.model
        values: dict[Symbol, float] = {}
        for symbol in self._coordinates:
            lower, upper = model.limits(symbol)
            if symbol not in self.base and math.isfinite(lower) and math.isfinite(upper):
                middle = (lower + upper) / 2
                values[symbol] = middle + 0.6 * (self._generator.uniform(lower, upper) - middle)
        return values
