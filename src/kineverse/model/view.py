"""Everything one can ask a model or a snapshot of it."""

from __future__ import annotations

import os
import threading
from collections.abc import ItemsView, Iterable, Iterator, Mapping, Sequence, ValuesView
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import NO_NODES, Expression, as_expression, make
from kineverse.motions import AxisMotion
from kineverse.state import State
from kineverse.symbols import Symbol, check_symbols, parse_symbol_name

from . import kinematics
from .articulation import Articulation
from .body import Body
from .constraint import Constraint
from .frame import WORLD, Frame
from .integration import integrate
from .operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from .rates import Rates
from .reader import ABSENT, Cell, missing
from .relevance import Relevance
from .velocity import VelocityRows, velocity_rows
from .violations import Checks, Violations, find_violations

if TYPE_CHECKING:
    from kineverse.formats.saving import Saved

JacobianForm = Literal["world_aligned", "world", "body"]


class SymbolIndex:
    """Which symbols the values of a model are about, counted so that changes are cheap."""

    def __init__(self) -> None:
        self._count: dict[Symbol, int] = {}

    def add(self, value: Any, sign: int) -> None:
        """Count the symbols of a value, which comes (1) or goes (-1)."""
        for symbol in _symbols_of(value):
            count = self._count.get(symbol, 0) + sign
            if count:
                self._count[symbol] = count
            else:
                del self._count[symbol]

    def sorted(self) -> tuple[Symbol, ...]:
        """Return the symbols in their order."""
        return tuple(sorted(self._count, key=lambda s: s.sort_key))


