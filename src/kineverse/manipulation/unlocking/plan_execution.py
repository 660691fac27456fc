"""Execution of unlocking plans by the velocity controller, with replanning without parts that do not move."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse._checks import as_positive
from kineverse.control import Controller, Goal
from kineverse.expressions.printing import format_number
from kineverse.manipulation.outcome import SkillError
from kineverse.manipulation.session import Session
from kineverse.manipulation.skill_run import SkillRun
from kineverse.manipulation.swept_volume import Obstacle, find_obstacle
from kineverse.model.model_view import ModelView
from kineverse.reasoning import UnlockingPlan, UnlockingStep, plan_unlocking
from kineverse.reasoning.unlocking_plan import BUDGET
from kineverse.state import State
from kineverse.symbols import Symbol, parameter

TOLERANCE = 1e-4  # distance from a target at which it is reached [m] or [rad]
_TARGET = "unlocking/target"


class PartMover:
    """Drive of single coordinates to positions.

    The tasks are a goal for the coordinate, and all others still; the constraints of the model are rows.

    Parameters
    ----------
    model
        Model of the parts as far as it is known.
    session
        Session with what drives the coordinates, such as a :class:`kineverse.worlds.MechanismWorld`.
    patience
        Time without progress after which a coordinate counts as stuck [s].
    speed
        Largest speed [m/s] or [rad/s]; limits of the model count as well.

    Raises
    ------
    InvalidValueError
        For a patience or a speed that is not positive.

    Examples
    --------
    >>> box = kv.load("lockboxes/thesis")
    >>> session = kv.manipulation.Session(kv.worlds.MechanismWorld(box), dt=0.05)
    >>> mover = kv.manipulation.PartMover(box, session)
    >>> round(mover.move("lockbox/f", 0.5), 2)
    0.5
    """

    def __init__(
        self, model: ModelView, session: Session, *, patience: float = 1.0, speed: float = 0.4
    ) -> None:
        self.model, self.session = model, session
        self._patience = as_positive(patience, "The patience of a moved part")
        self._speed = as_positive(speed, "The speed of a moved part")
        self._target = parameter(_TARGET, 0.0)
        self._controllers: dict[Symbol, Controller] = {}

    def move(self, coordinate: Symbol | str, target: float, tolerance: float = TOLERANCE) -> float:
        """Move a coordinate to a target, and return the position where it ends [m] or [rad].

        It ends within the tolerance of the target, or where it has come no nearer for the patience. It
        stops there, and where it is broken off, such as by Ctrl-C.
        """
        symbol = self.model.degree_of_freedom(coordinate)
        controller, session = self._controller(symbol), self.session
        controller.reset()
        controller.set(self._target, target)
        start = nearest = session.state[symbol]
        session.phase = f"{'raise' if target > start else 'lower'} {symbol}"
        since = session.time
        try:
            while abs(session.state[symbol] - target) > tolerance:
                with session.timed("unlock"):
                    command = controller.step(session.state)
                session.act(command.speeds, command)
                here = session.state[symbol]
                if abs(here - target) < abs(nearest - target) - tolerance:
                    nearest, since = here, session.time
                elif session.time - since > self._patience:
                    session.stop()  # nothing presses on while the next move is sought
                    break
        except BaseException:  # also if the user interrupts it
            session.stop()
            raise
        return session.state[symbol]

    def _controller(self, symbol: Symbol) -> Controller:
        if symbol not in self._controllers:
            goal = Goal(
                symbol, self._target, name=f"move {symbol}", gain=0.5 / self.session.dt, speed=self._speed
            )
            others = [s for s in self.model.degrees_of_freedom if s != symbol]
            self._controllers[symbol] = Controller(
                self.model, [goal], dt=self.session.dt, fixed=others, smooth=1e-3, posture=0.0
            )
        return self._controllers[symbol]


_SHARE = 0.1  # largest distance from a target, as a share of its distance beyond the threshold


@dataclass(frozen=True, slots=True)
class ExecutedMove:
    """Move of a plan as it was made.

    Attributes
    ----------
    reached
        Position where the coordinate ended [m] or [rad].
    seconds
        Time that it took [s].
    done
        Whether it ended at the target.

    See Also
    --------
    kineverse.manipulation.execute_unlocking
    """

    step: UnlockingStep
    reached: float
    seconds: float
    done: bool

    def as_data(self) -> dict[str, Any]:
        """Return the move as data for JSON."""
        return {
            **self.step.as_data(),
            "reached": self.reached,
            "seconds": round(self.seconds, 6),
            "done": self.done,
        }

    def __str__(self) -> str:
        name, reached = self.step.coordinate, format_number(self.reached, 4)
        if self.done:
            return f"{name} moved to {reached} in {self.seconds:.1f} s: {self.step.reason}"
        return f"{name} stopped at {reached} on its way to {format_number(self.step.target, 4)}"


@dataclass(frozen=True)
class UnlockingExecution:
    """Execution of a plan, true if the goal was reached.

    Attributes
    ----------
    done
        Whether all coordinates of the goal are where they were wanted, by the readings.
    reason
        Reason of the end.
    moves
        All moves, those that did not reach their target included.
    plan
        The last plan, made after the last of these; it was executed if the goal was reached.
    plans
        Number of plans.
    stuck
        Coordinates that did not move when they should have, without which further plans were made.
    obstacles
        What was in the way of parts, which were then not moved.
    seconds
        Time that it took [s].
    state
        Believed state at the end.

    See Also
    --------
    kineverse.manipulation.execute_unlocking
    """

    done: bool
    reason: str
    moves: tuple[ExecutedMove, ...]
    plan: UnlockingPlan
    plans: int
    stuck: tuple[Symbol, ...]
    obstacles: tuple[Obstacle, ...]
    seconds: float
    state: State

    def __bool__(self) -> bool:
        return self.done

    def as_data(self) -> dict[str, Any]:
        """Return the execution as data for JSON."""
        return {
            "done": self.done,
            "reason": self.reason,
            "moves": [move.as_data() for move in self.moves],
            "plans": self.plans,
            "stuck": [str(s) for s in self.stuck],
            "obstacles": [str(one) for one in self.obstacles],
            "seconds": self.seconds,
            "state": {str(s): value for s, value in self.state.items()},
        }

    def __str__(self) -> str:
        return "\n".join([*(f"{n}. {move}" for n, move in enumerate(self.moves, 1)), self.reason])


def execute_unlocking(
    session: Session,
    goal: Mapping[Symbol, float] | Mapping[str, float],
    *,
    model: ModelView | None = None,
    fixed: Collection[Symbol | str] = (),
    budget: float = BUDGET,
    patience: float = 1.0,
    speed: float = 0.4,
) -> UnlockingExecution:
    """Plan how a goal is reached, and move the parts of a mechanism accordingly.

    Each move of :func:`kineverse.reasoning.plan_unlocking` is made by the velocity controller, in whose
    program the locks are rows. If a part ends anywhere but at its target, the plan is made again from there,
    without that part, until the goal is reached or no plan is left. So it is for a part that would run into
    another one, see :func:`.find_obstacle`; it is not moved at all.

    Parameters
    ----------
    session
        Session with what drives the coordinates, such as a :class:`kineverse.worlds.MechanismWorld`.
    goal
        Positions to reach, by coordinate or its name [m] or [rad].
    model
        Model by which it is planned and controlled; None for that of the session.
    fixed
        Coordinates that are known not to move.
    budget
        Time for each plan [s].
    patience
        Time without progress after which a part counts as stuck [s].
    speed
        Largest speed [m/s] or [rad/s]; limits of the model count as well.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :func:`kineverse.reasoning.plan_unlocking`; also for times and speeds that are not positive.

    Examples
    --------
    >>> model = kv.load("articulations/garage_door")
    >>> session = kv.manipulation.Session(kv.worlds.MechanismWorld(model), dt=0.05)
    >>> result = kv.manipulation.execute_unlocking(session, {"garage_door/garage/door": 1.0})
    >>> result.done, len(result.moves)
    (True, 2)
    """
    mover = PartMover(model or session.model, session, patience=patience, speed=speed)
    return _Execution(mover, goal, fixed, budget).run()


class _Execution(SkillRun):
    def __init__(
        self,
        mover: PartMover,
        goal: Mapping[Symbol, float] | Mapping[str, float],
        fixed: Collection[Symbol | str],
        budget: float,
    ) -> None:
        super().__init__(mover.session, None, math.inf)
        self.mover, self.goal, self.fixed, self.budget = mover, goal, fixed, budget
        self.moves, self.stuck, self.obstacles = list[ExecutedMove](), list[Symbol](), list[Obstacle]()
        self.plan, self.plans = self._make_plan(), 0

    def run(self) -> UnlockingExecution:
        outcome = self.perform(self._reach_goal)
        return UnlockingExecution(
            outcome.done,
            outcome.reason,
            tuple(self.moves),
            self.plan,
            self.plans,
            tuple(self.stuck),
            tuple(self.obstacles),
            outcome.seconds,
            self.session.state,
        )

    def _make_plan(self) -> UnlockingPlan:
        fixed = [*self.fixed, *self.stuck]
        return plan_unlocking(
            self.mover.model, self.goal, self.session.state, fixed=fixed, budget=self.budget
        )

    def _reach_goal(self) -> str:
        """Make plans and their moves until the goal is reached, or raise SkillError if no plan is left."""
        while True:
            self.plans += 1
            for step in self.plan.steps:
                self.moves.append(self._move(step))
                if not self.moves[-1].done:
                    self.stuck.append(step.coordinate)
                    break
            else:
                break
            with self.session.search():
                self.plan = self._make_plan()
        state = self.session.state
        reached = all(abs(state[s] - x) <= 2 * TOLERANCE for s, x in self.plan.goal.items())
        if self.plan.verdict == "found" and reached:
            return "the goal is reached"
        raise SkillError("other", " ".join([*map(str, self.obstacles), str(self.plan)]))

    def _move(self, step: UnlockingStep) -> ExecutedMove:
        """Make one move of a plan, unless something is in its way, which is added to the obstacles."""
        session, mover = self.session, self.mover
        if any(body.collisions or body.visuals for body in mover.model.bodies.values()):
            obstacle = find_obstacle(mover.model, step.coordinate, session.state, step.target)
            if obstacle is not None:
                self.obstacles.append(obstacle)
                return ExecutedMove(step, float(session.state[step.coordinate]), 0.0, False)
        tolerance = TOLERANCE
        if step.threshold is not None and step.threshold != step.target:
            tolerance = min(tolerance, _SHARE * abs(step.target - step.threshold))
        begin = session.time
        reached = mover.move(step.coordinate, step.target, tolerance)
        done = abs(reached - step.target) <= tolerance
        return ExecutedMove(step, reached, session.time - begin, done)
