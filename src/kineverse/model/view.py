"""Everything one can ask a model or a snapshot of it."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.state import State
from kineverse.symbols import Symbol, parse_symbol_name

from .constraint import Constraint
from .equalities import Equalities
from .integration import integrate
from .operation import ARTICULATIONS, CONSTRAINTS
from .projection import TOLERANCE, project
from .structure import Structure
from .velocity import VelocityRows, velocity_rows
from .violations import Checks, Violations, find_violations

if TYPE_CHECKING:
    from kineverse.formats.saving import Saved


class ModelView(Structure):
    """Read access to a model: data, kinematics, constraints. Base of :class:`Model` and :class:`Snapshot`."""

    # -- constraints ---------------------------------------------------------------------------------------

    def constraints_for(
        self,
        subject: Expression | Iterable[Symbol | Expression],
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
            An expression, or several, or symbols.
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
            names = self._relevance.of(subject, head, exact=exact, bounds=bounds, closure=closure)
            return {name: self._carried(name, head[name]) for name in names}

    def violations(self, values: Mapping[Any, float], tolerance: float = 1e-9) -> Violations:
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
            If a constraint is about a given symbol and a position that is missing, or a name is unknown.
        NameTakenError
            If a symbol has two values, by name and as such, or a name is that of several symbols.
        """
        with self._lock:
            self._catch_up()
            if self._checks is None:
                followed = {name: self._followed(c) for name, c in self._head[CONSTRAINTS].items()}
                self._checks = Checks(followed, self.rates.dependent.values())
            known = self._index.sorted() if not isinstance(values, State) else ()
            return find_violations(self._checks, values, (*known, *self.rates, *self.speeds), tolerance)

    def limits(self, symbol: Symbol | str, values: Mapping[Any, float] | None = None) -> tuple[float, float]:
        """Return the bounds that constraints put on a single symbol, ±inf where there are none.

        Bounds that are expressions are evaluated at ``values``, by default at :meth:`default_state`; those
        that cannot be evaluated are left out.
        """
        with self._lock:
            self._catch_up()
            wanted = symbol if isinstance(symbol, Symbol) else self.symbol(symbol)
            lower, upper = -np.inf, np.inf
            for name in self._relevance.on(wanted):
                c = self._head[CONSTRAINTS][name]
                low, high = self._bound(c.lower, values), self._bound(c.upper, values)
                lower, upper = (
                    max(lower, -np.inf if low is None else low),
                    min(upper, np.inf if high is None else high),
                )
            return float(lower), float(upper)

    def _bound(self, bound: Expression, values: Mapping[Any, float] | None) -> float | None:
        if not bound.symbols:
            return float(bound)
        known = (
            values
            if isinstance(values, State)
            else State(values)
            if values is not None
            else self.default_state()
        )
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
            return State(values, source="default")

    def velocity_rows(
        self,
        dt: float,
        subject: Expression | Iterable[Symbol | Expression] | None = None,
        *,
        speeds: Sequence[Symbol] | None = None,
        gain: float | None = None,
    ) -> VelocityRows:
        """Return the linear rows in speeds that keep the constraints over a step of ``dt`` seconds.

        Of the constraints relevant for ``subject`` and of the speed limits of whatever they let move, or of
        all; see :mod:`kineverse.model.velocity`.
        """
        with self._lock:
            every = dict(self.constraints)
            constraints = every if subject is None else self.constraints_for(subject)
            return velocity_rows(
                constraints, dt, rates=self.rates, speeds=speeds, gain=gain, speed_limits=every
            )

    def integrate(self, state: Mapping[Any, float], speeds: Mapping[Any, float], dt: float) -> State:
        """Return the state ``dt`` seconds later, at constant speeds: :mod:`kineverse.model.integration`."""
        with self._lock:
            coordinates, rates = self.degrees_of_freedom, self.rates
        return integrate(coordinates, rates, state, speeds, dt)

    def project(
        self, state: Mapping[Any, float], *, fixed: Iterable[Symbol | str] = (), tolerance: float = TOLERANCE
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
        UnsolvedError
            If no such place is found, naming what does not hold, by how much, and what was tried; or if a
            loop does not close at the state.
        UnknownNameError
            If a value is missing, or a name is unknown.
        """
        with self._lock:
            self._catch_up()
            if self._equalities is None:
                self._equalities = self._equalities_of(None)
            if not isinstance(state, State):
                state = State({self.symbol(k) if isinstance(k, str) else k: v for k, v in state.items()})
            return project(self._equalities, state, fixed, tolerance)

    def _equalities_of(self, names: Collection[str] | None) -> Equalities:
        """Return the equalities of these names, or all."""
        self._catch_up()
        return Equalities(dict(self._head[CONSTRAINTS]), self.rates, self._head[ARTICULATIONS], names)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        tolerance: float | None = None,
        leave_out: Iterable[str] = (),
        strict: bool = False,
    ) -> Saved:
        """Write the model to a file: a document (.kv.json), URDF (.urdf) or MJCF (.xml).

        A document says all of it. Motions that the others cannot say are refused by name; constraints are
        left out with a remark, see :func:`kineverse.formats.saving.save`.

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
        from kineverse.formats.saving import save

        return save(self, path, tolerance=tolerance, leave_out=leave_out, strict=strict)

    # -- printing ------------------------------------------------------------------------------------------

    def __str__(self) -> str:
        return (
            f"{len(self.frames)} frames, {len(self.degrees_of_freedom)} DoF, "
            f"{len(self.constraints)} constraints (version {self.version})"
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"