class ModelView:
    """Read access to a model: data, kinematics, constraints. Base of :class:`Model` and :class:`Snapshot`."""

    def __init__(self, head: dict[str, dict[str, Any]], version: int) -> None:
        self._head = head
        self._version = version
        self._lock = threading.RLock()
        self._forget_index({})
        self._forget_all()

    def _forget_index(self, dependent: Mapping[Symbol, Expression]) -> None:
        self._dependent = dependent
        self._relevance = Relevance(dependent)
        self._index = SymbolIndex()
        self._pending: list[tuple[Cell, Any, Any]] = [
            ((kind, name), ABSENT, value)
            for kind in (FRAMES, CONSTRAINTS)
            for name, value in self._head[kind].items()
        ]

    def _forget_all(self) -> None:
        self._rates: Rates | None = None
        self._poses: dict[tuple[str, str], Expression] = {}
        self._jacobians: dict[Any, Expression] = {}
        self._carried_constraints: dict[str, Constraint] = {}
        self._all_symbols: tuple[Symbol, ...] | None = None
        self._checks: Checks | None = None

    def _changed(self, changes: Sequence[tuple[Cell, Any, Any]]) -> None:
        """Drop what no longer holds."""
        kinds = {cell[0] for cell, _, _ in changes}
        self._pending += changes
        self._all_symbols = None
        if RATES in kinds:
            self._rates = None
            self._carried_constraints.clear()
            self._poses.clear()
            self._jacobians.clear()
        if FRAMES in kinds:
            self._poses.clear()
            self._jacobians.clear()
        if CONSTRAINTS in kinds or RATES in kinds:
            self._checks = None
            for (kind, name), _, _ in changes:
                if kind == CONSTRAINTS:
                    self._carried_constraints.pop(name, None)

    def _settle(self) -> None:
        """Bring an edit in progress up to date before it is read; there is none here."""

    def _ordered(self, kind: str) -> dict[str, Any]:
        """Return the values of a kind in the order in which operations write them."""
        return self._head[kind]

    def _catch_up(self) -> None:
        self._settle()
        if self.rates.dependent != self._dependent:
            self._forget_index(self.rates.dependent)
        pending, self._pending = self._pending, []
        for (kind, name), before, after in pending:
            if kind not in (FRAMES, CONSTRAINTS):
                continue
            if before is not ABSENT:
                self._index.add(before, -1)
                if kind == CONSTRAINTS:
                    self._relevance.remove(name, before)
            if after is not ABSENT:
                self._index.add(after, 1)
                if kind == CONSTRAINTS:
                    self._relevance.add(name, after)

    # -- data ----------------------------------------------------------------------------------------------

    @property
    def version(self) -> int:
        """Counts committed edits."""
        return self._version

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Frames by name; the world itself is not among them. Transforms are in plain coordinates."""
        return self._named(FRAMES)

    @property
    def bodies(self) -> Mapping[str, Body]:
        """Bodies by the name of the frame they are attached to."""
        return self._named(BODIES)

    @property
    def articulations(self) -> Mapping[str, Articulation]:
        """Records of articulations by name."""
        return self._named(ARTICULATIONS)

    @property
    def data(self) -> Mapping[str, Any]:
        """Whatever else operations wrote, by name."""
        return self._named(DATA)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Constraints by name, coordinates carried by their rates."""
        return _Named(self, CONSTRAINTS, self._carried)

    def _named(self, kind: str) -> Mapping[str, Any]:
        return _Named(self, kind, None)

    def _carried(self, name: str, constraint: Constraint) -> Constraint:
        rates = self.rates
        if rates.is_empty:
            return constraint
        known = self._carried_constraints.get(name)
        if known is None:
            known = Constraint(
                rates.carry(constraint.lower),
                rates.carry(constraint.expression),
                rates.carry(constraint.upper),
            )
            self._carried_constraints[name] = known
        return known

    def _followed(self, constraint: Constraint) -> Constraint:
        """Return a constraint in terms of what does not depend on anything, speeds included."""
        rates = self.rates
        if not any(s.position in rates.dependent for s in constraint.symbols):
            return constraint
        parts = (constraint.lower, constraint.expression, constraint.upper)
        return Constraint(*(rates.eliminate(rates.carry(part)) for part in parts))

    @property
    def rates(self) -> Rates:
        """The rate table, see :mod:`kineverse.model.rates`."""
        with self._lock:
            self._settle()
            if self._rates is None:
                self._rates = Rates(dict(self._head[RATES].values()))
            return self._rates

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The coordinates and parameters of all frames and constraints, sorted: what a configuration is.

        A coordinate of which only the speed occurs is among them, unless that speed is one of those that move
        other coordinates: the wheels of a base, the angular velocity of a ball joint.
        """
        with self._lock:
            self._settle()
            if self._all_symbols is None or self._pending:
                self._catch_up()
                mentioned = self._index.sorted()
                found = {s for s in mentioned if s.order == 0}
                wheels: set[Symbol] = set()
                for coordinate, row in self.rates.items():
                    found.add(coordinate)
                    found.update(s for value in row.values() for s in value.symbols if s.order == 0)
                    wheels.update(speed.position for speed in row)
                # What only has its speed limited is somewhere, too; a wheel that drives others need not be.
                found.update({s.position for s in mentioned if s.order} - wheels)
                for itself in self.rates.dependent.values():
                    found.update(itself.symbols)
                found -= self.rates.dependent.keys()
                self._all_symbols = tuple(sorted(found, key=lambda s: s.sort_key))
            return self._all_symbols

    @property
    def degrees_of_freedom(self) -> tuple[Symbol, ...]:
        """The coordinates among :attr:`symbols`; no parameters."""
        return tuple(s for s in self.symbols if s.has_derivative)

    @property
    def speeds(self) -> tuple[Symbol, ...]:
        """The free speeds that move the coordinates, sorted."""
        with self._lock:
            rates = self.rates
            found: set[Symbol] = set()
            for coordinate in self.degrees_of_freedom:
                found.update(rates[coordinate] if coordinate in rates else (coordinate.derivative(),))
            return tuple(sorted(found, key=lambda s: s.sort_key))

    # -- kinematics ----------------------------------------------------------------------------------------

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        """Return relative_to_T_frame, a 4×4 expression [m], [rad]; coordinates are carried by their rates.

        Raises
        ------
        UnknownNameError
            If a frame does not exist, with similar names.
        """
        with self._lock:
            self._settle()
            known = self._poses.get((frame, relative_to))
            if known is None:
                if relative_to == WORLD:
                    known = kinematics.place_in_world(frame, self._frame).matrix()
                else:
                    known = kinematics.relative(frame, relative_to, self._frame)
                known = self._poses[frame, relative_to] = self.rates.carry(known)
            return known

    def jacobian(
        self,
        frame: str,
        relative_to: str = WORLD,
        form: JacobianForm = "world_aligned",
        symbols: Sequence[Symbol] | None = None,
        heuristic: bool = False,
    ) -> Expression:
        """Return the geometric Jacobian of a frame, 6×n: linear rows [m] first, then angular rows [rad].

        Parameters
        ----------
        frame, relative_to
            What moves and with respect to what.
        form
            ``world_aligned``: velocity of the frame's origin in axes of ``relative_to``; ``world``: the
            spatial twist there; ``body``: in the frame itself.
        symbols
            One column for each: positions or their velocities. By default the speeds that move the frame,
            sorted (:meth:`speeds_of`).
        heuristic
            Whether heuristic gradient entries count; a Jacobian is about facts, so by default they do not.
        """
        if form not in ("world_aligned", "world", "body"):
            raise UnknownNameError(
                f"There is no form {form!r}; forms are 'world_aligned', 'world' and 'body'."
            )
        key = (
            frame,
            relative_to,
            form,
            None if symbols is None else tuple(check_symbols(symbols)),
            heuristic,
        )
        with self._lock:
            self._settle()
            known = self._jacobians.get(key)
            if known is None:
                known = self._jacobians[key] = self._jacobian(*key)
            return known

    def _jacobian(
        self, frame: str, relative_to: str, form: str, symbols: tuple[Symbol, ...] | None, heuristic: bool
    ) -> Expression:
        rates = self.rates
        if relative_to == WORLD:
            base, tip = kinematics.ROOT, kinematics.place_in_world(frame, self._frame)
        else:
            to_base, to_tip = kinematics.branches(frame, relative_to, self._frame)
            base, tip = kinematics.place(to_base, self._frame), kinematics.place(to_tip, self._frame)
        rotation, position, columns = kinematics.twists(base, tip, heuristic)
        tip_nodes = tip.nodes | base.nodes
        by_speed: dict[Symbol, Expression] = {}
        for key, twist in columns.items():
            v, w = twist.linear, twist.angular
            if form == "world":
                v = v + ca.cross(position, w)
            elif form == "body":
                v, w = ca.mtimes(rotation.T, v), ca.mtimes(rotation.T, w)
            column = rates.carry(make(ca.densify(ca.vertcat(v, w)), (6,), twist.nodes | tip_nodes))
            row = rates.row(key.position) if key.order == 1 else None
            for speed, rate in row.items() if row is not None else ((key, as_expression(1.0)),):
                term = column if row is None else column * rates.carry(rate)
                by_speed[speed] = by_speed[speed] + term if speed in by_speed else term
        if symbols is None:
            chosen = sorted(by_speed, key=lambda s: s.sort_key)
        else:
            chosen = [s.derivative() if s.order == 0 and s.has_derivative else s for s in symbols]
        zero = as_expression(np.zeros(6))
        parts = [by_speed.get(s, zero) for s in chosen]
        nodes = NO_NODES.union(*(p._nodes for p in parts))
        sx = ca.horzcat(*(p._sx for p in parts)) if parts else ca.SX(6, 0)
        return make(ca.densify(sx), (6, len(parts)), nodes)

    def speeds_of(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Return the free speeds that move a frame, sorted: the columns of :meth:`jacobian`."""
        with self._lock:
            self._settle()
            base, down = kinematics.branches(frame, relative_to, self._frame)
            found: set[Symbol] = set()
            for name in (*base, *down):
                for factor in self._frame(name).factors:
                    if isinstance(factor, AxisMotion):
                        found.update(factor.amount.gradient(False))
                    elif isinstance(factor, Expression):
                        found.update(factor.gradient(False))
            rates = self.rates
            free: set[Symbol] = set()
            for key in found:
                row = rates.row(key.position) if key.order == 1 else None
                free.update((key,) if row is None else row)
            return tuple(sorted(free, key=lambda s: s.sort_key))

    def _frame(self, name: str) -> Frame:
        try:
            frame: Frame = self._head[FRAMES][name]
        except (KeyError, TypeError):
            raise missing(FRAMES, name, (*self._head[FRAMES], WORLD)) from None
        return frame

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
            return float(bound())
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

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        tolerance: float | None = None,
        leave_out: Iterable[str] = (),
    ) -> Saved:
        """Write the model to a file: a document (.kv.json), URDF (.urdf) or MJCF (.xml).

        A document says all of it. What the others cannot say is refused by name, unless it is to be left out,
        see :func:`kineverse.formats.saving.save`.

        Parameters
        ----------
        path
            Of the file.
        tolerance
            How far frames may be off in URDF and MJCF, in position [m] and angle [rad], with proof; None for
            nowhere.
        leave_out
            Names of constraints and articulations.

        Raises
        ------
        FormatError
            If the name has another ending, the file cannot be written, or naming what the format cannot say.
        """
        from kineverse.formats.saving import save

        return save(self, path, tolerance=tolerance, leave_out=leave_out)

    # -- printing ------------------------------------------------------------------------------------------

    def __str__(self) -> str:
        return (
            f"{len(self.frames)} frames, {len(self.degrees_of_freedom)} DoF, "
            f"{len(self.constraints)} constraints (version {self.version})"
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self}>"


