"""Grasped opening: a hand takes a handle, moves the object to a value of its coordinate, and lets go."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from kineverse._checks import as_count
from kineverse.errors import InfeasibleError, InvalidValueError, NotFiniteError
from kineverse.grasping import Handle, find_gripper, find_handle
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_arguments import (
    check_positive,
    check_target,
    choose_target,
    choose_tolerance,
    explain_fixed,
    find_object_coordinate,
)
from kineverse.manipulation.slip_detection import SlipError
from kineverse.manipulation.swept_volume import BlockedError, find_obstacle
from kineverse.model.symbolic_view import cached_for_version
from kineverse.symbols import Symbol
from kineverse.worlds import Judge
from kineverse.worlds.run_metrics import JudgedOverlap

from .approach_planner import Approach, Opener
from .base_placement import BasePlacement
from .hand_motion import HandMotion, move_held
from .push_regrasp import PushRegrasp

_SLANT = math.radians(50.0)  # largest slant of grasps where those from across the handle lead nowhere [rad]
_PROOF = 200  # largest number of sampled bases that are to prove that an object is too high
_MOST_GRASPS, _MOST_PUSHES = 4, 3
_LATE = 1.0  # time before the end at which it counts as up [s]
_MOST_SLIPS, _LEAST_PROGRESS = 2, 0.1
"""Number of slips from which on a grasp has to take an object further, by a share of the rest."""
_HEIGHTS = 12  # number of values at which the height of an object is compared with that of the hand
_LARGEST = ("limit_violation", "penetration", "grasp_error", "grasp_rotation", "jitter", "reversals")
_SUMS = ("contact_losses", "distance", "hand_distance")
_NAMED = {"limit": "limit_violation", "penetrating": "penetration", "penetration_from": "penetration"}
"""Measures of the parts of a run: the largest, or the sum; and what belongs to the largest."""


def open_object(
    session: Session,
    what: Symbol | str,
    *,
    target: float | None = None,
    hand: str | None = None,
    handle: str | None = None,
    seconds: float = 180.0,
    tolerance: float | None = None,
    placements: int = 600,
    seed: int = 0,
) -> Outcome:
    """Move an object to a value of its coordinate by its handle.

    A base, a grasp and a path of the arm are found, see :class:`.PlacementSearch`. The robot goes to the
    handle on a planned path, closes its fingers, moves the object, lets go and retracts. Where one grasp does
    not lead to the target, the object is released on the way and grasped again. Where no grasp leads on,
    such as at an oven door whose handle faces the floor, it is pushed. A base on two wheels drives to its
    place before the arm moves. One that cannot turn on the spot, or that begins in contact, is put there by a
    reset of the world. Nothing is moved where something is in the way of the object, see
    :func:`.find_obstacle`.

    Parameters
    ----------
    session
        Robot in a world.
    what
        The coordinate of the object, as symbol or name.
    target
        Wanted value [m], [rad]; by default the limit that is the farthest from the present value.
    hand, handle
        Frames of the hand and of the handle, found by default.
    seconds
        Largest time in the world [s].
    tolerance
        Largest distance from the target [m], [rad]; by default 2 % of the distance, and 20 mm at a limit, see
        :func:`.choose_tolerance`.
    placements
        Largest number of sampled bases for one grasp.
    seed
        Seed of all searches.

    Returns
    -------
    Outcome
        With ``measures``: those of :class:`.Judge`, ``placements``, ``grasps`` and ``slips`` (number of
        grasps, and of those that the handle slipped out of), ``tolerance``, ``peak_force`` [N] in a world
        with forces, and ``failure``: ``"collision"``, ``"reach"``, ``"time"`` or ``"other"`` if it was not
        done; ``free``, the value up to which the path is free, if something is in the way.

    Raises
    ------
    UnknownNameError, InvalidValueError
        Without a gripper or a handle, for a coordinate of the robot, a target out of limits, or less than one
        placement.
    """
    world, model = session.world, session.world.model
    coordinate = find_object_coordinate(world, what)
    seconds = check_positive("seconds", seconds)
    placements, seed = as_count("placements", placements, 1), as_count("seed", seed, 0)
    fixed, here = explain_fixed(model, coordinate, session.state), float(world.state[coordinate])
    if fixed and (target is None or check_target(target) != here):
        return Outcome(False, here, fixed, world.name, 0.0, 0, {"failure": "other"})
    goal = choose_target(model, coordinate, session.state, check_target(target))
    tolerance = choose_tolerance(model, coordinate, session.state, goal, tolerance)
    if not session.deviation(coordinate):  # with an estimate the robot looks first, see _Run
        obstacle = find_obstacle(
            model, coordinate, session.state, goal, robot=world.robot, start=session.start
        )
        if obstacle is not None:
            return Outcome(False, here, str(obstacle), world.name, 0.0, 0, obstacle.measures)
    result = find_handle(model, coordinate, handle)
    gripper = find_gripper(model, world.robot, hand)
    opener = cached_for_version(
        model, ("opener", gripper.hand), lambda: Opener(model, gripper, session.state)
    )
    session.peak_force = math.nan
    run = _Run(session, opener, result, goal, seconds, tolerance, placements, seed)
    reason, kind, measures = "", "", dict[str, Any]()
    try:
        run.perform()
    except SkillError as failure:
        reason, kind = str(failure), failure.kind
        if isinstance(failure, BlockedError):
            measures |= failure.obstacle.measures
    except (InfeasibleError, NotFiniteError) as error:
        reason, kind = f"The controller has no command: {error}", "other"
    before = world.time
    session.stop()
    if world.time > before:
        run.judge.update(world.state)
    value, overlap = float(world.state[coordinate]), run.overlap
    claimed = not reason and abs(float(session.state[coordinate]) - goal) <= tolerance
    done = not reason and abs(value - goal) <= tolerance and overlap is None
    if not reason and abs(value - goal) <= tolerance:
        reason = f"'{coordinate}' is at {value:.4g}, as wanted ({goal:.4g} ± {tolerance:.2g}){run.how}."
    elif not reason:
        reason = f"'{coordinate}' ended at {value:.4g}, not at {goal:.4g} ± {tolerance:.2g}."
    if overlap is not None:
        kind = kind or "collision"
        reason += f" {overlap}"
    reason = " ".join([*run.slips, reason])
    measures |= {**run.measures, "placements": run.placements, "grasps": run.grasps, "tolerance": tolerance}
    measures |= {"pushed": run.pushed_from is not None, "resets": run.resets, "slips": len(run.slips)}
    if not math.isnan(session.peak_force):
        measures["peak_force"] = session.peak_force
    if not done:
        measures["failure"] = kind or "other"
    seconds, steps = world.time - run.begin, session.steps - run.first
    return Outcome(done, value, reason, world.name, seconds, steps, measures, claimed)


class _Run:
    """One opening: its phases, and its measurements."""

    def __init__(
        self,
        session: Session,
        opener: Opener,
        handle: Handle,
        target: float,
        seconds: float,
        tolerance: float,
        placements: int,
        seed: int,
    ) -> None:
        self.session, self.opener, self.handle = session, opener, handle
        self.target, self.tolerance = target, tolerance
        self.samples, self.seed, self.seconds = placements, seed, seconds
        self.model = opener.model
        self.gripper = opener.gripper
        self.first, self.begin = session.steps, session.world.time
        self.placements = self.grasps = self.resets = 0
        self.pushed_from: float | None = None
        self.slips: list[str] = []
        self._rest = math.inf
        self._earlier: list[Mapping[str, Any]] = []
        self._overlaps: list[JudgedOverlap] = []
        self._approach = Approach()
        held = self.gripper.hand, handle.frame, handle.coordinate
        self._reversible = [
            made
            for made in session.made
            if (g := made.grasp) and (g.gripper.hand, g.handle.frame, g.handle.coordinate) == held
        ]
        self.judge = Judge(
            self.model, session.world.robot, self.gripper, handle.frame,
            coordinate=handle.coordinate, start=session.start,
        )  # fmt: skip
        self.judge.update(session.world.state)
        self.motion = HandMotion(session, opener, handle, self.judge, self.begin + seconds)

    @property
    def measures(self) -> dict[str, Any]:
        """Measures of the judge, also of those parts that ended with a reset of the world."""
        result = [*self._earlier, self.judge.measures]
        last = dict(result[-1])
        for name in _LARGEST:
            last[name] = max((m[name] for m in result if not math.isnan(m[name])), default=math.nan)
        for what, name in _NAMED.items():
            last[what] = max(result, key=lambda m: float(m[name]))[what]
        for name in _SUMS:
            last[name] = sum(m[name] for m in result)
        last["excepted"] = tuple(dict.fromkeys(pair for m in result for pair in m["excepted"]))
        return last

    @property
    def overlap(self) -> JudgedOverlap | None:
        """The deepest overlap that came on the way, also before a reset of the world; None without any."""
        result = [*self._overlaps, *filter(None, (self.judge.overlap,))]
        return max(result, key=lambda one: one.depth, default=None)

    @property
    def how(self) -> str:
        if self.pushed_from is None:
            return ""
        return f"; it was pushed from {self.pushed_from:.3f} on, where no grasp led further"

    def perform(self) -> None:
        """Move the object to the target by grasps, and by pushes where none leads on, or raise SkillError."""
        self.motion.look()
        self._check_way()
        self._check_start()
        self._check_height()
        failure = self._move_grasped()
        for attempt in range(_MOST_PUSHES):
            before = self.left
            if before <= self.tolerance:
                return
            self._push(failure, attempt)
            if self.tolerance < self.left < (1.0 - _LEAST_PROGRESS) * before:
                failure = self._move_grasped()
        if self.left > self.tolerance:
            raise failure

    def _move_grasped(self) -> SkillError:
        """Move the object with one grasp after the other, and return why none leads on."""
        failure: SkillError | None = None
        kind = "other"
        while failure is None and self.grasps < _MOST_GRASPS and self.left > self.tolerance / 2:
            try:
                placement = self._place()
            except SkillError as error:
                failure = error
            else:
                # Grasps that lead on prove nothing about the reach of the arm.
                kind = placement.failure if placement.failure != "reach" else "other"
                self._move(placement)
                if self.session.world.time > self.motion.until and self.left <= self.tolerance:
                    break
        what = self.handle.coordinate
        return failure or SkillError(kind, f"After {self.grasps} grasps '{what}' is not at the target.")

    def _move(self, placement: BasePlacement) -> None:
        assert placement.grasp is not None
        self.grasps += 1
        self._come(placement)
        before, stall = self.left, None
        try:
            if self.motion.close(placement.grasp):
                move_held(self.motion, placement, self.tolerance)
                self.session.made.append(placement)
        except SlipError as slip:
            self.slips.append(str(slip))
        except SkillError as error:
            if error.kind == "time":
                raise
            stall = error
        try:
            self.motion.release(placement)
        except SkillError as error:
            # With the hand open, what is reached counts, though no time is left to take the hand away.
            late = error.kind == "time" and self.session.phase == "retract"
            if not late or self.left > self.tolerance:
                raise
        if stall is not None and self.left > (1.0 - _LEAST_PROGRESS) * before:
            raise stall
        self._check_progress()

    @property
    def here(self) -> float:
        """Believed value of the object's coordinate [m], [rad]."""
        return float(self.session.state[self.handle.coordinate])

    @property
    def left(self) -> float:
        """Distance of the object from the target [m], [rad]."""
        return abs(self.here - self.target)

    def _push(self, failure: SkillError, attempt: int) -> None:
        """Push the object on where no grasp leads, or raise SkillError after the last attempt."""
        fallback = PushRegrasp(self.motion, self.target, self.tolerance)
        value = float(self.session.state[self.handle.coordinate])
        try:
            fallback.find_start(self.seed + attempt)
            self._bring_base(fallback.approach)
            fallback.perform()
        except SkillError as error:
            if self.session.untrusted:
                raise
            late = error.kind == "time" and self.session.world.time > self.motion.until - _LATE
            if late or not fallback.begun or attempt + 1 == _MOST_PUSHES:
                raise SkillError("time" if late else failure.kind, f"{failure} {error}") from error
        finally:
            if self.pushed_from is None and fallback.begun:
                self.pushed_from = value

    def _bring_base(self, approach: Approach) -> None:
        """Drive a base on wheels to its place, or put it there by a reset of the world."""
        session = self.session
        if approach.places is not None:
            self.motion.drive(approach)
        elif approach.base:
            gone = session.world.time - self.begin
            session.restart(session.world.state.updated(approach.base))
            self.begin, self.resets = -gone, self.resets + 1
            self.motion.until = self.seconds - gone
            self._earlier.append(self.judge.measures)
            self._overlaps += filter(None, (self.judge.overlap,))
            self.judge.reset()
            self.judge.update(session.world.state)
            self.motion.look()

    def _check_progress(self) -> None:
        """Raise SkillError if the handle slips time and again and the object hardly moves."""
        if len(self.slips) < _MOST_SLIPS:
            self._rest = self.left
        elif self.left > (1.0 - _LEAST_PROGRESS) * self._rest:
            value = float(self.session.state[self.handle.coordinate])
            raise SkillError(
                "other",
                f"It does not move on from {value:.3f} though it was pulled {len(self.slips)} times: it is "
                "locked or jammed, or moves too hard for the force of the fingers.",
            )

    def _check_way(self) -> None:
        """Raise BlockedError if something is in the way of the object, as far as it is seen."""
        state, coordinate = self.session.state, self.handle.coordinate
        if self.session.deviation(coordinate):
            session = self.session
            obstacle = find_obstacle(
                self.model, coordinate, state, self.target, robot=session.world.robot, start=session.start
            )
            if obstacle is not None:
                raise BlockedError(obstacle)

    def _check_start(self) -> None:
        """Raise SkillError if the robot touches something before anything is done."""
        search = self.opener.search
        if search.standing:
            return  # the base is put elsewhere
        search.scene.update(self.session.state)
        touching = search.scene.watch(search.robot_bodies, search.others, 0.0)()
        if len(touching):
            pair = touching[0]
            raise SkillError("collision", f"The robot begins in contact: '{pair.a}' at '{pair.b}'.")

    def _check_height(self) -> None:
        """Raise SkillError if the hand is too low to touch the object on all its way, by grasp or by push."""
        state, search, coordinate = self.session.state, self.opener.search, self.handle.coordinate
        here = float(state[coordinate])
        last = self.target - math.copysign(min(self.tolerance, self.left), self.target - here)
        why = search.find_too_high(state, coordinate, np.linspace(here, last, _HEIGHTS))
        result = self._search(min(self.samples, _PROOF)) if why else None
        if result is not None and not (result and result.values[-1] == self.target):
            raise SkillError("reach", f"{why} None of {result.samples} bases leads to {self.target:.3f}.")

    # -- phases --------------------------------------------------------------------------------------------

    def _place(self) -> BasePlacement:
        """Return a placement that leads as far as possible, and plan the path to the handle."""
        back = self._retrace(whole=True)
        if back is not None:
            return back
        try:
            result = self._search(self.samples)
            if result:
                return result
            failure = SkillError(result.failure, f"{result.why}{self._approach.barrier}")
        except SkillError as error:  # no grasp has room
            failure = error
        back = self._retrace(whole=False)
        if back is None:
            raise failure
        return back

    def _retrace(self, *, whole: bool) -> BasePlacement | None:
        """Return an earlier motion, reversed, that leads on from here or to the target; None without any."""
        session, here = self.session, float(self.session.state[self.handle.coordinate])
        session.phase = "place"
        with session.timed("place"):
            for earlier in reversed(self._reversible):
                end = earlier.find_end_backwards(here, self.target)
                if (
                    end is None
                    or (whole and end != self.target)
                    or abs(end - here) < _LEAST_PROGRESS * self.left
                ):
                    continue
                result = self.opener.search.retrace(session.state, earlier, end, self._plan)
                if result is not None:
                    self._reversible.remove(earlier)
                    return result
        self._approach = Approach()
        return None

    def _search(self, samples: int) -> BasePlacement:
        """Search a placement, with hands that come from along the bar where no other one leads to it."""
        result = self._search_with(samples, 0.0)
        if not result and not self.handle.is_knob:
            with contextlib.suppress(SkillError):  # there may be no room for such a hand
                result = self._search_with(samples, _SLANT) or result
        return result

    def _search_with(self, samples: int, slant: float) -> BasePlacement:
        """Search a placement among the most sampled bases that are allowed, and count them."""
        session, search = self.session, self.opener.search
        session.phase = "place"
        session.report_search(
            f"places of the robot from which it leads from {self.here:.3f} to {self.target:.3f}"
        )
        with session.timed("place"):
            try:
                grasps = self.opener.grasps(self.handle, session.state, self.seed, slant)
            except InvalidValueError as error:
                raise SkillError("collision", str(error)) from error
            result = search.find(
                session.state,
                grasps,
                self.target,
                accept=self._plan,
                samples=samples,
                seed=self.seed + self.grasps,
                report=session.report_search,
            )
        self.placements += result.samples
        return result

    def _plan(self, placement: BasePlacement) -> bool:
        self._approach = self.opener.approaches.plan_to(self.session.state, placement, self.seed)
        return bool(self._approach)

    def _come(self, placement: BasePlacement) -> None:
        self._bring_base(self._approach)
        self.session.phase = "approach"
        assert self._approach.trajectory is not None
        self.motion.approach(placement, self._approach.trajectory)
