"""Operations that close a loop: by dependent coordinates or by equality constraints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

from kineverse._checks import real_number
from kineverse.errors import DuplicateNameError, InvalidValueError, ModelError, NoSolutionError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import norm
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD
from kineverse.model.operation import Operation, Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol

from .equations import AXES, as_ends, as_mask, residual_rows, upright_signs
from .loop_records import make_constrained_record, make_loop_record
from .loop_solution import SolvedLoop, solve_loop

__all__ = ["AXES", "CloseLoop"]

_Item = TypeVar("_Item", bound=tuple[Any, ...])


@dataclass(frozen=True, kw_only=True)
class CloseLoop(Operation, document_kind="CloseLoop"):
    """Closure of a loop between two frames: coordinates of the loop become functions of the free ones.

    With ``to_T_frame = (R, p)``, the residual consists of the elements of p [m] and of the axis of R times
    the sine of its angle, ½(R - Rᵀ)^∨ [rad], that ``mask`` names, in axes of ``to``. Where they are zero, the
    dependent coordinates x are a function of the free ones u::

        r(x(u), u) = 0,   ∂x/∂u = -(∂r/∂x)⁻¹ ∂r/∂u,

    and all expressions of the model are functions of u alone. A guess that is fitted to one branch within the
    limits selects the solution. Outside the domain of the branch, evaluation is an error.

    Attributes
    ----------
    frame, to
        Frames to keep together. Other operations must have connected them already.
    more
        Further pairs (frame, to) with the same mask, for loops that determine their coordinates only
        together, such as the three arms of a delta robot.
    mask
        Constrained axes, names out of ``x y z rx ry rz``; the default ``("x", "y", "z")`` is a pin.
    dependent
        Names of the dependent coordinates; by default the last possible ones along both chains.
    home
        Pairs of coordinate and value near a closed configuration; by default the rest position, or the
        nearest limit.
    branch
        Number of the solution at home: 0 for the nearest to ``home``, 1 for the next.
    within
        Triples of free coordinate, lower and upper limit. They limit the use of the loop, and become the
        constraints ``name/coordinate``; by default the position limits of the coordinate. The domain of an
        angle without limits is a full revolution.

    Raises
    ------
    NoSolutionError
        If the loop does not close at home or everywhere within the limits, with the residual or the place; or
        if the branch does not exist.
    InvalidValueError
        If mask, coordinates or limits do not fit.
    ModelError
        If the frames are connected rigidly.

    See Also
    --------
    kineverse.model.Edit.close_loop
    """

    traceable: ClassVar[bool] = False

    name: str
    frame: str
    to: str = WORLD
    mask: tuple[str, ...] = ("x", "y", "z")
    more: tuple[tuple[str, str], ...] = ()
    dependent: tuple[str, ...] | None = None
    home: tuple[tuple[str, float], ...] = ()
    branch: int = 0
    within: tuple[tuple[str, float, float], ...] = ()

    def below(self, prefix: str) -> CloseLoop:
        """Return the same loop with its names below a prefix that ends with a slash; ``world`` stays."""

        def place(name: str) -> str:
            return name if name == WORLD else prefix + name

        return replace(
            self,
            name=place(self.name),
            frame=place(self.frame),
            to=place(self.to),
            more=tuple((place(a), place(b)) for a, b in self.more),
            dependent=None if self.dependent is None else tuple(map(place, self.dependent)),
            home=tuple((place(name), value) for name, value in self.home),
            within=tuple((place(name), lower, upper) for name, lower, upper in self.within),
        )

    def __post_init__(self) -> None:
        object.__setattr__(self, "mask", as_mask(self.mask, self.name))
        object.__setattr__(self, "more", as_ends(self.more, self.name))
        if isinstance(self.dependent, list):
            object.__setattr__(self, "dependent", tuple(self.dependent))
        if isinstance(self.branch, bool) or not isinstance(self.branch, int):
            what = f"The branch of loop '{self.name}'"
            raise InvalidValueError(f"{what} is a number from 0, not {self.branch!r}.")
        if isinstance(self.dependent, str):
            object.__setattr__(self, "dependent", (self.dependent,))
        try:
            home = self.home.items() if isinstance(self.home, Mapping) else self.home
            object.__setattr__(self, "home", tuple((str(k), real_number(v)) for k, v in home))
            within: Iterable[Any] = self.within
            if isinstance(self.within, Mapping):
                within = [(k, a, b) for k, (a, b) in self.within.items()]
            ranges = tuple((str(k), real_number(a), real_number(b)) for k, a, b in within)
            object.__setattr__(self, "within", ranges)
        except (TypeError, ValueError, OverflowError):
            raise InvalidValueError(
                f"Loop '{self.name}' takes home={{name: value}} and within={{name: (lower, upper)}}, "
                f"not home={self.home!r} and within={self.within!r}."
            ) from None
        for k, v in self.home:
            if not math.isfinite(v):
                raise InvalidValueError(f"Loop '{self.name}' cannot begin at {k} = {v}.")
        for k, a, b in self.within:
            if not a <= b:
                where = f"within {a} <= {k} <= {b}: no value lies there"
                raise InvalidValueError(f"Loop '{self.name}' cannot be used {where}.")

    def default_tag(self) -> str:
        """Return ``loop`` and the name."""
        return f"loop {self.name}"

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the expressions of the dependent coordinates."""
        _check_name(model, self.name)
        residual = array([row for frame, to in self._ends for row in self._rows(model, frame, to)])
        poses = [model.resolve(model.fk(frame, to)) for frame, to in self._ends]
        signs = [sign for pose in poses for sign in upright_signs(pose, self.mask)]
        moving = {s for s in residual.symbols if s.has_derivative}
        on_the_way = [s for frame, to in self._ends for s in model.coordinates_between(frame, to)]
        coordinates = list(dict.fromkeys([s for s in on_the_way if s in moving] + sorted(moving, key=str)))
        # Coordinates with free speeds of their own cannot be dependent, so they come first.
        coordinates.sort(key=lambda s: model.carry(s) is s)
        by_name = {str(s): s for s in coordinates}
        limits = {s: result for s in coordinates if (result := self._limits(model, s)) is not None}
        limits.update({by_name[n]: (a, b) for n, a, b in self._known(self.within, by_name)})
        home = {s: s.value or 0.0 for s in residual.symbols}
        for s in coordinates:
            a, b = limits.get(s, (-math.inf, math.inf))
            home[s] = min(max(self._rest(model, s), a), b)
        home.update({by_name[n]: v for n, v in self._known(self.home, by_name)})
        dependent = None
        if self.dependent is not None:
            dependent = [by_name[n] for (n,) in self._known([(n,) for n in self.dependent], by_name)]
        upright, parts = array(signs) if signs else None, (residual, coordinates, home, limits)
        closed = solve_loop(self.name, *parts, dependent=dependent, branch=self.branch, upright=upright)
        self._check(model, closed)
        solution = closed.function.apply(closed.function.inputs)
        return Writes(
            constraints={f"{self.name}/{k}": (a, by_name[k], b) for k, a, b in self.within},
            rates={x: solution[i] for i, x in enumerate(closed.dependent)},
            articulations={self.name: make_loop_record(self._ends, self.mask, closed)},
        )

    def _check(self, model: ReadRecorder, closed: SolvedLoop) -> None:
        """Check that dependent coordinates have no rate yet, and that ``within`` names free ones."""
        for s in closed.dependent:
            if model.carry(s) is not s:
                raise InvalidValueError(
                    f"Loop '{self.name}' cannot make '{s}' follow: it is moved by speeds of its own. "
                    "Say what follows, with dependent=(...)."
                )
        for name, _, _ in self.within:
            if name in map(str, closed.dependent):
                raise InvalidValueError(
                    f"Loop '{self.name}' has within={{...}} for what is free, and '{name}' follows "
                    f"{', '.join(map(str, closed.free)) or 'nothing'}."
                )

    @property
    def _ends(self) -> tuple[tuple[str, str], ...]:
        return ((self.frame, self.to), *self.more)

    def _rows(self, model: ReadRecorder, frame: str, to: str) -> list[Expression]:
        """Return the rows of the mask that are not identically zero."""
        pose = model.resolve(model.fk(frame, to))
        if not any(s.has_derivative for s in pose.symbols):
            raise ModelError(f"Loop '{self.name}' cannot move: '{frame}' and '{to}' are rigidly connected.")
        kept = []
        for axis, row in residual_rows(pose, self.mask).items():
            if row.symbols:
                kept.append(row)
            elif abs(float(row)) > 1e-9:
                raise NoSolutionError(
                    f"Loop '{self.name}' does not close: '{frame}' and '{to}' are {float(row):.6g} apart "
                    f"along '{axis}', whatever moves."
                )
        if not kept:
            reason = f"nothing of '{frame}' that its mask names moves"
            raise ModelError(f"Loop '{self.name}' is closed already: {reason}.")
        return kept

    def _limits(self, model: ReadRecorder, symbol: Symbol) -> tuple[float, float] | None:
        """Return the position limits of the joint of a coordinate, if they are numbers."""
        constraint = model.constraints.get(f"{symbol.path}/position")
        if constraint is None or constraint.expression is not symbol:
            return None
        if constraint.lower.symbols or constraint.upper.symbols:
            return None
        return float(constraint.lower), float(constraint.upper)

    def _rest(self, model: ReadRecorder, symbol: Symbol) -> float:
        """Return the rest position of a coordinate: 1 for the scalar part of a quaternion, else 0."""
        joint = symbol.path.rpartition("/")[0]
        record = model.articulations.get(joint) if joint else None
        if record is None or symbol not in record.coordinates:
            return 0.0
        return float(record.home[record.coordinates.index(symbol)])

    def _known(self, items: Iterable[_Item], by_name: Mapping[str, Symbol]) -> Iterator[_Item]:
        for item in items:
            if item[0] not in by_name:
                known = ", ".join(by_name)
                raise InvalidValueError(f"Loop '{self.name}' is not about '{item[0]}', only about {known}.")
            yield item


