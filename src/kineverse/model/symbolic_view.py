"""Read-only data and symbolic kinematics of a model.

Numeric queries are in :mod:`kineverse.model.model_view`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, ItemsView, Iterator, Mapping, Sequence, ValuesView
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import casadi as ca
import numpy as np

from kineverse._synonyms import EDIT_METHODS, MODEL_SYNONYMS
from kineverse.errors import UnknownAttributeError, UnknownNameError, unknown_attribute_error
from kineverse.expressions.expression import NO_NODES, Expression, as_expression, from_casadi
from kineverse.spatial import OneAxisTransform
from kineverse.symbols import Symbol, check_symbols

from . import kinematics, mass_properties
from .articulation import Articulation
from .body import Body
from .constraint import Constraint
from .display import as_html, as_lines, count_values
from .frame import WORLD, Frame
from .operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES, Cell, map_expressions
from .rates import RateEntry, Rates
from .read_recorder import ABSENT, unknown_name_error
from .relevance import Relevance, SymbolIndex

if TYPE_CHECKING:
    from .integration import StateIntegrator
    from .projection import EqualityConstraints
    from .violations import ConstraintChecker


class NamedMapping(Mapping[str, Any]):
    """Live mapping of one kind of data by name; errors for unknown names list similar ones."""

    def __init__(self, view: SymbolicView, kind: str, present: Any) -> None:
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
                raise unknown_name_error(self._kind, name, values) from None
            return value if self._present is None else self._present(name, value)

    def __iter__(self) -> Iterator[str]:
        with self._view._lock:
            self._view._settle()
            return iter(list(self._view._ordered(self._kind)))

    def items(self) -> ItemsView[str, Any]:
        """Return the present names and values."""
        with self._view._lock:
            return {name: self[name] for name in self}.items()

    def values(self) -> ValuesView[Any]:
        """Return the present values."""
        with self._view._lock:
            return {name: self[name] for name in self}.values()

    def __len__(self) -> int:
        with self._view._lock:
            return len(self._values())

    def __contains__(self, name: object) -> bool:
        with self._view._lock:
            return name in self._values()

    def __str__(self) -> str:
        with self._view._lock:
            return as_lines(self._title, self.items(), len(self))

    def _repr_html_(self) -> str:
        with self._view._lock:
            return as_html(self._title, self.items(), len(self))

    @property
    def _title(self) -> str:
        return count_values(len(self), self._kind)

    def __repr__(self) -> str:
        names = list(self)
        shown = ", ".join(names[:8])
        return f"<{count_values(len(names), self._kind)}: {shown}{', ...' if len(names) > 8 else ''}>"


JacobianForm = Literal["world_aligned", "world", "body"]


class SymbolicView:
    """Read-only data and symbolic kinematics of a model. Base of :class:`.ModelView`."""

    def __init__(self, head: dict[str, dict[str, Any]], version: int) -> None:
        self._head = head
        self._version = version
        self._lock = threading.RLock()
        self._forget_index({})
        self._forget_all()

    if not TYPE_CHECKING:  # type checkers report unknown names themselves

        def __getattr__(self, name):
            if name in EDIT_METHODS:
                raise UnknownAttributeError(
                    f"A model is changed in an edit: write `with model.edit() as edit:`, and in the block "
                    f"edit.{name}(...)."
                )
            raise unknown_attribute_error("A model", name, dir(self), MODEL_SYNONYMS)

    def _forget_index(self, dependent: Mapping[Symbol, Expression]) -> None:
        self._dependent = dependent
        self._relevance = Relevance(dependent)
        self._index = SymbolIndex()
        self._pending: list[tuple[Cell, Any, Any]] = []
        self._is_indexed = False

    def _forget_all(self) -> None:
        self._rates: Rates | None = None
        self._poses: dict[tuple[str, str], Expression] = {}
        self._jacobians: dict[Any, Expression] = {}
        self._carried_constraints: dict[str, Constraint] = {}
        self._all_symbols: tuple[Symbol, ...] | None = None
        self._checker: ConstraintChecker | None = None
        self._integrator: StateIntegrator | None = None
        self._equalities: EqualityConstraints | None = None
        self._derived: dict[Hashable, Any] = {}

    def _invalidate(self, changes: Sequence[tuple[Cell, Any, Any]]) -> None:
        kinds = {cell[0] for cell, _, _ in changes}
        if self._is_indexed:
            self._pending += changes
        self._all_symbols = None
        self._integrator = None
        self._derived = {}
        if RATES in kinds:
            self._rates = None
            self._carried_constraints.clear()
            self._poses.clear()
            self._jacobians.clear()
        if FRAMES in kinds:
            self._poses.clear()
            self._jacobians.clear()
        if kinds & {CONSTRAINTS, RATES, ARTICULATIONS}:
            self._equalities = None
        if CONSTRAINTS in kinds or RATES in kinds:
            self._checker = None
            for (kind, name), _, _ in changes:
                if kind == CONSTRAINTS:
                    self._carried_constraints.pop(name, None)

    def _settle(self) -> None:
        """Apply the pending operations of an open edit; a snapshot has none."""

    def _ordered(self, kind: str) -> dict[str, Any]:
        """Return the values of a kind in the order in which operations write them."""
        return self._head[kind]

    def _catch_up(self) -> None:
        self._settle()
        if self.rates.dependent != self._dependent:
            self._forget_index(self.rates.dependent)
        pending, self._pending = self._pending, []
        if not self._is_indexed:
            pending = [
                ((kind, name), ABSENT, value)
                for kind in (FRAMES, CONSTRAINTS)
                for name, value in self._head[kind].items()
            ]
            self._is_indexed = True
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
        """Number of committed edits."""
        return self._version

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Frames by name, without the world. Transforms are in plain coordinates."""
        return self._mapping(FRAMES)

    @property
    def bodies(self) -> Mapping[str, Body]:
        """Bodies by the name of their frame."""
        return self._mapping(BODIES)

    @property
    def articulations(self) -> Mapping[str, Articulation]:
        """Records of articulations by name.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> door = model.articulations["kitchen/fridge_door"]
        >>> door.kind, door.parent, door.coordinates
        ('revolute', 'kitchen/fridge', (kitchen/fridge_door,))
        """
        return self._mapping(ARTICULATIONS)

    @property
    def data(self) -> Mapping[str, Any]:
        """Other data by name."""
        return self._mapping(DATA)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Constraints by name, coordinates carried by their rates."""
        return NamedMapping(self, CONSTRAINTS, self._carry_constraint)

    def plain_constraints(self) -> dict[str, Constraint]:
        """Return the constraints by name, as operations wrote them: coordinates are plain symbols.

        Examples
        --------
        >>> kv.load("kitchen").plain_constraints()["kitchen/fridge_door/position"]
        Constraint(lower=0, expression=kitchen/fridge_door, upper=1.5708)
        """
        with self._lock:
            self._settle()
            return dict(self._head[CONSTRAINTS])

    def plain_rates(self) -> dict[Symbol, RateEntry]:
        """Return the entries of the rate table by coordinate, as operations wrote them.

        Examples
        --------
        >>> model = kv.load("articulations/differential_drive")
        >>> list(model.plain_rates())
        [differential_drive/base/x, differential_drive/base/y, differential_drive/base/angle]
        """
        with self._lock:
            self._settle()
            return dict(self._head[RATES].values())

    def _mapping(self, kind: str) -> Mapping[str, Any]:
        return NamedMapping(self, kind, None)

    def _carry_constraint(self, name: str, constraint: Constraint) -> Constraint:
        rates = self.rates
        if rates.is_empty:
            return constraint
        known = self._carried_constraints.get(name)
        if known is None:
            known = self._carried_constraints[name] = map_expressions(CONSTRAINTS, constraint, rates.carry)
        return known

    def _eliminate_dependent(self, constraint: Constraint) -> Constraint:
        rates = self.rates
        if not any(s.position in rates.dependent for s in constraint.symbols):
            return constraint
        result: Constraint = map_expressions(
            CONSTRAINTS, constraint, lambda e: rates.eliminate(rates.carry(e))
        )
        return result

    @property
    def rates(self) -> Rates:
        """Rate table, see :mod:`kineverse.model.rates`."""
        with self._lock:
            self._settle()
            if self._rates is None:
                self._rates = Rates(self.plain_rates())
            return self._rates

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """Coordinates and parameters of all frames and constraints, sorted: the symbols of a configuration.

        A coordinate is included if only its speed occurs, unless that speed moves other coordinates, as the
        wheels of a base or the angular velocity of a ball joint do.
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
                # A coordinate with a speed limit has a position; the speed of a wheel needs none.
                found.update({s.position for s in mentioned if s.order} - wheels)
                for itself in self.rates.dependent.values():
                    found.update(itself.symbols)
                found -= self.rates.dependent.keys()
                self._all_symbols = tuple(sorted(found, key=lambda s: s.sort_key))
            return self._all_symbols

    @property
    def degrees_of_freedom(self) -> tuple[Symbol, ...]:
        """Coordinates among :attr:`symbols`, without parameters."""
        return tuple(s for s in self.symbols if s.has_derivative)

    @property
    def speeds(self) -> tuple[Symbol, ...]:
        """Free speeds that move the coordinates, sorted."""
        with self._lock:
            rates = self.rates
            found: set[Symbol] = set()
            for coordinate in self.degrees_of_freedom:
                found.update(rates[coordinate] if coordinate in rates else (coordinate.derivative(),))
            return tuple(sorted(found, key=lambda s: s.sort_key))

    # -- kinematics ----------------------------------------------------------------------------------------

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        """Return relative_to_T_frame, a 4×4 expression [m], [rad]; coordinates are carried by their rates.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> handle = model.fk("kitchen/fridge_door_handle", relative_to="kitchen/fridge")
        >>> handle.symbols
        (kitchen/fridge_door,)
        >>> handle({"kitchen/fridge_door": 0.5})[:3, 3].round(3)
        array([ 0.358, -0.197,  1.184])
        """
        for name in (frame, relative_to):
            if not isinstance(name, str):
                raise unknown_name_error(FRAMES, name, ())
        with self._lock:
            self._settle()
            known = self._poses.get((frame, relative_to))
            if known is None:
                if relative_to == WORLD:
                    known = kinematics.place_in_world(frame, self._frame).matrix()
                else:
                    known = kinematics.relative_pose(frame, relative_to, self._frame)
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
        r"""Return the geometric Jacobian a_J_b of a frame, 6×n: linear rows [m], then angular rows [rad].

        It maps the speeds to the twist of the frame b in the frame a, where a_p_b and a_R_b are its position
        and its rotation in :meth:`fk`:

        .. math::

            \begin{pmatrix} v \\ \omega \end{pmatrix} = {}_aJ_b(q)\, \dot q, \qquad
            v = \frac{d}{dt}\, {}_ap_b, \qquad
            [\omega]_\times = \frac{d}{dt} \left( {}_aR_b \right) {}_aR_b^\top

        Parameters
        ----------
        frame, relative_to
            Moving frame b and reference frame a.
        form
            ``world_aligned``: v and ω as above, at the origin of b in axes of a; ``world``: the spatial twist
            v + p × ω and ω; ``body``: Rᵀv and Rᵀω, in axes of b.
        symbols
            Positions or velocities, one for each column. By default the speeds that move the frame, sorted
            (:meth:`speeds_of`).
        heuristic
            True to include heuristic gradient entries. The default is the exact Jacobian.

        Raises
        ------
        UnknownNameError
            If there is no such frame or form, with similar names.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> model.jacobian("kitchen/fridge_door_handle")({"kitchen/fridge_door": 0.5}).ravel().round(3)
        array([-0.533, -0.327,  0.   ,  0.   ,  0.   ,  1.   ])
        """
        if form not in ("world_aligned", "world", "body"):
            raise UnknownNameError(
                f"There is no form {form!r}; forms are 'world_aligned', 'world' and 'body'."
            )
        columns = None if symbols is None else tuple(check_symbols(symbols))
        key = frame, relative_to, form, columns, heuristic
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
            base, tip = (kinematics.compose_chain(chain, self._frame) for chain in (to_base, to_tip))
        rotation, position, columns = kinematics.compute_twists(base, tip, heuristic)
        tip_nodes = tip.nodes | base.nodes
        by_speed: dict[Symbol, Expression] = {}
        for key, twist in columns.items():
            v, w = twist.linear, twist.angular
            if form == "world":
                v = v + ca.cross(position, w)
            elif form == "body":
                v, w = ca.mtimes(rotation.T, v), ca.mtimes(rotation.T, w)
            column = rates.carry(from_casadi(ca.densify(ca.vertcat(v, w)), (6,), twist.nodes | tip_nodes))
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
        nodes = NO_NODES.union(*(p.nodes for p in parts))
        sx = ca.horzcat(*(p.sx for p in parts)) if parts else ca.SX(6, 0)
        return from_casadi(ca.densify(sx), (6, len(parts)), nodes)

    def mass(self, frame: str = WORLD) -> float:
        """Return the mass [kg] of the bodies at or below a frame, by default of all; 0 without any.

        Examples
        --------
        >>> kv.load("pr2").mass("pr2/l_gripper_palm_link")
        0.44002914
        """
        with self._lock:
            self._settle()
            bodies = self._head[BODIES]
            found = mass_properties.find_masses(self._existing(frame), bodies, self._frame)
            return float(sum(bodies[name].inertia.mass for name in found))

    def center_of_mass(self, frame: str = WORLD) -> Expression:
        """Return the centre of mass, (3,) [m] in the world; coordinates are carried by their rates.

        Bodies without mass do not count.

        Parameters
        ----------
        frame
            Frame whose bodies count, with those of all frames below it; by default all bodies.

        Raises
        ------
        ModelError
            If none of the bodies has a mass, with their names.
        """
        with self._lock:
            self._settle()
            return self.rates.carry(
                mass_properties.center_of_mass(self._existing(frame), self._head[BODIES], self._frame)
            )

    def _existing(self, frame: str) -> str:
        if frame != WORLD:
            self._frame(frame)
        return frame

    def speeds_of(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Return the free speeds that move a frame, sorted: the columns of :meth:`jacobian`.

        Examples
        --------
        >>> model = kv.load("pr2")
        >>> model.speeds_of("pr2/l_gripper_tool_frame")[:2]
        (pr2/base/angle:velocity, pr2/base/x:velocity)
        """
        with self._lock:
            self._settle()
            base, down = kinematics.branches(frame, relative_to, self._frame)
            found: set[Symbol] = set()
            for name in (*base, *down):
                for factor in self._frame(name).factors:
                    if isinstance(factor, OneAxisTransform):
                        found.update(factor.amount.gradient(False))
                    elif isinstance(factor, Expression):
                        found.update(factor.gradient(False))
            rates = self.rates
            free: set[Symbol] = set()
            for key in found:
                row = rates.row(key.position) if key.order == 1 else None
                free.update((key,) if row is None else row)
            return tuple(sorted(free, key=lambda s: s.sort_key))

    def symbols_of(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Return the symbols of a pose in the order of the chain, from ``relative_to`` to ``frame``.

        They are the symbols of :meth:`fk`, parameters included. Joints are in the order of the chain, the
        coordinates of a joint in its own order. A dependent coordinate, as of a mimic joint or a closed loop,
        is replaced by those that determine it. Pass them to :func:`kineverse.compile` for input vectors in
        this order instead of sorted by name.

        Examples
        --------
        >>> model = kv.load("pr2")
        >>> model.symbols_of("pr2/l_gripper_tool_frame")[:2]
        (pr2/base/x, pr2/base/y)
        """
        with self._lock:
            self._settle()
            base, down = kinematics.branches(frame, relative_to, self._frame)
            dependent = self.rates.dependent
            records = self._head[ARTICULATIONS].values()
            own = {s: place for record in records for place, s in enumerate(record.coordinates)}
            found: dict[Symbol, None] = {}
            for name in (*base[::-1], *down):
                for factor in self._frame(name).factors:
                    if isinstance(factor, Expression):
                        for s in sorted(factor.symbols, key=lambda s: (own.get(s, len(own)), s.sort_key)):
                            found |= dict.fromkeys(dependent[s].symbols if s in dependent else (s,))
            return tuple(found)

    def _frame(self, name: str) -> Frame:
        try:
            frame: Frame = self._head[FRAMES][name]
        except (KeyError, TypeError):
            raise unknown_name_error(FRAMES, name, self._head[FRAMES]) from None
        return frame


Result = TypeVar("Result")


def cached_for_version(model: SymbolicView, key: Hashable, compute: Callable[[], Result]) -> Result:
    """Return a result about the present version of a model; it is computed for the first call with a key.

    The result lives no longer than the model, and may refer to it.
    """
    model._settle()
    kept = model._derived  # an edit replaces it, so that no result of an old version is entered later
    if key not in kept:
        kept[key] = compute()
    result: Result = kept[key]
    return result
