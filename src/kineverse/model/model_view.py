"""Queries on a model: constraints, limits, default state, velocity rows, integration, projection."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from kineverse._checks import check_flag
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.state import State, StateLike, as_state, check_meant
from kineverse.symbols import Symbol, parse_symbol_name

from . import registry
from .constraint import Constraint
from .integration import integrate
from .operation import ARTICULATIONS, CONSTRAINTS
from .projection import TOLERANCE, EqualityConstraints, project
from .registry import SaveResult
from .symbolic_view import SymbolicView
from .velocity_rows import VelocityRows, velocity_rows
from .violations import Checks, Violations, find_violations


class ModelView(SymbolicView):
    """Read access to a model: data, kinematics, constraints. Base of :class:`Model` and :class:`Snapshot`."""

    # -- constraints ---------------------------------------------------------------------------------------

    def constraints_for(
        self,
        subject: Expression | str | Iterable[Symbol | Expression | str],
        exact: bool = False,
        bounds: bool = False,
        closure: bool = False,
    ) -> dict[str, Constraint]:
        """Return the constraints that matter for an expression or for symbols, by name.

        Coordinates are compared, whatever their order: those of the subject and of every key of its gradient
        against those of the constrained expressions. So a lock on a velocity is found from a pose.

        Parameters
        ----------
        subject
            An expression, or several, or symbols; the name of a frame stands for its pose.
        exact
            The papers' formula, ``V(φ_c) ∩ V(ψ) ≠ ∅``: symbols rather than coordinates, values only.
        bounds
            Also compare what the bounds are about.
        closure
            Go on with the symbols of what was found, until nothing new turns up.
        """
        with self._lock:
            self._catch_up()
            head = self._head[CONSTRAINTS]
            names = self._relevance.of(
                self._expressions(subject), head, exact=exact, bounds=bounds, closure=closure
            )
            return {name: self._carried(name, head[name]) for name in names}

    def _expressions(self, subject: Expression | str | Iterable[Symbol | Expression | str]) -> Any:
        """Return what a subject is, with poses in place of the names of frames."""
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

    def violations(self, values: StateLike, tolerance: float = 1e-9) -> Violations:
        """Return the constraints that values break: (name, value, lower, upper, excess) each, worst first.

        Constraints about none of the given symbols, or about speeds that are not given, are listed as
        ``unchecked``. A closed loop that does not close here is listed by its name, and like any constraint
        without a value before all others: NaN, off by NaN.

        Parameters
        ----------
        values
            A state, or a mapping from symbols or names to numbers.
        tolerance
            An excess up to this is none, in the unit of the constraint.

        Raises
        ------
        UnknownNameError
            If a constraint is about a given symbol and a position that is missing, a name is unknown, or a
            state has no value for anything in the model.
        DuplicateNameError
            If a symbol has two values, by name and as such, or a name is that of several symbols.
        """
        with self._lock:
            self._catch_up()
            if self._checks is None:
                followed = {name: self._followed(c) for name, c in self._head[CONSTRAINTS].items()}
                self._checks = Checks(followed, self.rates.dependent.values())
            found = find_violations(self._checks, values, self._known(values), tolerance)
            if isinstance(values, State) and 0 < len(found.unchecked) == len(self._checks.names):
                check_meant(values, self._known({}))
            return found

    def _known(self, values: object) -> tuple[Symbol, ...]:
        """Return the symbols that plain values may be about; a state may be about anything."""
        if isinstance(values, State):
            return ()
        self._catch_up()
        found = dict.fromkeys((*self._index.sorted(), *self.symbols, *self.rates, *self.speeds))
        found.update(dict.fromkeys(self.rates.dependent))
        return tuple(found)

    def limits(self, symbol: Symbol | str, values: StateLike | None = None) -> tuple[float, float]:
        """Return the bounds that constraints put on a single symbol, ±inf where there are none.

        Bounds that are expressions are evaluated at ``values``, by default at :meth:`default_state`; those
        that cannot be evaluated are left out.
        """
        with self._lock:
            self._catch_up()
            wanted = symbol if isinstance(symbol, Symbol) else self.symbol(symbol)
            if values is not None:
                values = as_state(values, self._known(values))
            lower, upper = -np.inf, np.inf
            for name in self._relevance.on(wanted):
                c = self._head[CONSTRAINTS][name]
                low, high = self._bound(c.lower, values), self._bound(c.upper, values)
                lower, upper = (
                    max(lower, -np.inf if low is None else low),
                    min(upper, np.inf if high is None else high),
                )
            return float(lower), float(upper)

    def _bound(self, bound: Expression, values: StateLike | None) -> float | None:
        if not bound.symbols:
            return float(bound)
        known = self.default_state() if values is None else values
        if any(s not in known and s.value is None for s in bound.symbols):
            return None
        return float(bound(known))

    def symbol(self, name: str) -> Symbol:
        """Return the symbol of a text name, if the model knows its coordinate, be it free or dependent.

        Raises
        ------
        UnknownNameError
            With similar names.
        """
        path, order = parse_symbol_name(name)
        coordinates = (*self.symbols, *self.rates.dependent)
        for known in coordinates:
            if known.path == path:
                return known if order == 0 else Symbol(path, order, known.role)
        for speed in self.speeds:
            if speed.path == path and order >= 1:
                return Symbol(path, order, speed.role)
        raise UnknownNameError(
            f"There is no symbol {name!r}. {suggest(name, map(str, coordinates), 'symbol')}"
        )

    def default_state(self) -> State:
        """Return a value for every symbol: 0, or its home, clipped into limits; parameters keep theirs.

        Limits are constraints on a straight line over one symbol, such as those of a joint and of what
        follows it. Others, as on the sum of two, are not looked at: :meth:`violations` says which hold.
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
            if wrong:  # parameters first, as others follow from them
                symbol = min(wrong, key=lambda s: s.value is None)
                raise self._no_default(symbol, values[symbol])
            return State(values, source="default")

    def _clip(self, values: dict[Symbol, float], symbols: Iterable[Symbol]) -> None:
        """Bring values within the limits of each symbol alone."""
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
        # Bounds may be about symbols that have such bounds too: at most so many rounds until all fit.
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
        """Return the error for a default that is not finite, with who is to blame."""
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
        """Return the tags that write a path, as far as that is known here."""
        return []

    def velocity_rows(
        self,
        dt: float,
        subject: Expression | str | Iterable[Symbol | Expression | str] | None = None,
        *,
        speeds: Sequence[Symbol] | None = None,
        gain: float | None = None,
    ) -> VelocityRows:
        """Return the linear rows in speeds that keep the constraints over a step of ``dt`` seconds.

        Of the constraints relevant for ``subject`` and of the speed limits of whatever they let move, or of
        all; see :meth:`constraints_for` and :mod:`kineverse.model.velocity_rows`.
        """
        with self._lock:
            every = dict(self.constraints)
            constraints = every if subject is None else self.constraints_for(subject)
            return velocity_rows(
                constraints, dt, rates=self.rates, speeds=speeds, gain=gain, speed_limits=every
            )

    def integrate(self, state: StateLike, speeds: StateLike, dt: float, *, clip: bool = False) -> State:
        """Return the state ``dt`` seconds later, at constant speeds: :mod:`kineverse.model.integration`.

        Surprise first: **limits and other constraints stop nothing**. At 100 rad/s a door of 1.57 rad is at
        100 rad after one second, and :meth:`violations` says so.

        Parameters
        ----------
        state
            Values of at least all coordinates that move: a state, or a mapping from symbols or names of this
            model to numbers.
        speeds
            From free speeds or their names to numbers [m/s], [rad/s]; those not given are 0.
        dt
            [s]; may be negative.
        clip
            Whether each coordinate is brought back to the nearest end of its limits afterwards, as in
            :meth:`default_state`: constraints on a straight line over it alone. Others, as on the sum of two,
            or locks of speeds, are not looked at.

        Raises
        ------
        UnknownNameError
            For a speed that moves nothing here, and a value of something that is not in the model.
        InvalidValueError
            For NaN or an infinite step, or if coordinates run to infinity on the way.
        """
        with self._lock:
            coordinates, rates = self.degrees_of_freedom, self.rates
            check_flag("clip", clip)
            given = as_state(state, self._known(state))
            after = integrate(coordinates, rates, given, speeds, dt)
            if not clip:
                return after
            values = dict(after)
            self._clip(values, [s for s in coordinates if s in values])
            return after.updated(values)

    def project(
        self, state: StateLike, *, fixed: Iterable[Symbol | str] = (), tolerance: float = TOLERANCE
    ) -> State:
        """Return the state with coordinates moved as little as it takes for equality constraints to hold.

        These are constraints on positions whose bounds are the same, such as closures of loops, see
        :mod:`kineverse.model.projection`. Coordinates that they are about are moved to where they hold, with
        whatever else limits these coordinates. What holds already and all other values stay.

        Parameters
        ----------
        state
            A state, or a mapping from symbols or names to numbers.
        fixed
            Names, or symbols, of coordinates and articulations that do not move.
        tolerance
            How far an equality may be off, in its unit.

        Raises
        ------
        NoSolutionError
            If no such place is found, naming what does not hold, by how much, and what was tried; or if a
            loop does not close at the state.
        UnknownNameError
            If a value is missing, or a name is unknown.
        """
        with self._lock:
            self._catch_up()
            if self._equalities is None:
                self._equalities = self.select_equalities(None)
            return project(self._equalities, as_state(state, self._known(state)), fixed, tolerance)

    def select_equalities(self, names: Collection[str] | None) -> EqualityConstraints:
        """Return the equalities of these names, or all."""
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
        """Write the model to a file: a document (.kv.json), URDF (.urdf) or MJCF (.xml).

        A document says all of it. Motions that the others cannot say are refused by name; constraints are
        left out with a remark, see :func:`kineverse.formats.saver.save`.

        Parameters
        ----------
        path
            Of the file.
        tolerance
            How far frames may be off in URDF and MJCF, in position [m] and angle [rad], with proof; None for
            nowhere.
        leave_out
            Names of constraints and articulations.
        strict
            Whether constraints that the format cannot say are refused, too.

        Raises
        ------
        FormatError
            If the name has another ending, the file cannot be written, or naming what the format cannot say.
        """
        names = (leave_out,) if isinstance(leave_out, str) else leave_out
        return registry.save_model(self, path, tolerance=tolerance, leave_out=names, strict=strict)

    # -- printing ------------------------------------------------------------------------------------------

    def __str__(self) -> str:
        return (
            f"{len(self.frames)} frames, {len(self.degrees_of_freedom)} DoF, "
            f"{len(self.constraints)} constraints (version {self.version})"
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"

    def _repr_html_(self) -> str:
        with self._lock:
            mappings = [self.frames, self.articulations, self.constraints, self.bodies, self.data]
            parts = [part._repr_html_() for part in mappings if part]  # type: ignore[attr-defined]
            parts += [self.rates._repr_html_()] if self.rates else []
        tables = "".join(
            f"<details><summary>{escape(part.partition('<caption>')[2].partition('</caption>')[0])}</summary>"
            f"{part}</details>"
            for part in parts
        )
        return f"<div><p>{escape(str(self))}</p>{tables}</div>"