class _Named(Mapping[str, Any]):
    """One kind of a model's data by name, live; a wrong name lists the right ones."""

    def __init__(self, view: ModelView, kind: str, present: Any) -> None:
        self._view = view
        self._kind = kind
        self._present = present

    def _values(self) -> dict[str, Any]:
        self._view._settle()
        return self._view._head[self._kind]

    def __getitem__(self, name: str) -> Any:
        with self._view._lock:
            values = self._values()
            try:
                value = values[name]
            except (KeyError, TypeError):
                raise missing(self._kind, name, values) from None
            return value if self._present is None else self._present(name, value)

    def __iter__(self) -> Iterator[str]:
        with self._view._lock:
            self._view._settle()
            return iter(list(self._view._ordered(self._kind)))

    def items(self) -> ItemsView[str, Any]:
        with self._view._lock:
            return {name: self[name] for name in self}.items()

    def values(self) -> ValuesView[Any]:
        with self._view._lock:
            return {name: self[name] for name in self}.values()

    def __len__(self) -> int:
        with self._view._lock:
            return len(self._values())

    def __contains__(self, name: object) -> bool:
        with self._view._lock:
            return name in self._values()

    def __repr__(self) -> str:
        names = list(self)
        shown = ", ".join(names[:8])
        return f"<{len(names)} {self._kind}: {shown}{', ...' if len(names) > 8 else ''}>"


def _symbols_of(value: Frame | Constraint) -> Iterable[Symbol]:
    if isinstance(value, Constraint):
        return value.symbols
    found: set[Symbol] = set()
    for factor in value.factors:
        if isinstance(factor, Expression):
            found.update(factor.symbols)
    return found
