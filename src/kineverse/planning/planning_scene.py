"""One version of a model, placed at one state, in which paths are searched."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._runtime import CallLock
from kineverse.compilation.build_queue import working_seconds
from kineverse.control.tasks import Hold
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.distance_queries import flag_subtree
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import ancestors
from kineverse.model.model_view import ModelView
from kineverse.model.sampling import StateSamples
from kineverse.state import State
from kineverse.symbols import Symbol

from .collision_checker import BodyPairs, CollisionChecker, LateCheckError
from .manifold import FrameHold, Manifold, hold_targets, manifold_key
from .path import Path
from .planning_space import BEYOND, FULL_TURN, HALF_TURN, PlanningSpace
from .query import MORE_PATIENCE, PATIENCE, checked_by, connect
from .sampling_planners import MOST_EDGES, Roadmap
from .start_goal import MOST_BATCHES, Endpoints, find_solutions
from .state_validity import PathChecks, SceneJudge, describe_contacts

Flags: TypeAlias = npt.NDArray[np.bool_]

_JUDGED = 0.5  # longest step between judged configurations of a path that is certified [rad], [m]
_TOO_FAR = (
    "A path was found to a goal that is {:.4g} away, but to check it takes longer than the time given. Give "
    "more seconds=, or nearer goals."
)
_MOST_MANIFOLDS = 16
_SAME = 1e-5  # difference of lengths that is rounding [rad], [m]


class PlanningScene:
    """Present version of a model, placed at a state, with everything that searches of paths need."""

    def __init__(
        self,
        model: ModelView,
        move: Iterable[Symbol | str] | Symbol | str | None,
        rules: Sequence[Rule],
        margin: float,
        protrusion: float | None,
        options: Mapping[str, Any],
        state: State,
        separate: BodyPairs,
        lock: CallLock,
    ) -> None:
        self.model, self.version, self._lock = model, model.version, lock
        self.space = space = PlanningSpace(model, move)
        self.scene = scene = Scene(model, rules=rules, **options)
        if not scene.bodies:
            raise InvalidValueError(
                "No body of the model has a shape, so nothing can collide: add collision or visual shapes."
            )
        overlapping = find_overlapping_pairs(scene, space)
        self.excluded = tuple(rule for rule in overlapping if frozenset((rule.a, rule.b)) not in separate)
        scene.collision_world.add_rules(self.excluded)
        self.checker = CollisionChecker(scene, space.symbols, space.conditions, margin, protrusion)
        space.turning &= self.checker.find_periodic(space.turning)
        self._manifolds: dict[tuple[object, ...], Manifold] = {}
        self._judges: dict[BodyPairs, SceneJudge] = {}
        self._touching: dict[frozenset[tuple[str, str]], BodyPairs] = {}
        self._carried_bodies: dict[str, tuple[str, ...]] = {}
        self.place(state)

    def place(self, state: State) -> None:
        """Place everything that does not move, and the obstacles with it."""
        self.state = state
        self.space.place(state)
        self.checker.place(state)
        self.set_bounds(self.here, self.here[None])

    @property
    def here(self) -> Array:
        """Placed values of the coordinates that move, (n,)."""
        return self.state.vector(self.space.symbols)

    def find_separate_pairs(self, Q: Array) -> BodyPairs:
        """Return the unchecked pairs that are apart at one of the configurations (N, n).

        Samples miss a small gap, in which a start may be.
        """
        apart, pairs = self.checker.struct.margin + _APART, [(rule.a, rule.b) for rule in self.excluded]
        result = set()
        for q in Q if pairs else ():
            state = self.state.updated(dict(zip(self.space.symbols, q.tolist(), strict=True)))
            if _has_poses(self.scene, state):
                distances = self.scene.distances(pairs)
                result |= {frozenset((r.a, r.b)) for r in distances if r.distance > apart}
        return frozenset(result)

    def set_bounds(
        self,
        start: Array,
        points: Array,
        still: Flags | None = None,
        beyond: float = BEYOND,
        turn: float | Array = HALF_TURN,
    ) -> None:
        """Set the bounds of a search from a start (n,) to points (N, n), with some coordinates fixed."""
        lower, upper = self.space.bounds(start, points, beyond, turn)
        if still is not None:
            lower, upper = np.where(still, start, lower), np.where(still, start, upper)
        self.checker.lower[:], self.checker.upper[:] = lower, upper

    def solutions(
        self,
        holds: Sequence[Hold],
        near: Array,
        count: int,
        seconds: float,
        seed: int,
        touching: BodyPairs,
        still: Flags | None = None,
        batches: int = MOST_BATCHES,
    ) -> Array:
        """Find solutions (K, n), the nearest to a configuration first, with some coordinates fixed.

        Coordinates without limits are searched further and further away.
        """
        manifold = self.manifold(holds)
        assert manifold is not None
        reaches = [BEYOND * k for k in ((1, 4, 16) if self.space.unlimited else (1,))]
        with self.checker.excepting(touching):
            for beyond in reaches:
                self.set_bounds(near, near[None], still, beyond)
                share = seconds / len(reaches)
                result = find_solutions(self.checker, manifold, near, count, share, seed, batches)
                if len(result):
                    break
        return result

    def manifold(self, holds: Sequence[Hold]) -> Manifold | None:
        """Return the manifold of holds and equalities of the model; None for the whole space."""
        if not holds and not self.space.equalities:
            return None
        key = manifold_key(holds)
        if key not in self._manifolds:
            if len(self._manifolds) >= _MOST_MANIFOLDS:
                self._manifolds.clear()
            self._manifolds[key] = Manifold(self.checker, self.model, holds, self.space.equalities)
        manifold = self._manifolds[key]
        manifold.place(self.state, hold_targets(holds))
        return manifold

    def touching_pairs(self, holds: Iterable[Hold]) -> BodyPairs:
        """Return the pairs of bodies that may touch while holds last."""
        frames = frozenset(hold.frames for hold in holds if isinstance(hold, FrameHold))
        if frames not in self._touching:
            lookup = self.model.frames.__getitem__
            above = {f: {f, *ancestors(f, lookup)} for ends in frames for f in ends if f != WORLD}
            self._touching[frames] = frozenset(
                frozenset((a, b))
                for one, other in frames
                # One does not carry the other.
                if WORLD not in (one, other) and one not in above[other] and other not in above[one]
                for a in self._carried(one)
                for b in self._carried(other)
                if a != b
            )
        return self._touching[frames]

    def _carried(self, frame: str) -> tuple[str, ...]:
        if frame not in self._carried_bodies:
            self._carried_bodies[frame] = find_carried_bodies(self.model, self.scene.bodies, frame)
        return self._carried_bodies[frame]

    def between(
        self,
        q: Array,
        ends: Array,
        holds: Sequence[Hold],
        touching: BodyPairs,
        seconds: float,
        seed: int,
        still: Flags | None = None,
        edges: int = MOST_EDGES,
        roadmap: Roadmap | None = None,
        optimize: bool = False,
        around: bool = True,
    ) -> Path:
        """Search a path from a configuration (n,) to any of some ends (K, n), see :meth:`.Planner.plan`.

        Bodies of the pairs ``touching`` may touch, and some coordinates may be fixed. With ``around``, joints
        that turn fully also go the long way round.
        """
        begin, worked = perf_counter(), working_seconds()
        wanted, ends = ends, np.array([self.space.nearest_turn(end, q) for end in ends])
        self.set_bounds(q, ends, still)
        manifold = self.manifold(holds)
        with self.checker.excepting(touching):
            endpoints = Endpoints(self.space, self.checker, self.judge(touching), manifold)
            first = endpoints.check("The start", q)
            if first.reason:
                return self.no_path(q, first.reason, begin)
            usable = endpoints.check_goals(ends)
            if isinstance(usable, str):
                return self.no_path(q, usable, begin)
            ways = self._ways(first.q, [goal.q for goal in usable], wanted, ends, around and roadmap is None)
            for k, (turn, variants) in enumerate(ways):
                if len(ways) > 1:
                    self.set_bounds(q, ends, still, turn=turn)
                search = partial(
                    self._connect, first.q, variants, manifold, touching,
                    begin=begin, edges=edges, roadmap=roadmap, optimize=optimize, asked=seconds,
                )  # fmt: skip
                straight = min(float(np.linalg.norm(v - first.q)) for v in variants)
                left = seconds - (working_seconds() - worked)
                try:
                    best = search(left if k == len(ways) - 1 else left / 2, seed)
                except LateCheckError:
                    return self.no_path(q, _TOO_FAR.format(straight), begin, perf_counter() - begin)
                if best.found:
                    break
            while optimize and best.found and best.length > straight + _SAME:
                seed, left = seed + 1, seconds - (working_seconds() - worked)
                if left <= 0.0:
                    break
                try:
                    path = search(left, seed)
                except LateCheckError:
                    break
                if path.found and path.length < best.length:
                    best = path
            return replace(best, seconds=perf_counter() - begin)

    def _ways(
        self, q: Array, goals: list[Array], wanted: Array, ends: Array, around: bool
    ) -> list[tuple[float | Array, list[Array]]]:
        """List the searches from a configuration (n,): how far joints may turn, and goals (n,).

        Goals that are more than half a turn away by their values (K, n) are tried as such first; then full
        turns of them, by the shortest turns, as in the ends (K, n); last by the long way round. A roadmap is
        on a circle and needs one search.
        """
        short = [v for goal in goals for v in self.space.equivalents(goal, q)]
        result: list[tuple[float | Array, list[Array]]] = [(HALF_TURN, short)]
        if not around or not self.space.turning.any():
            return result
        wound = [int(np.argmin(np.abs(ends - goal).max(axis=1))) for goal in goals]
        far = [goal + wanted[k] - ends[k] for goal, k in zip(goals, wound, strict=True)]
        if any(np.abs(a - b).max() > _SAME for a, b in zip(far, goals, strict=True)):
            result.insert(0, (np.maximum(np.abs(np.array(far) - q).max(axis=0) + _SAME, HALF_TURN), far))
        long = [v for goal in goals for v in self.space.equivalents(goal, q, turn=FULL_TURN)]
        return [*result, (FULL_TURN, long)]

    def _connect(
        self,
        q: Array,
        variants: Sequence[Array],
        manifold: Manifold | None,
        touching: BodyPairs,
        seconds: float,
        seed: int,
        begin: float,
        edges: int,
        roadmap: Roadmap | None,
        optimize: bool,
        asked: float,
    ) -> Path:
        targets = np.ascontiguousarray(variants, dtype=np.float32)
        starts = np.ascontiguousarray(q[None], dtype=np.float32)
        searched, until = perf_counter(), checked_by(working_seconds(), seconds)
        patience, checker = MORE_PATIENCE if optimize else PATIENCE, self.checker
        result = connect(checker, manifold, starts, targets, seconds, seed, edges, roadmap, patience, asked)
        spent = perf_counter() - searched
        if result.problem:
            return self.no_path(result.points, result.problem, begin, spent, result.iterations)
        points = result.points
        # A roadmap may wind further than the variants do.
        turns = np.where(self.space.turning, np.round((points[-1] - targets) / math.tau), 0.0) * math.tau
        k = int(np.argmin(np.abs(targets + turns - points[-1]).max(axis=1)))
        points[0], points[-1] = q, variants[k] + turns[k]
        contact = self.judge(touching).first_contact(points, _JUDGED, until)
        if contact is not None:
            problem = f"The scene finds a contact on the path: {describe_contacts([contact[1]])}."
            return self.no_path(points, problem, begin, spent, result.iterations)
        why = f"Found after {result.iterations} samples{'' if roadmap is None else roadmap.describe()}."
        return self.path(True, points, why, begin, spent, result.iterations, touching, manifold)

    def judge(self, touching: BodyPairs = frozenset()) -> SceneJudge:
        """Return the judge of the scene in which some pairs may touch, at the present state."""
        if touching not in self._judges:
            if len(self._judges) >= _MOST_MANIFOLDS:
                self._judges.clear()
            rules = [Rule(a, b, False, "held") for a, b in map(sorted, touching)]
            self._judges[touching] = SceneJudge(self.scene, self.space.symbols, rules)
        judge = self._judges[touching]
        judge.place(self.state)
        return judge

    def no_path(self, points: Array, why: str, begin: float, spent: float = 0.0, iterations: int = 0) -> Path:
        """Make the answer that there is no path, with points (N, n) of a partial one."""
        return self.path(False, np.atleast_2d(points), why, begin, spent, iterations)

    def path(
        self,
        found: bool,
        points: Array,
        why: str,
        begin: float,
        spent: float,
        iterations: int,
        touching: BodyPairs = frozenset(),
        manifold: Manifold | None = None,
    ) -> Path:
        """Make a path through points (N, n); times are the beginning of planning and of the search [s]."""
        checks, seconds = self.checks(touching, manifold), perf_counter() - begin
        return Path(found, self.space.symbols, points, why, seconds, spent, iterations, checks.state, checks)

    def checks(self, touching: BodyPairs, manifold: Manifold | None) -> PathChecks:
        """Make the checks of a path at the present state."""
        judge, checker = self.judge(touching), self.checker
        restore = lambda: checker.place(self.state)  # noqa: E731
        return PathChecks(self.model, self.state, checker, judge, manifold, touching, restore, self._lock)


def find_carried_bodies(model: ModelView, bodies: Sequence[str], frame: str) -> tuple[str, ...]:
    """Return the bodies at and below a frame, or if there are none, below its nearest ancestor with some.

    So a tool frame between the fingers stands for the palm and the fingers. A frame that never moves stands
    for one body: a whole kitchen may be below it.
    """
    frames, fixed = model.frames, frame != WORLD and not model.fk(frame).symbols
    while frame != WORLD:
        flags = np.array([body == frame for body in bodies]) if fixed else flag_subtree(model, bodies, frame)
        if flags.any():
            return tuple(body for body, flag in zip(bodies, flags, strict=True) if flag)
        frame = frames[frame].parent
    return ()


_SAMPLES = 64
_APART = 1e-4  # distance beyond the margin at which bodies do not just rest on each other [m]


def find_overlapping_pairs(scene: Scene, space: PlanningSpace) -> tuple[Rule, ...]:
    """Return rules for pairs of bodies that touch at all samples of all coordinates of the model.

    A robot that stands in a wall by default, and is placed elsewhere, keeps its pairs with the wall.
    """
    home = scene.model.default_state()
    samples = StateSamples(scene.model, count=_SAMPLES)
    columns = {s: samples.values_of(s).tolist() for s in home if s.has_derivative and not s.order}
    states = [home.updated({s: values[k] for s, values in columns.items()}) for k in range(samples.size)]
    pairs = {frozenset(pair) for pair in scene.pairs_affected_by(space.symbols)}
    result = scene.find_always_colliding(filter(partial(_has_poses, scene), states))
    return tuple(rule for rule in result if frozenset((rule.a, rule.b)) in pairs)


def _has_poses(scene: Scene, state: State) -> bool:
    try:
        scene.update(state)
    except NoSolutionError:
        return False
    return True