def _check_name(model: ReadRecorder, name: str) -> None:
    if name in model.articulations:
        told = f"There is an articulation '{name}' already"
        raise DuplicateNameError(f"{told}; give loop '{name}' another name.")


APART = 1e-9  # largest residual of a satisfied constant row [m], [rad]


@dataclass(frozen=True, kw_only=True)
class LoopConstraint(Operation, document_kind="LoopConstraint"):
    """Closure of a loop between two frames by equality constraints, one for each row of the residual.

    It serves for loops that :class:`~kineverse.CloseLoop` cannot solve for dependent coordinates. All
    coordinates stay free. :meth:`kineverse.Model.violations` and velocity rows include the closure, and
    :meth:`kineverse.Model.project` projects a state onto it.

    The constraints are ``0 <= row <= 0``, with the rows of :class:`~kineverse.CloseLoop`: elements of the
    position p [m] and of ½(R - Rᵀ)^∨ [rad] in axes of ``to``. They are called ``name/x``, ``name/ry`` and so
    on, ``name/1/x`` for the second pair of frames. If the mask has rotations, ``name/upright`` is positive
    unless the frames differ by half a revolution. A constant row has no constraint if it is zero; otherwise
    ``name/apart`` is the distance of all rows from zero, which is then never 0.

    Attributes
    ----------
    frame, to
        Frames to keep together. Other operations must have connected them already.
    mask
        Constrained axes, names out of ``x y z rx ry rz``.
    more
        Further pairs (frame, to) with the same mask.

    Raises
    ------
    ModelError
        If the frames are connected rigidly.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     for name in ("left", "right"):
    ...         edit.apply(kv.Prismatic(name=name, parent="world", child=name))
    ...     edit.apply(kv.loops.LoopConstraint(name="tie", frame="left", to="right", mask=("x",)))
    'joint left'
    'joint right'
    'loop tie'
    >>> model.violations({"left": 0.1, "right": 0.3})
    1 violated
      tie/x: 0 <= -0.2 <= 0 is off by 0.2
    >>> model.project({"left": 0.1, "right": 0.3})
    State({left: 0.2, right: 0.2})
    """

    name: str
    frame: str
    to: str = WORLD
    mask: tuple[str, ...] = ("x", "y", "z")
    more: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "mask", as_mask(self.mask, self.name))
        object.__setattr__(self, "more", as_ends(self.more, self.name))

    def default_tag(self) -> str:
        """Return ``loop`` and the name, as for :class:`CloseLoop`."""
        return f"loop {self.name}"

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the constraints."""
        _check_name(model, self.name)
        constraints: dict[str, Constraint] = {}
        ends = ((self.frame, self.to), *self.more)
        for k, (frame, to) in enumerate(ends):
            constraints |= self._between(model, frame, to, f"{self.name}/{k}" if k else self.name)
        record = make_constrained_record(ends, self.mask, tuple(constraints))
        return Writes(constraints=constraints, articulations={self.name: record})

    def _between(self, model: ReadRecorder, frame: str, to: str, name: str) -> dict[str, Constraint]:
        pose = model.fk(frame, to)
        rows = residual_rows(pose, self.mask)
        # Row by row, so that a trace records the dependence on the symbols of each.
        alone = {axis: model.resolve(row) for axis, row in rows.items()}
        moving = [axis for axis, row in alone.items() if row.symbols] if pose.symbols else []
        if not moving:
            raise ModelError(
                f"Loop '{self.name}' cannot move: nothing changes what its mask names between '{frame}' and "
                f"'{to}'."
            )
        result = {f"{name}/{axis}": Constraint.from_expressions(0.0, rows[axis], 0.0) for axis in moving}
        if any(abs(float(row)) > APART for axis, row in alone.items() if axis not in moving):
            result[f"{name}/apart"] = Constraint.from_expressions(0.0, norm(array(list(rows.values()))), 0.0)
        for k, sign in enumerate(upright_signs(pose, self.mask)):
            if model.resolve(sign).symbols:
                result[f"{name}/upright{k or ''}"] = Constraint.from_expressions(0.0, sign, math.inf)
        return result
