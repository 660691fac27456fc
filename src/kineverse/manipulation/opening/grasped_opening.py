"""Grasped opening: a hand takes a handle, moves the object to a value of its coordinate, and lets go.

What has to be unlatched before is turned or pressed first, see :mod:`.contact_phases`.
"""

from __future__ import annotations

import contextlib
import math

import numpy as np

from kineverse._checks import as_count, as_positive
from kineverse.errors import InvalidValueError
from kineverse.grasping import Gripper, Handle, find_handle
from kineverse.manipulation.outcome import Outcome, SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_run import (
    SkillRun,
    check_target,
    choose_target,
    choose_tolerance,
    explain_fixed,
    find_object_coordinate,
)
from kineverse.symbols import Symbol
from kineverse.worlds.furniture_overlaps import OVERLAP

from .approach_planner import Approach, Opener
from .base_placement import BasePlacement
from .contact_phases import ContactPhase, PhasePlanner, Way
from .hand_motion import HandMotion, SlipError, move_held
from .planned_push import LEAST_PUSH, PlannedPush, press

_SLANT = math.radians(50.0)  # largest slant of grasps where those from across the handle lead nowhere [rad]
_PROOF = 200  # largest number of sampled bases that are to prove that an object is too high
_MOST_GRASPS, _MOST_PUSHES, _MOST_PHASES = 4, 3, 8
_LATCHED = 5e-4  # distance from where something latches at which it is let go [m], [rad]
_LATE = 1.0  # time before the end at which it counts as up [s]
_MOST_SLIPS, _LEAST_PROGRESS = 2, 0.1
"""Number of slips from which on a grasp has to take an object further, by a share of the rest."""
_HEIGHTS = 12  # number of values at which the height of an object is compared with that of the hand


def open_object(
    session: Session,
    what: Symbol | str,
    *,
    target: float | None = None,
    hand: Gripper | str | None = None,
    handle: Handle | str | None = None,
    seconds: float = 180.0,
    tolerance: float | None = None,
    overlap: float = OVERLAP,
    placements: int = 600,
    seed: int = 0,
) -> Outcome:
    """Move an object to a value of its coordinate by its handle.

    A base, a grasp and a path of the arm are found, see :class:`.PlacementSearch`. The robot goes to the
    handle on a planned path, closes its fingers, moves the object, lets go and retracts. Where one grasp does
    not lead to the target, the object is released on the way and grasped again. Where no grasp leads on,
    such as at an oven door whose handle faces the floor, it is pushed. A base on two wheels drives to its
    place before the arm moves; one that cannot turn on the spot stays where it is. A hand that is at the
    handle from the start, as after a skill that was broken off, lets go first. Nothing is moved where
    something is in the way of the object, see :func:`.find_obstacle`.

    Where other parts hold the object, it is planned how they unlatch it. Those that move its handle, such as
    a lever, are moved in the same grasp, and are let back as soon as it is free; others are moved by handles
    of their own, or pressed. That is planned anew before each grasp, without the parts that did not move.

    Parameters
    ----------
    session
        The robot.
    what
        The coordinate of the object, as symbol or name.
    target
        Wanted value [m], [rad]; by default the limit that is the farthest from the present value.
    hand, handle
        The gripper and the handle, or their frames, found by default.
    seconds
        Largest time by the robot's clock [s].
    tolerance
        Largest distance from the target [m], [rad]; by default 2 % of the distance, and 20 mm at a limit, see
        :func:`.choose_tolerance`.
    overlap
        Depth from which on something is in the way of the object [m]: more where a joint is not known well.
    placements
        Largest number of sampled bases for one grasp.
    seed
        Seed of all searches.

    Returns
    -------
    Outcome
        With ``measures``: ``target``, ``tolerance``, ``placements``, ``grasps`` and ``slips`` (numbers of
        sampled bases, of grasps, and of those that the handle slipped out of), ``pushed``, ``unlatched`` if
        something else had to move (the coordinates, as they did), and ``failure``:
        ``"collision"``, ``"reach"``, ``"time"`` or ``"other"`` if it was not done; ``free``, the value up to
        which the path is free, if something is in the way.

    Raises
    ------
    UnknownNameError, InvalidValueError
        Without a gripper or a handle, for a coordinate of the robot, a target out of limits, or less than one
        placement.

    Examples
    --------
    >>> scene = kv.load("shelf_door")
    >>> robot = kv.manipulation.place_robot(scene, "hsr", at=(-1.0, 0.0, 0.0))
    >>> world = kv.worlds.KinematicWorld(scene, robot.name)
    >>> world.reset(robot.start_state(scene))
    >>> metrics = kv.worlds.RunMetrics(world, scene.symbol("shelf_door/door"))
    >>> belief = kv.worlds.TrueBelief(world)
    >>> session = kv.manipulation.Session(world, belief=belief, on_step=metrics)
    >>> outcome = kv.manipulation.open_object(session, "shelf_door/door", target=0.3)
    >>> outcome.done, round(world.state["shelf_door/door"], 1)
    (True, 0.3)
    >>> kv.manipulation.judge_outcome(outcome, metrics).claimed
    True
    """
    coordinate = find_object_coordinate(session.robot, what)
    seconds, (target, tolerance) = as_positive(seconds, "seconds="), check_target(target, tolerance)
    placements, seed = as_count("placements", placements, 1), as_count("seed", seed, 0)
    if not isinstance(handle, Handle):
        handle = find_handle(session.model, coordinate, handle)
    gripper = hand if isinstance(hand, Gripper) else session.robot.gripper(hand)
    opener = Opener.of(session.robot, gripper, session.state)
    run = OpeningRun(session, opener, handle, target, tolerance, seconds, placements, seed)
    run.overlap = as_positive(overlap, "overlap=")
    return run.perform(run.open)


