"""Execution of unlocking plans by the velocity controller, with replanning without parts that do not move."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from kineverse._checks import finite_number
from kineverse.control import Controller, Goal
from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.geometry import Scene
from kineverse.manipulation.session import Session
from kineverse.manipulation.swept_volume import Obstacle, find_obstacle
from kineverse.model.model_view import ModelView
from kineverse.reasoning import UnlockingPlan, UnlockingStep, plan_unlocking
from kineverse.reasoning.unlocking_plan import BUDGET
from kineverse.state import State
from kineverse.symbols import Symbol, parameter
from kineverse.worlds import World
from kineverse.worlds.furniture_overlaps import FurnitureOverlaps
from kineverse.worlds.run_metrics import LimitJudge

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
        Session in a world whose coordinates are driven, such as :class:`kineverse.worlds.MechanismWorld`.
    patience
        Time without progress after which a coordinate counts as stuck [s].
    speed
        Largest speed [m/s] or [rad/s]; limits of the model count as well.

    Raises
    ------
    InvalidValueError
        For a patience or a speed that is not positive.
    """

    def __init__(
        self, model: ModelView, session: Session, *, patience: float = 1.0, speed: float = 0.4
    ) -> None:
        for what, number in (("patience", patience), ("speed", speed)):
            if not (finite_number(number) or 0.0) > 0:
                raise InvalidValueError(f"The {what} of a moved part is a positive number, not {number!r}.")
        self.model, self.session = model, session
        self._patience, self._speed = float(patience), float(speed)
        self._target = parameter(_TARGET, 0.0)
        self._controllers: dict[Symbol, Controller] = {}

    def move(self, coordinate: Symbol | str, target: float, tolerance: float = TOLERANCE) -> float:
        """Move a coordinate to a target, and return the position where it ends [m] or [rad].

        It ends within the tolerance of the target, or where it has come no nearer for the patience.
        """
        symbol = self.model.degree_of_freedom(coordinate)
        controller, session = self._controller(symbol), self.session
        controller.reset()
        controller.set(self._target, target)
        start = nearest = session.state[symbol]
        session.phase = f"{'raise' if target > start else 'lower'} {symbol}"
        since = session.world.time
        while abs(session.state[symbol] - target) > tolerance:
            with session.timed("unlock"):
                command = controller.step(session.state)
            session.act(command.speeds, command)
            here = session.state[symbol]
            if abs(here - target) < abs(nearest - target) - tolerance:
                nearest, since = here, session.world.time
            elif session.world.time - since > self._patience:
                break
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
_VIOLATED = 1e-6  # excess of a constraint from which on it is violated, in its unit


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
        Whether all coordinates of the goal are where they were wanted, in the world's truth, and no part went
        through anything.
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
    overlap, overlapping
        Largest depth of two bodies that came on the way in the states of the world [m], 0 up to 0.5 mm, and
        their names.
    violation, constraint
        Largest excess of a constraint of the model in the states of the world, and its name; empty if no
        constraint was violated.
    seconds
        Time in the world [s].
    state
        Believed state at the end.
    """

    done: bool
    moves: tuple[ExecutedMove, ...]
    plan: UnlockingPlan
    plans: int
    stuck: tuple[Symbol, ...]
    violation: float
    constraint: str
    seconds: float
    state: State
    obstacles: tuple[Obstacle, ...] = ()
    overlap: float = 0.0
    overlapping: tuple[str, str] = ("", "")

    def __bool__(self) -> bool:
        return self.done

    @property
    def reason(self) -> str:
        """Reason of the end."""
        if self.done:
            return "the goal is reached"
        if self.overlap:
            one, other = self.overlapping
            return f"on the way '{one}' and '{other}' overlapped by {1e3 * self.overlap:.3g} mm"
        return " ".join([*map(str, self.obstacles), str(self.plan)])

    def as_data(self) -> dict[str, Any]:
        """Return the execution as data for JSON."""
        return {
            "done": self.done,
            "reason": self.reason,
            "moves": [move.as_data() for move in self.moves],
            "plans": self.plans,
            "stuck": [str(s) for s in self.stuck],
            "violation": self.violation,
            "constraint": self.constraint,
            "obstacles": [str(one) for one in self.obstacles],
            "overlap": self.overlap,
            "overlapping": list(self.overlapping),
            "seconds": self.seconds,
            "state": {str(s): value for s, value in self.state.items()},
        }

    def __str__(self) -> str:
        lines = [f"{n}. {move}" for n, move in enumerate(self.moves, 1)]
        if self.constraint:
            lines.append(f"violated on the way: {self.constraint}, by {format_number(self.violation, 3)}")
        return "\n".join([*lines, self.reason])


def execute_unlocking(
    world: World,
    goal: Mapping[Symbol, float] | Mapping[str, float],
    *,
    model: ModelView | None = None,
    fixed: Collection[Symbol | str] = (),
    budget: float = BUDGET,
    dt: float = 0.05,
    patience: float = 1.0,
    speed: float = 0.4,
    on_step: Callable[[Session], object] | None = None,
) -> UnlockingExecution:
    """Plan how a goal is reached, and move the parts of a mechanism in a world accordingly.

    Each move of :func:`kineverse.reasoning.plan_unlocking` is made by the velocity controller, in whose
    program the locks are rows. If a part ends anywhere but at its target, the plan is made again from there,
    without that part, until the goal is reached or no plan is left. So it is for a part that would run into
    another one, see :func:`.find_obstacle`; it is not moved at all.

    Parameters
    ----------
    world
        World whose coordinates are driven, such as :class:`kineverse.worlds.MechanismWorld`.
    goal
        Positions to reach, by coordinate or its name [m] or [rad].
    model
        Model by which it is planned and controlled; None for the model of the world.
    fixed
        Coordinates that are known not to move.
    budget
        Time for each plan [s].
    dt
        Control period [s].
    patience
        Time without progress after which a part counts as stuck [s].
    speed
        Largest speed [m/s] or [rad/s]; limits of the model count as well.
    on_step
        Is called with the session after each step, for recordings and output.

    Raises
    ------
    UnknownNameError, InvalidValueError
        As :func:`kineverse.reasoning.plan_unlocking`; also for times and speeds that are not positive.
    """
    known = world.model if model is None else model
    judge, overlaps = LimitJudge(known), _OverlapJudge(world)
    begin = world.time

    def measure(session: Session) -> None:
        truth = world.state
        judge.update(truth.vector(judge.symbols), world.time)
        overlaps.update()
        if on_step is not None:
            on_step(session)

    session = Session(world, dt=dt, on_step=measure)
    judge.update(world.state.vector(judge.symbols), begin)
    mover = PartMover(known, session, patience=patience, speed=speed)
    moves, stuck, plans = list[ExecutedMove](), list[Symbol](), 0
    obstacles: list[Obstacle] = []
    while True:
        plan = plan_unlocking(known, goal, session.state, fixed=[*fixed, *stuck], budget=budget)
        plans += 1
        made: list[ExecutedMove] = []
        for step in plan.steps:
            made.append(_make_move(mover, step, obstacles))
            if not made[-1].done:
                break
        moves += made
        if not made or made[-1].done:
            break
        stuck.append(made[-1].step.coordinate)
    truth = world.state
    return UnlockingExecution(
        plan.verdict == "found"
        and all(abs(truth[s] - x) <= 2 * TOLERANCE for s, x in plan.goal.items())
        and not overlaps.depth,
        tuple(moves),
        plan,
        plans,
        tuple(stuck),
        judge.violation,
        judge.limit if judge.violation > _VIOLATED else "",
        world.time - begin,
        session.state,
        tuple(obstacles),
        overlaps.depth,
        overlaps.pair,
    )


class _OverlapJudge:
    """Judge of overlaps in the states of a world, of parts with shapes."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._overlaps: FurnitureOverlaps | None = None
        self.depth, self.pair = 0.0, ("", "")
        if _has_shapes(world.model):
            self._scene = Scene(world.model)
            self._overlaps = FurnitureOverlaps(self._scene, "")
            self._scene.update(world.state)
            self._overlaps.begin()

    def update(self) -> None:
        if self._overlaps is None:
            return
        self._scene.update(self._world.state)
        for one in self._overlaps.find()[:1]:
            if one.excess > self.depth:
                self.depth, self.pair = one.excess, (one.a, one.b)


def _has_shapes(model: ModelView) -> bool:
    return any(body.collisions or body.visuals for body in model.bodies.values())


def _make_move(mover: PartMover, step: UnlockingStep, obstacles: list[Obstacle]) -> ExecutedMove:
    """Make one move of a plan, unless something is in its way, which is added to the obstacles."""
    model, state = mover.model, mover.session.state
    if _has_shapes(model):
        obstacle = find_obstacle(model, step.coordinate, state, step.target)
        if obstacle is not None:
            obstacles.append(obstacle)
            return ExecutedMove(step, float(state[step.coordinate]), 0.0, False)
    tolerance = TOLERANCE
    if step.threshold is not None and step.threshold != step.target:
        tolerance = min(tolerance, _SHARE * abs(step.target - step.threshold))
    begin = mover.session.world.time
    reached = mover.move(step.coordinate, step.target, tolerance)
    done = abs(reached - step.target) <= tolerance
    return ExecutedMove(step, reached, mover.session.world.time - begin, done)
