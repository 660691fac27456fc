"""QP velocity controller: one compiled function and one quadratic program a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse._names import answer_foreign_names
from kineverse._runtime import CallLock, no_collection, one_at_a_time
from kineverse._synonyms import CONTROLLER_SYNONYMS
from kineverse.compilation import CompiledFunction
from kineverse.compilation.function import WantedTier
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError, suggest
from kineverse.expressions.expression import ExpressionLike
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol, parameter

from .command import Command, StepTimes, TaskErrors
from .control_loop import LoopReport, run_control_loop
from .formulation import Formulation
from .infeasibility import Diagnosis
from .qp import QpSolver
from .regularization import Costs, acceleration_limits, check_weight, find_posture, joint_weights
from .tasks import Target, Task
from .velocity_program import RECOVERY_WEIGHT, VelocityProgram, arrange_inputs

if TYPE_CHECKING:
    from kineverse.geometry import Scene
    from kineverse.geometry.results import DistanceResults

    from .contact_constraints import ContactSlots

_DT = "control/dt"
_CONTACT_GAIN = 10.0
_APPROACH = 2.5  # relative speed of bodies up to which default radii are large enough [m/s]
_FEASIBLE = 1e-6
"""Largest violation of a row, in its unit per second, that counts as none where the solver failed."""


@answer_foreign_names("A controller", CONTROLLER_SYNONYMS)
class Controller:
    """Velocity controller that serves tasks within the constraints of a model.

    A step evaluates one compiled function of the state and solves one quadratic program; see
    :mod:`.velocity_program` for the equations. The program starts in CasADi's interpreter and continues in C
    once that is compiled. Without contradictory tasks a step is feasible at every state; outside of its
    limits a coordinate is led back. The controller is about the version of the model at construction. It is
    for one thread, and its scene is for one controller at a time.

    Parameters
    ----------
    model
        The model of everything that the tasks are about: robot, objects, or both.
    tasks
        Goals, holds and keeps.
    dt
        Time between two steps [s].
    fixed
        Coordinates or speeds that do not move, as symbols or names; a name of an articulation stands for its
        coordinates.
    weights
        Factor on damping, smoothness and posture by coordinate or speed, as symbol or name. The default is
        the share of the bodies that a speed moves, so that fingers are preferred to bases.
    smooth, jerk
        Weights of the first and second differences of commands.
    posture
        Weight of the pull to the middle of limits while goals are not reached; 0 for none. A mapping by
        coordinate gives weights to these alone.
    acceleration
        Limits on accelerations [m/s²], [rad/s²], a number or a mapping by coordinate or speed. They and those
        of the model are limits around the last command, and give way where nothing else is possible.
    scene
        Collision scene of the model; None to ignore collisions. Pairs that may touch, such as fingers and a
        handle, are excepted by its rules. Each step updates it.
    contacts
        Number of contact slots: rows for the nearest pairs whose distance the speeds change.
    margin, radius
        Distance that pairs keep, and distance from which they count [m]; the latter by default 0.05 m, or how
        far 2.5 m/s lead in a step if that is more. Bodies that approach faster need a larger one.
    tier
        Kind of evaluation, see :func:`kineverse.compile`; ``"interpreter"`` for controllers of a few hundred
        steps, for which C would be ready too late.

    Attributes
    ----------
    speeds
        The speeds of commands, found from the tasks and the constraints that they meet.
    inputs
        The symbols whose values a step needs.

    Raises
    ------
    InvalidValueError, UnknownNameError, DuplicateNameError
        As :class:`.Formulation`; also for a time step or a weight that is not positive.
    MissingDependencyError
        If the solver is not installed.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> door = model.symbol("kitchen/fridge_door")
    >>> tasks = [kv.control.Goal(door, 1.0)]
    >>> controller = kv.control.Controller(model, tasks, dt=0.02, tier="interpreter")
    >>> state = model.default_state()
    >>> for _ in range(100):
    ...     state = model.integrate(state, controller.step(state).speeds, controller.dt)
    >>> round(state[door], 2)
    0.98
    """

    def __init__(
        self,
        model: ModelView,
        tasks: Iterable[Task],
        *,
        dt: float,
        fixed: Iterable[Symbol | str] = (),
        weights: Mapping[Symbol | str, ExpressionLike] | None = None,
        smooth: float = 1e-2,
        jerk: float = 0.0,
        posture: float | Mapping[Symbol | str, float] = 1e-3,
        acceleration: float | Mapping[Symbol | str, float] | None = None,
        scene: Scene | None = None,
        contacts: int = 24,
        margin: float = 0.005,
        radius: float | None = None,
        tier: WantedTier = "auto",
    ) -> None:
        check_weight("smooth", smooth)
        check_weight("jerk", jerk)
        as_count("contacts", contacts, 0)
        _check_step(dt)
        self.model = model
        step = parameter(_DT, float(dt))
        stated, chosen = acceleration_limits(model, acceleration)
        formulation = Formulation(model, tasks, dt=step, fixed=fixed, accelerations=chosen)
        self.tasks = formulation.tasks
        self.speeds = formulation.speeds
        self._costs = Costs(smooth=smooth, jerk=jerk)
        self._program = VelocityProgram(
            formulation,
            self._costs,
            joint_weights=joint_weights(formulation, weights),
            posture=find_posture(formulation, posture),
            accelerations=stated | chosen,
            contacts=contacts if scene is not None else 0,
            dt=step,
            tier=tier,
        )
        self.inputs = self._program.inputs
        self._contacts: ContactSlots | None = None
        self._queried = False
        self._default_radius = radius is None
        if scene is not None and contacts:
            # For start-up time: a controller without a scene imports no geometry.
            from .contact_constraints import ContactSlots

            reach, gain = _contact_radius(dt) if radius is None else radius, _contact_gain(dt)
            self._contacts = ContactSlots(
                scene, self.speeds, contacts, margin=margin, radius=reach, gain=gain, tier=tier
            )
            self.inputs = arrange_inputs({*self.inputs, *self._contacts.inputs})
            place = {s: k for k, s in enumerate(self.inputs)}
            self._program_values = np.array([place[s] for s in self._program.inputs], dtype=np.intp)
            self._contact_values = np.array([place[s] for s in self._contacts.inputs], dtype=np.intp)
        size = self._program.columns, self._program.rows
        self._solver = self._relaxed = QpSolver(*size)
        if self._program.soft.any():
            self._relaxed = QpSolver(*size, soft=self._program.soft)
        self._functions: list[CompiledFunction[Any]] = [self._program.function]
        if self._contacts is not None:
            self._functions.append(self._contacts.function)
        self._evaluate = self._program.function.bind()
        H, f, A, lower, upper, self._residuals, self._check, self._largest, *rates = self._evaluate.outputs
        self._quadratic_program = H, f, A, lower, upper
        self._speed_goal_rates = tuple(rates)
        if self._contacts is not None:
            rows, first = self._program.contact_rows, self._program.columns
            self._contacts.bind(H, f, A[rows], lower[first + rows.start : first + rows.stop])
        n, first = len(self.speeds), len(self._program.inputs)
        program_values = self._evaluate.input[:first]
        self._values = np.zeros(len(self.inputs)) if self._contacts else program_values
        self._coordinates = tuple(s for s in self.inputs if s.value is None)
        self._parameters = {s: k for k, s in enumerate(self.inputs) if s.value is not None}
        # In a state a parameter may also have the name of a coordinate, see State.given.
        self._lock = CallLock()
        self._settable = frozenset(n for s in self._parameters for n in (s, Symbol(s.path, s.order)))
        self._settings = np.array([s.value or 0.0 for s in self._parameters])
        self._values[len(self._coordinates) :] = self._settings
        self._target_places: dict[Target, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] = {}
        self._dt = self._evaluate.input[first : first + 1]
        self._dt[:] = dt
        self._last = self._evaluate.input[first + 1 : first + 1 + n]
        self._before = self._evaluate.input[first + 1 + n :]
        self._diagnosis = Diagnosis(model, formulation, self._program, self._evaluate, self._contacts)
        kept = (filter(lambda name: name not in self._program.equalities, n) for n in self._program.names)
        self._row_names = tuple(map(tuple, kept))

    @property
    def dt(self) -> float:
        """Time between two steps [s]; it can be set without another compilation."""
        return float(self._dt[0])

    @dt.setter
    def dt(self, value: float) -> None:
        _check_step(value)
        self._dt[:] = value
        if self._contacts is not None:
            self._contacts.gain = _contact_gain(value)
            if self._default_radius:
                self._contacts.radius = _contact_radius(value)

    @property
    def tier(self) -> str:
        """Present kind of evaluation: ``"interpreter"``, or ``"c"`` once everything is compiled."""
        tiers = [function.tier for function in self._functions]
        return "interpreter" if "interpreter" in tiers else tiers[0]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until everything is compiled, at most for a time [s], and return whether it is."""
        end = math.inf if timeout is None else perf_counter() + timeout
        rest = (None if timeout is None else max(0.0, end - perf_counter()) for _ in self._functions)
        return all(function.wait(left) for function, left in zip(self._functions, rest, strict=True))

    @one_at_a_time
    def reset(self, speeds: StateLike | None = None) -> None:
        """Forget the last commands and solutions: the next step starts from some speeds, or from rest.

        See Also
        --------
        kineverse.control.Controller.step
        """
        self._solver.reset()
        self._relaxed.reset()
        known = as_state(speeds or {}, self.speeds)
        self._last[:] = [known.given(s) or 0.0 for s in self.speeds]
        if len(self._before):
            self._before[:] = self._last

    @one_at_a_time
    def set(self, target: Target | Symbol | str, value: npt.ArrayLike) -> None:
        """Set a target, or a parameter by symbol or name, for all further steps.

        The value in a state has precedence.

        Raises
        ------
        UnknownNameError
            For a parameter that no task of the controller has.
        ShapeError, InvalidValueError
            For a value of another shape, or one that is not finite.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> hand = model.fk("fetch/gripper_link")[:3, 3]
        >>> target = kv.control.Target("goal", [0.8, 0.0, 0.9])
        >>> tasks = [kv.control.Goal(hand, target.expression, name="hand")]
        >>> controller = kv.control.Controller(model, tasks, dt=0.02, tier="interpreter")
        >>> controller.set(target, hand(model.default_state()) + [0, 0.1, 0])
        >>> round(controller.step(model.default_state()).residuals["hand"], 3)
        0.1
        """
        if isinstance(target, Target):
            self._set_target(target, value)
            return
        if np.ndim(value):
            raise ShapeError(f"The parameter '{target}' is a number, not of shape {np.shape(value)}.")
        named = {str(s): s for s in self._parameters}
        symbol = named.get(str(target), target)
        if not isinstance(symbol, Symbol) or symbol not in self._parameters:
            raise self._unknown_parameter(symbol)
        number = float(np.asarray(value, dtype=float))
        if not math.isfinite(number):
            raise InvalidValueError(f"The value of '{symbol}' has to be finite, not {number!r}.")
        place = self._parameters[symbol]
        self._values[place] = self._settings[place - len(self._coordinates)] = number

    def _set_target(self, target: Target, value: npt.ArrayLike) -> None:
        numbers = target.numbers(value)
        if target not in self._target_places:
            used = [k for k, s in enumerate(target.parameters) if s in self._parameters]
            if not used:
                raise self._unknown_parameter(target.parameters[0])
            places = [self._parameters[target.parameters[k]] for k in used]
            self._target_places[target] = np.array(used, dtype=np.intp), np.array(places, dtype=np.intp)
        chosen, at = self._target_places[target]
        self._values[at] = chosen_numbers = numbers[chosen]
        self._settings[at - len(self._coordinates)] = chosen_numbers

    def _unknown_parameter(self, symbol: object) -> UnknownNameError:
        known = map(str, self._parameters)
        return UnknownNameError(f"No task depends on '{symbol}'. {suggest(str(symbol), known, 'parameter')}")

    @property
    def contact_slots(self) -> ContactSlots:
        """Rows of contacts.

        Raises
        ------
        InvalidValueError
            For a controller without a scene.
        """
        if self._contacts is None:
            raise InvalidValueError("This controller has no rows of contacts; give it a scene=.")
        return self._contacts

    @one_at_a_time
    def query_contacts(self, state: StateLike | npt.ArrayLike) -> DistanceResults:
        """Return the near pairs at a state, for parameters of tasks that depend on them.

        The next :meth:`step`, at the same state, uses them and asks no more.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            As :meth:`step`; also for a controller without a scene.
        """
        slots = self.contact_slots
        self._read(state)
        slots.update(self._values[self._contact_values])
        self._queried = True
        return slots.found

    def step(self, state: StateLike | npt.ArrayLike) -> Command:
        """Return the command for one time step at a state.

        Parameters
        ----------
        state
            A state; a mapping by symbol or name; or the values of :attr:`inputs` as a vector, which is the
            fastest. Parameters without a value have their own.

        Raises
        ------
        InfeasibleError
            If hard rows contradict each other; with an irreducible set of them, and the least-violating
            command.
        NotFiniteError
            If the program or its solution has a NaN, with the tasks or constraints where it arises.
        UnknownNameError, ShapeError, InvalidValueError
            For a state that lacks a value, or has another length, or a NaN.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> goal = kv.control.Goal(model.symbol("kitchen/fridge_door"), 1.0, gain=5, name="open")
        >>> controller = kv.control.Controller(model, [goal], dt=0.02, tier="interpreter")
        >>> command = controller.step({"kitchen/fridge_door": 0.2})
        >>> round(command.speeds[kv.velocity("kitchen/fridge_door")], 3), command.active[0]
        (1.5, 'kitchen/fridge_door/velocity')
        >>> command.residuals
        {'open': 0.8}
        """
        # A collection of the whole program takes many times as long as a step; it has time between steps.
        with self._lock, no_collection():
            return self._step(state)

    def _step(self, state: StateLike | npt.ArrayLike) -> Command:
        start = perf_counter()
        self._read(state)
        if self._contacts is not None:
            self._evaluate.input[: len(self._program_values)] = self._values[self._program_values]
            if not self._queried:
                self._contacts.update(self._values[self._contact_values])
            self._queried = False
        read = perf_counter()
        self._evaluate()
        if self._contacts is not None:
            self._contacts.write(self._costs.recovery, RECOVERY_WEIGHT * self._largest.item())
        if not math.isfinite(self._check.item()):
            raise self._diagnosis.not_finite()
        evaluated = perf_counter()
        result = self._solver.solve(*self._quadratic_program)
        if result.status != "solved" and self._relaxed is not self._solver:
            result = self._relaxed.solve(*self._quadratic_program)
        solved = perf_counter()
        times = StepTimes(read - start, evaluated - read, solved - evaluated, solved - start)
        if result.status != "solved":
            least = self._diagnosis.least_violation()
            command = self._command(least.x, np.zeros(len(result.multipliers)), 0, times)
            if np.abs(least.violations).max() < _FEASIBLE:
                return command  # the solver failed, not the problem
            raise self._diagnosis.infeasible(command)
        return self._command(result.x, result.multipliers, result.iterations, times)

    def _command(self, x: Array, multipliers: Array, iterations: int, times: StepTimes) -> Command:
        n = len(self.speeds)
        if len(self._before):
            self._before[:] = self._last
        self._last[:] = vector = x[:n]
        program, rates = self._program, self._speed_goal_rates
        jacobian, rate = (rates[0].copy(), rates[1].copy()) if rates else (None, None)
        errors = TaskErrors(
            program.residuals, self._residuals.copy(), program.speed_goals, program.speed_rows, jacobian, rate
        )
        values = x.tolist()
        speeds, progress = dict(zip(self.speeds, values, strict=False)), min(values[n:], default=1.0)
        contacts = () if self._contacts is None else self._contacts.found
        return Command(
            speeds, vector, progress, times, iterations, multipliers, self._row_names, contacts, errors
        )

    def _read(self, state: StateLike | npt.ArrayLike) -> None:
        if not isinstance(state, np.ndarray) and isinstance(state, Mapping):
            if not isinstance(state, State):
                state = as_state(state, (*self.model.symbols, *self.model.speeds, *self.inputs))
            self._values[: len(self._coordinates)] = state.vector(self._coordinates)
            self._values[len(self._coordinates) :] = self._settings
            if not self._settable.isdisjoint(state):
                for symbol, place in self._parameters.items():
                    value = state.given(symbol)
                    if value is not None:
                        self._values[place] = value
            return
        try:
            vector = np.asarray(state, dtype=float)
        except (TypeError, ValueError):
            raise InvalidValueError(f"A step takes a state, a mapping or a vector, not {state!r}.") from None
        if vector.shape != self._values.shape:
            raise ShapeError(
                f"The vector of a state has the {len(self.inputs)} values of controller.inputs, not shape "
                f"{vector.shape}."
            )
        self._values[:] = vector

    def run(
        self,
        *,
        source: Callable[[], State | None],
        sink: Callable[[dict[Symbol, float]], object],
        rate: float | None = None,
        **options: Any,
    ) -> LoopReport:
        """Run the controller at a fixed rate, and return a report; see :func:`.run_control_loop`.

        Parameters
        ----------
        source
            Returns the latest state, or None if there is no new one.
        sink
            Takes speeds by symbol, in every cycle.
        rate
            Cycles per second, by default ``1/dt``; another rate sets :attr:`dt`.
        options
            ``stale``, ``acceleration``, ``duration``, ``until``, ``on_error``, ``clock``, ``sleep``.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> goal = kv.control.Goal(model.symbol("kitchen/fridge_door"), 1.0, name="open")
        >>> controller = kv.control.Controller(model, [goal], dt=0.02, tier="interpreter")
        >>> states = [model.default_state()]
        >>> drive = lambda speeds: states.append(model.integrate(states[-1], speeds, 0.02))
        >>> report = controller.run(source=lambda: states[-1], sink=drive, duration=0.1)
        >>> states[-1]["kitchen/fridge_door"] > 0
        True
        """
        if rate is not None:
            if not 0 < rate < math.inf:
                raise InvalidValueError(f"rate= is a positive number of cycles per second, not {rate!r}.")
            self.dt = 1 / rate
        return run_control_loop(self, rate=1 / self.dt, source=source, sink=sink, **options)

    def __repr__(self) -> str:
        return (
            f"<Controller: {len(self.tasks)} tasks, {len(self.speeds)} speeds, "
            f"{self._program.rows} rows, dt {self.dt:g} s>"
        )


def _contact_radius(dt: float) -> float:
    return max(0.05, _APPROACH * dt)


def _contact_gain(dt: float) -> float:
    return min(0.5 / dt, _CONTACT_GAIN)


def _check_step(dt: float) -> None:
    if not (isinstance(dt, int | float) and 0 < dt < math.inf):
        raise InvalidValueError(f"dt= is a positive time in seconds, not {dt!r}.")
