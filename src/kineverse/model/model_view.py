"""Numeric queries on a model: constraints, limits, default state, velocity rows, integration, projection.

Data and symbolic kinematics are in :mod:`kineverse.model.symbolic_view`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse._checks import check_flag
from kineverse._names import is_pattern, matches_pattern, no_match_error
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    UnknownNameError,
    suggest,
)
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.expressions.substitution import apply_substitution
from kineverse.state import State, StateLike, as_state, check_meant
from kineverse.symbols import Symbol, check_symbols, parse_symbol_name

from . import registry
from .constraint import TOLERANCE, Constraint, ConstraintLike, as_constraint
from .display import count_values
from .operation import ARTICULATIONS, CONSTRAINTS, map_expressions
from .registry import SaveResult, SourceFile
from .symbolic_view import SymbolicView, cached_for_version

if TYPE_CHECKING:
    from kineverse.intervals.arithmetic import RealInterval

    from .integration import Integrator
    from .projection import EqualityConstraints
    from .velocity_constraints.velocity_rows import Recovery, VelocityRows
    from .violations import ConstraintChecker, Violations

# Modules that compute with states are imported at first use: a model is often only read, or edited.


class ModelView(SymbolicView):
    """Read access to a model: data, kinematics, constraints. Base of :class:`.Model` and :class:`.Snapshot`.

    This class adds the queries that take or return numbers to those of :class:`SymbolicView`.
    """

    _sources: tuple[SourceFile, ...] = ()

    @property
    def sources(self) -> tuple[SourceFile, ...]:
        """Files that the model was loaded from, or that were included in it."""
        return self._sources

    # -- constraints ---------------------------------------------------------------------------------------

    def constraints_for(
        self,
        subject: Expression | str | Iterable[Symbol | Expression | str],
        exact: bool = False,
        bounds: bool = False,
        closure: bool = False,
    ) -> dict[str, Constraint]:
        """Return the constraints relevant for an expression or for symbols, by name.

        A constraint is relevant if its expression shares a coordinate, of any order, with the subject or a
        key of the subject's gradient. So a pose finds the lock on a velocity.

        Parameters
        ----------
        subject
            One or several expressions, symbols, or names of frames, which stand for their poses.
        exact
            True for the formula of the papers, ``V(φ_c) ∩ V(ψ) ≠ ∅``: symbols instead of coordinates, without
            gradients.
        bounds
            True to compare the symbols of bounds as well.
        closure
            True to repeat the search with the symbols of the result until it is closed.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> sorted(model.constraints_for(model.fk("kitchen/fridge_door_handle")))
        ['kitchen/fridge_door/position', 'kitchen/fridge_door/velocity']
        """
        with self._lock:
            self._catch_up()
            head = self._head[CONSTRAINTS]
            names = self._relevance.find(
                self._expressions(subject), head, exact=exact, bounds=bounds, closure=closure
            )
            return {name: self._carry_constraint(name, head[name]) for name in names}

    def _expressions(self, subject: Expression | str | Iterable[Symbol | Expression | str]) -> Any:
        if isinstance(subject, str):
            subject = [subject]
        if isinstance(subject, Expression) or not isinstance(subject, Iterable):
            return subject
        return [self._pose_of(item) if isinstance(item, str) else item for item in subject]

    def _pose_of(self, frame: str) -> Expression:
        try:
            return self.fk(frame)
        except UnknownNameError as error:
            if any(str(s.position) == frame.partition(":")[0] for s in (*self.symbols, *self.speeds)):
                raise UnknownNameError(
                    f"There is no frame {frame!r}, and the text stands for one. For the symbol of that name "
                    f"pass model.symbol({frame!r})."
                ) from None
            raise error

    def violations(self, values: StateLike, tolerance: float = TOLERANCE) -> Violations:
        """Return the violated constraints as (name, value, lower, upper, excess), the largest excess first.

        Constraints without any of the given symbols, or with speeds that are not given, are listed as
        ``unchecked``. A loop that does not close is listed by its name. Like any constraint without a value
        it comes first, with NaN as value and excess.

        Parameters
        ----------
        values
            A state, or a mapping from symbols or names to numbers.
        tolerance
            Largest excess of a satisfied constraint, in the unit of the constraint.

        Raises
        ------
        UnknownNameError
            If a constraint has a given symbol and a missing position, a name is unknown, or a state has no
            value of any symbol of the model.
        DuplicateNameError
            If a symbol has two values, by name and by symbol, or several symbols have one name.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> model.violations(model.default_state())
        none violated
        >>> model.violations({"kitchen/fridge_door": 2.0})
        1 violated
          kitchen/fridge_door/position: 0 <= 2 <= 1.5708 is off by 0.429204
        """
        from .violations import find_violations

        with self._lock:
            self._catch_up()
            if self._checker is None:
                self._checker = self._make_checker(None)
            result = find_violations(self._checker, values, self._known(values), tolerance)
            if isinstance(values, State) and 0 < len(result.unchecked) == len(self._checker.names):
                check_meant(values, self._known({}))
            return result

    def constraint_checker(self, symbols: Iterable[Symbol] | None = None) -> ConstraintChecker:
        """Return the constraints as a compiled function of a vector, for loops.

        It is :meth:`violations` of the present version of the model. Each thread needs one of its own.

        Parameters
        ----------
        symbols
            Symbols of the vector, by default :attr:`symbols`; for constraints on speeds append these.
            Constraints on others are not checked. Parameters that are not given have their own values.

        See Also
        --------
        kineverse.model.ConstraintChecker
        """
        with self._lock:
            return self._make_checker(self.symbols if symbols is None else tuple(check_symbols(symbols)))

    def _make_checker(self, symbols: tuple[Symbol, ...] | None) -> ConstraintChecker:
        from .violations import ConstraintChecker

        self._catch_up()
        followed = {name: self._eliminate_dependent(c) for name, c in self._head[CONSTRAINTS].items()}
        return ConstraintChecker(followed, symbols, self.rates.dependent.values())

    def _known(self, values: object) -> tuple[Symbol, ...]:
        """Return the symbols allowed in a plain mapping; a state may have any."""
        if isinstance(values, State):
            return ()
        self._catch_up()
        found = dict.fromkeys((*self._index.sorted(), *self.symbols, *self.rates, *self.speeds))
        found.update(dict.fromkeys(self.rates.dependent))
        return tuple(found)

    def limits(self, symbol: Symbol | str, values: StateLike | None = None) -> tuple[float, float]:
        """Return the limits of a single symbol, at all states or at one; ±inf for none.

        Without ``values``, the symbol is never beyond these limits, wherever the others are: a bound that is
        an expression, such as that of a locked door, counts with its whole range where other coordinates are
        within their constant limits. That is what clips estimates, and what samples are drawn from. With
        ``values``, the limits are those at that state, where the door may be locked at 0: that is what a
        controller needs to know now.

        Parameters
        ----------
        symbol
            A symbol or its name: a coordinate or a speed.
        values
            A state, or a mapping from symbols or names to numbers. Bounds that cannot be evaluated there are
            ignored.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> model.limits("kitchen/fridge_door")
        (0.0, 1.5707963267948966)
        >>> model.limits("kitchen/fridge_door:velocity")
        (-1.5, 1.5)
        """
        with self._lock:
            self._catch_up()
            wanted = symbol if isinstance(symbol, Symbol) else self.symbol(symbol)
            known = None if values is None else as_state(values, self._known(values))
            lower, upper = -np.inf, np.inf
            for name in self._relevance.on(wanted):
                c = self._head[CONSTRAINTS][name]
                low = self._range(c.lower)[0] if known is None else self._bound(c.lower, known)
                high = self._range(c.upper)[1] if known is None else self._bound(c.upper, known)
                lower = lower if low is None else max(lower, low)
                upper = upper if high is None else min(upper, high)
            return float(lower) + 0.0, float(upper) + 0.0  # no -0.0, which people read

    def _bound(self, bound: Expression, values: State) -> float | None:
        if not bound.symbols:
            return float(bound)
        if any(s not in values and s.value is None for s in bound.symbols):
            return None
        return float(bound(values))

    def _range(self, bound: Expression) -> RealInterval:
        """Return the range of a bound over all states within the constant limits of coordinates."""
        if not bound.symbols:
            return float(bound), float(bound)

        def compute() -> RealInterval:
            from kineverse.intervals.enclosure import enclose_bound

            followed = apply_substitution(bound, dict(self.rates.dependent))
            return enclose_bound(followed, {s: self._constant_limits(s) for s in followed.symbols})

        return cached_for_version(self, ("range of a bound", bound), compute)

    def _constant_limits(self, symbol: Symbol) -> RealInterval:
        lower, upper = -math.inf, math.inf
        for name in self._relevance.about(symbol):
            c = self._head[CONSTRAINTS][name]
            if c.line is not None and not (c.lower.symbols or c.upper.symbols):
                slope, offset = c.line
                low, high = sorted((float(bound) - offset) / slope for bound in (c.lower, c.upper))
                lower, upper = max(lower, low), min(upper, high)
        return lower, upper

    def symbol(self, name: str) -> Symbol:
        """Return the symbol of a name; its coordinate is a free or dependent coordinate of the model.

        Examples
        --------
        >>> kv.load("kitchen").symbol("kitchen/fridge_door:velocity")
        kitchen/fridge_door:velocity
        """
        path, order = parse_symbol_name(name)
        coordinates = (*self.symbols, *self.rates.dependent)
        for known in coordinates:
            if known.path == path:
                return known if order == 0 else Symbol(path, order, known.role)
        for speed in self.speeds:
            if speed.path == path and order >= 1:
                return Symbol(path, order, speed.role)
        if path in self.articulations:
            joint = self.articulations[path]
            moved = ", ".join(repr(str(s)) for s in self.symbols_of(joint.child, joint.parent))
            why = f"has no coordinate of its own: it follows {moved}." if moved else "is fixed."
            if joint.coordinates:
                why = f"has coordinates of other names: {moved}."
            raise UnknownNameError(f"The joint {path!r} {why}")
        raise UnknownNameError(
            f"There is no symbol {name!r:.80}. {suggest(name, map(str, coordinates), 'symbol')}"
        )

    def degree_of_freedom(self, name: Symbol | str) -> Symbol:
        """Return the degree of freedom of a name.

        Examples
        --------
        >>> kv.load("kitchen").degree_of_freedom("kitchen/fridge_door").derivative()
        kitchen/fridge_door:velocity
        """
        known = {str(s): s for s in self.degrees_of_freedom}
        if str(name) not in known:
            raise UnknownNameError(
                f"'{name}' is no degree of freedom. {suggest(str(name), known, 'degree of freedom')}"
            )
        return known[str(name)]

    def default_state(self) -> State:
        """Return the default value of every symbol: its home or 0, clipped to the limits.

        Parameters have their own default values. Limits are constraints on a linear function of one symbol,
        such as those of a joint and of a mimic joint. Other constraints, such as those on a sum of two
        symbols, are ignored; see :meth:`violations`.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> model.default_state()["kitchen/fridge_door"]
        0.0
        """
        with self._lock:
            symbols = self.symbols
            values: dict[Symbol, float] = {s: s.value or 0.0 for s in symbols}
            for record in self._head[ARTICULATIONS].values():
                for symbol, home in zip(record.coordinates, record.home, strict=False):
                    if symbol in values:
                        values[symbol] = home
            self._clip(values, symbols)
            wrong = [s for s, value in values.items() if not math.isfinite(value)]
            if wrong:  # parameters first, because bounds may depend on them
                symbol = min(wrong, key=lambda s: s.value is None)
                raise self._no_default(symbol, values[symbol])
            return State(values, source="default")

    def _clip(self, values: dict[Symbol, float], symbols: Iterable[Symbol]) -> None:
        self._catch_up()
        later = []
        for symbol in symbols:
            for name in self._relevance.about(symbol):
                c = self._head[CONSTRAINTS][name]
                if c.line is None:
                    continue
                if c.lower.symbols or c.upper.symbols:
                    later.append((symbol, c))
                else:
                    values[symbol] = c.nearest(values[symbol], float(c.lower), float(c.upper))
        # Bounds may depend on symbols with bounds of their own, so the clipping is repeated.
        for _ in later:
            before = dict(values)
            for symbol, c in later:
                known = State(values)
                if all(s in known or s.value is not None for s in (*c.lower.symbols, *c.upper.symbols)):
                    low, high = float(c.lower(known)), float(c.upper(known))
                    values[symbol] = c.nearest(values[symbol], low, high)
            if values == before:
                break

    def _no_default(self, symbol: Symbol, value: float) -> InvalidValueError:
        names = [n for n, a in self._head[ARTICULATIONS].items() if symbol in a.coordinates]
        paths = [f"{ARTICULATIONS}/{name}" for name in names]
        paths += [f"{CONSTRAINTS}/{name}" for name in self._relevance.about(symbol)]
        if symbol.value is not None and not math.isfinite(symbol.value):
            why = "that is its value as a parameter"
        else:
            why = f"it follows from {', '.join(paths[:4])}" if paths else "nothing gives it another one"
        writers = dict.fromkeys(tag for path in paths[:4] for tag in self._writers(path))
        by = f", written by {', '.join(map(repr, writers))}" if writers else ""
        return InvalidValueError(
            f"The default of '{symbol}' is {value:g}, which is not finite: {why}{by}. Give it a finite home, "
            "limits or value."
        )

    def _writers(self, path: str) -> list[str]:
        """Return the tags that write a path; empty if unknown."""
        return []

    def velocity_rows(
        self,
        dt: ExpressionLike,
        subject: Expression | str | Iterable[Symbol | Expression | str] | None = None,
        *,
        speeds: Sequence[Symbol] | None = None,
        gain: ExpressionLike | None = None,
        recovery: Recovery = "required",
        extra: Mapping[str, ConstraintLike] | None = None,
    ) -> VelocityRows:
        """Return linear rows in the speeds that enforce constraints over a step of ``dt`` seconds.

        With a subject, these are the constraints relevant for it and the speed limits of all coordinates that
        they involve; without one, all constraints. See :meth:`constraints_for` and
        :mod:`kineverse.model.velocity_constraints.velocity_rows`, for ``gain`` and ``recovery`` as well.

        Parameters
        ----------
        dt
            Control period [s], a number or an expression.
        subject
            One or several expressions, symbols, or names of frames, which stand for their poses.
        speeds
            Columns; by default the speeds of the constraints, sorted. All other speeds are assumed to be 0.
        gain
            Gain [1/s] in (0, 1/dt], a number or an expression; 1/dt by default.
        recovery
            ``"required"`` or ``"allowed"`` outside of bounds.
        extra
            Further constraints by name, as (lower, expression, upper), which the model does not have. They
            are rows whatever the subject is, with the constraints relevant for their expressions.

        Raises
        ------
        DuplicateNameError
            For an extra constraint with the name of a constraint of the model.
        InvalidValueError
            For a step, gain or recovery that is not possible, or an extra constraint that is none.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> rows = model.velocity_rows(0.02, subject="kitchen/fridge_door")
        >>> rows.names, rows.speeds
        (('kitchen/fridge_door/velocity', 'kitchen/fridge_door/position'), (kitchen/fridge_door:velocity,))
        >>> rows.upper({"kitchen/fridge_door": 1.5}).round(2)
        array([1.5 , 3.54])
        """
        from .velocity_constraints.velocity_rows import velocity_rows

        with self._lock:
            every = dict(self.constraints)
            added = self._extra_constraints({} if extra is None else extra)
            if subject is None:
                constraints = every
            else:
                constraints = self.constraints_for(subject)
                for constraint in added.values():
                    constraints |= self.constraints_for(constraint.expression)
            return velocity_rows(
                {**constraints, **added},
                dt,
                rates=self.rates,
                speeds=speeds,
                gain=gain,
                speed_limits=every,
                recovery=recovery,
            )

    def _extra_constraints(self, extra: Mapping[str, ConstraintLike]) -> dict[str, Constraint]:
        """Return further constraints by name, coordinates carried by their rates."""
        for name in extra:
            if name in self._head[CONSTRAINTS]:
                raise DuplicateNameError(
                    f"The model has a constraint {name!r} already; give the extra one another name."
                )
        checked = {name: as_constraint(value) for name, value in extra.items()}
        return {name: map_expressions(CONSTRAINTS, c, self.rates.carry) for name, c in checked.items()}

    def integrate(self, state: StateLike, speeds: StateLike, dt: float, *, clip: bool = False) -> State:
        """Return the state after ``dt`` seconds at constant speeds; see :mod:`kineverse.model.integration`.

        **Limits and other constraints are ignored.** At 100 rad/s, a door with a limit of 1.57 rad is at 100
        rad after one second, and :meth:`violations` reports it.

        Parameters
        ----------
        state
            Values of at least all coordinates that move: a state, or a mapping from symbols or names of this
            model to numbers.
        speeds
            Values by free speed or its name [m/s], [rad/s]; the default is 0.
        dt
            Duration [s]; may be negative.
        clip
            True to clip each coordinate to its limits afterwards, as in :meth:`default_state`: constraints on
            a linear function of one coordinate. Other constraints, such as those on a sum of two coordinates
            or locks of speeds, are ignored.

        Raises
        ------
        UnknownNameError
            For a speed that moves no coordinate, or a symbol that is not in the model.
        InvalidValueError
            For NaN or an infinite step, or if coordinates diverge.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> state = model.integrate(model.default_state(), {"kitchen/fridge_door:velocity": 0.5}, dt=0.1)
        >>> state["kitchen/fridge_door"]
        0.05
        """
        with self._lock:
            self._settle()
            check_flag("clip", clip)
            if self._integrator is None:
                from .integration import StateIntegrator

                self._integrator = StateIntegrator(self.degrees_of_freedom, self.rates)
            after = self._integrator.integrate(as_state(state, self._known(state)), speeds, dt)
            if not clip:
                return after
            values = dict(after)
            self._clip(values, [s for s in self.degrees_of_freedom if s in values])
            return after.updated(values)

    def integrator(
        self, speeds: Iterable[Symbol] | None = None, symbols: Iterable[Symbol] | None = None
    ) -> Integrator:
        """Return the motion at constant speeds as a compiled function of vectors, for loops.

        It is :meth:`integrate` without clipping, of the present version of the model. Each thread needs one
        of its own.

        Parameters
        ----------
        speeds
            Speeds of the vector of speeds; all others are zero. By default :attr:`speeds`.
        symbols
            Symbols of the vector of coordinates, by default :attr:`symbols`. Coordinates that the rates of
            moving ones contain have to be among them; parameters that are not have their own values.

        Raises
        ------
        UnknownNameError
            If a symbol is not in the model, or a speed moves none of the symbols.
        DuplicateNameError
            If a symbol is given twice.

        See Also
        --------
        kineverse.model.Integrator
        """
        from .integration import Integrator

        with self._lock:
            layout = self.symbols if symbols is None else tuple(check_symbols(symbols))
            columns = self.speeds if speeds is None else tuple(check_symbols(speeds))
            for given, known, noun in ((layout, self.symbols, "symbol"), (columns, self.speeds, "speed")):
                for s in given:
                    if s not in known:
                        raise UnknownNameError(
                            f"The model has no {noun} '{s}'. {suggest(str(s), map(str, known), noun)}"
                        )
            return Integrator(self.rates, layout, columns)

    def project(
        self, state: StateLike, *, fixed: Iterable[Symbol | str] = (), tolerance: float = TOLERANCE
    ) -> State:
        """Project a state onto the equality constraints with the least change of coordinates.

        These are position constraints with equal bounds, such as loop closures; see
        :mod:`kineverse.model.projection`. The result satisfies them and the other constraints on their
        coordinates. Coordinates of satisfied constraints and all other values stay.

        Parameters
        ----------
        state
            A state, or a mapping from symbols or names to numbers.
        fixed
            Coordinates and articulations that stay fixed, as symbols or names.
        tolerance
            Largest residual of a satisfied equality, in its unit.

        Raises
        ------
        NoSolutionError
            If no solution is found, naming the violated constraints, their residuals and the attempts; or if
            a loop does not close at the state.
        UnknownNameError
            If a value is missing, or a name is unknown.

        See Also
        --------
        kineverse.loops.LoopConstraint
        """
        from .projection import project

        with self._lock:
            self._catch_up()
            if self._equalities is None:
                self._equalities = self.select_equalities(None)
            return project(self._equalities, as_state(state, self._known(state)), fixed, tolerance)

    def select_equalities(self, names: Collection[str] | None) -> EqualityConstraints:
        """Return the equality constraints of some names, or all."""
        from .projection import EqualityConstraints

        self._catch_up()
        return EqualityConstraints(
            dict(self._head[CONSTRAINTS]), self.rates, self._head[ARTICULATIONS], names
        )

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        tolerance: float | None = None,
        leave_out: Iterable[str] = (),
        strict: bool = False,
    ) -> SaveResult:
        """Write the model to a file: a document (.kv.json), URDF (.urdf), MJCF (.xml) or SDF (.sdf).

        A document contains the whole model. The others cannot express all motions and constraints: motions
        are refused by name, constraints are left out with a remark; see :func:`kineverse.formats.saver.save`.

        Parameters
        ----------
        tolerance
            Largest error of a frame in such a file, in position [m] and angle [rad], guaranteed; None for no
            error.
        leave_out
            Names of constraints and articulations to leave out.
        strict
            True to refuse constraints that the format cannot express.

        Raises
        ------
        FormatError
            If the name has another ending, the file cannot be written, or the format cannot express the
            model.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> result = model.save("kitchen.kv.json")
        >>> kv.load("kitchen.kv.json").version
        1
        >>> model.save("kitchen.urdf").remarks[0]
        "URDF has no spring_stiffness: that of 'kitchen/dishwasher_door' is left out"
        """
        names = (leave_out,) if isinstance(leave_out, str) else leave_out
        save = registry.find_service("save")
        result: SaveResult = save(self, path, tolerance=tolerance, leave_out=names, strict=strict)
        return result

    # -- printing ------------------------------------------------------------------------------------------

    def __str__(self) -> str:
        return (
            f"{count_values(len(self.frames), 'frames')}, {len(self.degrees_of_freedom)} DoF, "
            f"{count_values(len(self.constraints), 'constraints')} (version {self.version})"
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"

    def _repr_html_(self) -> str:
        from .display import model_html  # for start-up time

        with self._lock:
            return model_html(self)


def find_symbols(
    model: ModelView, names: Symbol | str | Iterable[Symbol | str], argument: str = ""
) -> Iterator[Symbol]:
    """Yield the symbols of names or patterns; an articulation stands for its coordinates.

    A pattern stands for the degrees of freedom that match, else for those of the articulations that match.
    Messages begin with the argument, such as ``fixed=``.
    """
    coordinates = set(map(str, model.symbols))
    for item in (names,) if isinstance(names, str | Symbol) else names:
        if isinstance(item, Symbol):
            yield item
        elif not isinstance(item, str):
            raise ExpressionError(f"{argument or 'This'} takes symbols or their names, not {item!r:.80}.")
        elif item in model.articulations and item not in coordinates:
            yield from model.articulations[item].coordinates
        elif is_pattern(item) and item not in coordinates:
            yield from _match_symbols(model, item, argument)
        else:
            yield model.symbol(item)


def _match_symbols(model: ModelView, pattern: str, argument: str) -> list[Symbol]:
    free = {str(s): s for s in model.degrees_of_freedom}
    found = [s for name, s in free.items() if matches_pattern(name, (pattern,))]
    joints = {name: joint.coordinates for name, joint in model.articulations.items() if joint.coordinates}
    found = found or [
        s for name, several in joints.items() if matches_pattern(name, (pattern,)) for s in several
    ]
    if not found:
        raise no_match_error(pattern, [*free, *joints], "coordinate", argument)
    return found