class OpeningRun(SkillRun):
    """Run of a grasped opening: which grasp comes next, and what is done where none leads on."""

    coordinate: Symbol

    def __init__(
        self,
        session: Session,
        opener: Opener,
        handle: Handle,
        target: float | None,
        tolerance: float | None,
        seconds: float,
        placements: int,
        seed: int,
    ) -> None:
        super().__init__(session, handle.coordinate, seconds)
        self.opener, self.handle, self.gripper = opener, handle, opener.gripper
        self.phases = PhasePlanner(self.model, self.robot, handle)
        self.motion = HandMotion(self, opener, handle, seed, self.phases.carriers)
        self._stalled = False  # whether a latch has not given way to the hand that holds its key
        self._stuck: dict[Symbol, str] = {}  # what did not move when it should have, and why
        self._wanted = target, tolerance
        self.target = self.tolerance = self.near = math.nan
        self._samples, self._seed = placements, seed
        self.pushed_from: float | None = None
        self.slips: list[str] = []
        self._last_rest = math.inf
        self.measures |= {"placements": 0, "grasps": 0}
        held = self.gripper.hand, handle.frame, handle.coordinate
        self._reversible = [
            made
            for made in session.made
            if (g := made.grasp) and (g.gripper.hand, g.handle.frame, g.handle.coordinate) == held
        ]

    @property
    def rest(self) -> float:
        """Distance of the object from the target [m], [rad]."""
        return abs(self.value - self.target)

    def finish(self, reason: str, failure: str = "") -> Outcome:
        """Return the outcome, with what happened on the way."""
        self.measures |= {"pushed": self.pushed_from is not None, "slips": len(self.slips)}
        return super().finish(" ".join([*self.slips, reason]), failure)

    def open(self) -> str:
        """Move the object to the target, and return that it is there, or raise SkillError."""
        self.motion.look()
        self._choose_target()
        phase = self._find_phase()
        if self.motion.is_at_handle:
            self.motion.let_go()
        self._check_start()
        if phase.handle is self.handle:
            self._check_height(phase.way)
        failure = self._move_grasped()
        for attempt in range(_MOST_PUSHES):
            before = self.rest
            if before <= self.tolerance:
                break
            phase = self._find_phase()
            if phase.handle is not self.handle or phase.way.keys:
                raise failure  # no push opens a latch
            self._push(failure, attempt)
            if self.tolerance < self.rest < (1.0 - _LEAST_PROGRESS) * before:
                failure = self._move_grasped()
        if self.rest > self.tolerance:
            raise failure
        how = ""
        if self.pushed_from is not None:
            how = f"; it was pushed from {self.pushed_from:.3f} on, where no grasp led further"
        wanted = f"{self.target:.4g} ± {self.tolerance:.2g}"
        return f"'{self.coordinate}' is at {self.value:.4g}, as wanted ({wanted}){how}."

    # -- what prevents it from the start -------------------------------------------------------------------

    def _choose_target(self) -> None:
        """Choose target and tolerance, or raise SkillError if the object cannot go there."""
        model, coordinate, state = self.model, self.coordinate, self.session.state
        target, tolerance = self._wanted
        fixed = explain_fixed(model, coordinate, state)
        if fixed and target != self.value and not self.phases.has_keys:
            raise SkillError("other", fixed)
        self.target = choose_target(model, coordinate, state, target)
        self.tolerance = choose_tolerance(model, coordinate, state, self.target, tolerance)
        latches = self.phases.latches(state, self.target)
        self.near = min(self.tolerance / 4, _LATCHED) if latches else self.tolerance / 4
        self.measures |= {"target": self.target, "tolerance": self.tolerance}
        self.check_way(self.target)

    def _find_phase(self) -> ContactPhase:
        """Return the next contact on the way to the target, or raise SkillError if it cannot be unlatched."""
        state = self.session.state
        try:
            return self.phases.find_next(state, self.target, self._stuck, self.session.deviation)
        except SkillError as error:
            fixed = explain_fixed(self.model, self.coordinate, state)
            raise SkillError("other", " ".join([*self._stuck.values(), fixed, str(error)]).strip()) from None

    def _check_start(self) -> None:
        """Raise SkillError if the robot touches something before anything is done."""
        search = self.opener.search
        search.scene.update(self.session.state)
        touching = search.scene.watch(search.robot_bodies, search.others, 0.0)()
        if len(touching):
            pair = touching[0]
            kind = "reach" if search.standing else "collision"
            raise SkillError(kind, f"The robot begins in contact: '{pair.a}' at '{pair.b}'.")

    def _check_height(self, way: Way) -> None:
        """Raise SkillError if the hand is too low to touch the object on all its way, by grasp or by push."""
        last = self.target - math.copysign(min(self.tolerance, self.rest), self.target - self.value)
        values = np.linspace(self.value, last, _HEIGHTS)
        why = self.opener.search.find_too_high(self.session.state, self.coordinate, values)
        result = self._search(way, min(self._samples, _PROOF)) if why else None
        if result is not None and not (result and result.values[-1] == self.target):
            raise SkillError("reach", f"{why} None of {result.samples} bases leads to {self.target:.3f}.")

    # -- grasps --------------------------------------------------------------------------------------------

    def _move_grasped(self) -> SkillError:
        """Move the object with one grasp after the other, and return why none leads on."""
        failure: SkillError | None = None
        kind = "other"
        while failure is None and self.measures["grasps"] < _MOST_GRASPS and self.rest > self.tolerance / 2:
            try:
                placement = self._place()
            except SkillError as error:
                failure = error
            else:
                # Grasps that lead on prove nothing about the reach of the arm.
                kind = placement.failure if placement.failure != "reach" else "other"
                self._move(placement)
                if self.left < 0.0 and self.rest <= self.tolerance:
                    break
        grasps = self.measures["grasps"]
        return failure or SkillError(kind, f"After {grasps} grasps '{self.coordinate}' is not at the target.")

    def _move(self, placement: BasePlacement) -> None:
        """Take the handle, move the object as far as a placement leads, and let go."""
        assert placement.grasp is not None
        self.measures["grasps"] += 1
        self.motion.drive()
        self.motion.approach(placement)
        before, stall = self.rest, None
        try:
            if self.motion.close(placement.grasp):
                move_held(self.motion, placement, self.tolerance, self.near)
                self._note_unlatched(*placement.way.keys)
                self.session.made.append(placement.find_last_run())
        except SlipError as slip:
            self.slips.append(str(slip))
        except SkillError as error:
            if error.kind == "time" or self.session.fault:
                raise
            stall = error
        try:
            self.motion.release(placement)
        except SkillError as error:
            # With the hand open, what is reached counts, though no time is left to take the hand away.
            late = error.kind == "time" and self.session.phase == "retract"
            if not late or self.rest > self.tolerance:
                raise
        if stall is not None and self.rest > (1.0 - _LEAST_PROGRESS) * before:
            phase, keys = self._find_phase(), placement.way.keys
            # What was believed to be unlatched, or was latched again, is tried once more.
            again = phase.handle is not self.handle or phase.way.keys != keys or (keys and not self._stalled)
            self._stalled |= bool(keys)
            if not again:
                raise stall
        self._check_progress()

    def _check_progress(self) -> None:
        """Raise SkillError if the handle slips time and again and the object hardly moves."""
        if len(self.slips) < _MOST_SLIPS:
            self._last_rest = self.rest
        elif self.rest > (1.0 - _LEAST_PROGRESS) * self._last_rest:
            raise SkillError(
                "other",
                f"It does not move on from {self.value:.3f} though it was pulled {len(self.slips)} times: it "
                "is locked or jammed, or moves too hard for the force of the fingers.",
            )

    def _place(self) -> BasePlacement:
        """Return a placement that leads as far as possible, and plan the path to the handle."""
        way = self._unlatch()
        back = None if way.keys else self._retrace(whole=True)
        if back is not None:
            return back
        try:
            result = self._search(way, self._samples)
            if result:
                return result
            failure = self.motion.explain(result)
        except SkillError as error:  # no grasp has room
            if self.session.fault:
                raise
            failure = error
        back = None if way.keys else self._retrace(whole=False)
        if back is None:
            raise failure
        return back

    def _unlatch(self) -> Way:
        """Move what has to move before the object is taken, and return the way of its handle then."""
        for _ in range(_MOST_PHASES):
            phase = self._find_phase()
            if phase.handle is self.handle:
                return phase.way
            try:
                if phase.handle is None:
                    press(self.motion, phase, self._seed)
                else:
                    self._move_other(phase, phase.handle)
            except SkillError as error:
                if self.session.fault or self.left < 0.0:
                    raise
                self._stuck[phase.coordinate] = str(error)
            else:
                self._note_unlatched(phase.coordinate)
            self.motion.look()
        raise SkillError(
            "other", f"'{self.coordinate}' was unlatched {_MOST_PHASES} times, and is latched again."
        )

    def _note_unlatched(self, *keys: Symbol) -> None:
        if keys:
            self.measures["unlatched"] = [*self.measures.get("unlatched", ()), *map(str, keys)]

    def _move_other(self, phase: ContactPhase, handle: Handle) -> None:
        """Move another part by its handle as a phase says, or raise SkillError."""
        run = OpeningRun(
            self.session,
            self.opener,
            handle,
            phase.target,
            phase.tolerance,
            self.left,
            self._samples,
            self._seed,
        )
        outcome = run.perform(run.open)
        for name in ("placements", "grasps"):
            self.measures[name] += outcome.measures[name]
        if not outcome:
            raise SkillError(outcome.measures["failure"], outcome.reason)

    def _retrace(self, *, whole: bool) -> BasePlacement | None:
        """Return an earlier motion, reversed, that leads on from here or to the target; None without any."""
        session, here = self.session, self.value
        session.phase = "place"
        with session.search():
            for earlier in reversed(self._reversible):
                end = earlier.find_end_backwards(here, self.target)
                if (
                    end is None
                    or (whole and end != self.target)
                    or abs(end - here) < _LEAST_PROGRESS * self.rest
                ):
                    continue
                way = self.phases.find_straight(session.state, end)
                result = self.opener.search.retrace(session.state, earlier, way, self.motion.plan)
                if result is not None:
                    self._reversible.remove(earlier)
                    return result
        self.motion.planned = Approach()
        return None

    def _search(self, way: Way, samples: int) -> BasePlacement:
        """Search a placement, with hands that come from along the bar where no other one leads to it."""
        result = self._search_with(way, samples, 0.0)
        if not result and not self.handle.is_knob:
            with contextlib.suppress(SkillError):  # there may be no room for such a hand
                result = self._search_with(way, samples, _SLANT) or result
        return result

    def _search_with(self, way: Way, samples: int, slant: float) -> BasePlacement:
        """Search a placement among the most sampled bases that are allowed, and count them."""
        session, opener = self.session, self.opener
        session.phase = "place"
        text = f"places of the robot from which it leads from {self.value:.3f} to {self.target:.3f}"
        with session.search(text):
            try:
                grasps = opener.grasps(self.handle, session.state, self._seed, slant)
            except InvalidValueError as error:
                raise SkillError("collision", str(error)) from error
            result = opener.search.find(
                session.state,
                grasps,
                way,
                accept=self.motion.plan,
                stays=bool(opener.approaches.explain_standing(session.state)),
                samples=samples,
                seed=self._seed + self.measures["grasps"],
                report=session.report_search,
            )
        self.measures["placements"] += result.samples
        return result

    # -- pushes --------------------------------------------------------------------------------------------

    def _push(self, failure: SkillError, attempt: int) -> None:
        """Push the object on where no grasp leads, or raise SkillError after the last attempt."""
        session, value, before, begun = self.session, self.value, self.rest, False
        if self.opener.approaches.explain_standing(session.state):
            raise failure  # starts of pushes are elsewhere
        try:
            planned = PlannedPush(self.motion, self.coordinate, self.target, self._seed + attempt)
            begun = True
            try:
                planned.make(self.tolerance)
            except SkillError:
                if session.fault or self.rest > (1.0 - LEAST_PUSH / 2) * before:
                    raise
        except SkillError as error:
            if session.fault:
                raise
            late = error.kind == "time" and self.left < _LATE
            if late or not begun or attempt + 1 == _MOST_PUSHES:
                raise SkillError("time" if late else failure.kind, f"{failure} {error}") from error
        finally:
            if self.pushed_from is None and begun:
                self.pushed_from = value
