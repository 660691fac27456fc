"""Symbols of degrees of freedom and parameters.

A symbol has a path (``kitchen/fridge_door``), an order (0 position, 1 velocity, 2 acceleration ...) and a
role. Symbols are interned, so equal ones are the same object in one process, and they sort by path and order
in every process. Their text name is the path for a position and ``path:velocity`` and so on for the others.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import casadi as ca

from kineverse._checks import as_number
from kineverse.errors import ExpressionError, InvalidValueError
from kineverse.expressions.expression import NO_NODES, SYMBOLS, Expression

__all__ = [
    "ORDER_NAMES",
    "ROLES",
    "Role",
    "Symbol",
    "acceleration",
    "parameter",
    "parse_symbol_name",
    "position",
    "symbol",
    "symbol_name",
    "velocity",
]

Role: TypeAlias = Literal["dof", "parameter", "contact", "location"]
"""Kind of variable that a symbol stands for."""

ROLES: tuple[Role, ...] = get_args(Role)
"""All roles of symbols."""
_UNPRINTABLE = re.compile("[\x00-\x1f\ud800-\udfff]")
_ORDER = re.compile("0|[1-9][0-9]{0,8}")
ORDER_NAMES = ("position", "velocity", "acceleration", "jerk", "snap")
"""Names of the orders of time derivatives, as they stand after the colon of a name."""

_INTERNED: dict[tuple[str, int, str, float | None], Symbol] = {}
_INTERNING = threading.Lock()


class Symbol(Expression):
    """A scalar symbol, see :func:`position`, :func:`velocity`, :func:`acceleration` and :func:`parameter`.

    Attributes
    ----------
    path
        Namespaced name, such as ``kitchen/fridge_door``.
    order
        The number of time derivatives of the position; 0 for parameters.
    role
        The kind of variable: ``dof``, ``parameter``, ``contact``, ``location``.
    value
        The default value of a parameter; None for other roles.

    Examples
    --------
    >>> q = kv.position("kitchen/fridge_door")
    >>> q.path, q.order, q.role
    ('kitchen/fridge_door', 0, 'dof')
    >>> q.derivative()
    kitchen/fridge_door:velocity
    >>> 1 + 2 * q
    1 + 2*kitchen/fridge_door
    """

    __slots__ = ("_text", "order", "path", "role", "sort_key", "value")

    path: str
    order: int
    role: Role
    value: float | None
    _text: str
    sort_key: tuple[str, int, str, float]

    def __new__(cls, path: str, order: int = 0, role: Role = "dof", value: float | None = None) -> Symbol:
        """Return the one symbol of this path, order, role and value."""
        if value is not None and type(value) is not float:
            if isinstance(value, bool) or not isinstance(value, int | float):
                _check(path, order, role, value)
            value = float(value)  # its repr is part of the name below, and that of numpy's numbers differs
        key = (path, order, role, value)
        try:
            if type(path) is str and type(order) is int and key in _INTERNED:
                return _INTERNED[key]
        except TypeError:
            pass  # an invalid path or role may be unhashable; _check raises for it
        _check(path, order, role, value)
        if value is not None:
            value += 0.0  # -0.0 is the same symbol as 0.0, so both have the same name
        self = object.__new__(cls)
        self._text = symbol_name(path, order)
        # CasADi serialises the name, so different symbols have different names.
        kind = "" if role == "dof" else f":{role}" if value is None else f":{role}:{value!r}"
        # CasADi parses a name that begins with a bracket as a list; no other name begins with a colon.
        bracket = ":" if path.startswith("[") else ""
        self._set(ca.SX.sym(f"{bracket}{self._text}{kind}"), (), NO_NODES)
        self._leaves = ((self,), ())
        sort_key = (path, order, role, 0.0 if value is None else value)
        given = {"path": path, "order": order, "role": role, "value": value, "sort_key": sort_key}
        for name, fact in given.items():
            object.__setattr__(self, name, fact)
        with _INTERNING:
            known = _INTERNED.get(key)
            if known is None:
                SYMBOLS[self._sx.element_hash()] = self
                _INTERNED[key] = known = self
        return known

    def __init__(self, *_: Any, **__: Any) -> None:
        # Everything happens once, in __new__.
        pass

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_"):
            raise ExpressionError(f"Symbols are immutable: '{self}' keeps its {name}.")
        object.__setattr__(self, name, value)

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The symbol itself."""
        return (self,)

    @property
    def has_derivative(self) -> bool:
        """True if the symbol varies with time; parameters do not."""
        return self.role != "parameter"

    def derivative(self) -> Symbol:
        """Return the symbol of the time derivative: ȧ for a, ä for ȧ.

        Raises
        ------
        ExpressionError
            For parameters.

        Examples
        --------
        >>> kv.position("door").derivative() == kv.velocity("door")
        True
        >>> kv.parameter("length", 0.4).derivative()
        Traceback (most recent call last):
            ...
        kineverse.errors.ExpressionError: Parameter 'length' has no derivative: it does not change with time.
        """
        if not self.has_derivative:
            raise ExpressionError(f"Parameter '{self}' has no derivative: it does not change with time.")
        return Symbol(self.path, self.order + 1, self.role)

    def integral(self) -> Symbol:
        """Return the symbol this is the time derivative of.

        Raises
        ------
        ExpressionError
            For positions and parameters.

        Examples
        --------
        >>> kv.velocity("door").integral()
        door
        """
        if self.order == 0:
            raise ExpressionError(f"'{self}' is not the derivative of anything.")
        return Symbol(self.path, self.order - 1, self.role)

    @property
    def position(self) -> Symbol:
        """The symbol of order 0 at the same path."""
        return Symbol(self.path, 0, self.role, self.value)

    def __str__(self) -> str:
        return self._text

    def __repr__(self) -> str:
        return self._text

    # There is one symbol of a kind, so identity is enough. A hash without Python code takes a third of the
    # time, and loops look up dozens of values by symbol.
    __hash__ = object.__hash__

    if not TYPE_CHECKING:

        def __eq__(self, other: object) -> bool:
            if self is other:
                return True
            if isinstance(other, Symbol):
                return False
            return Expression.__eq__(self, other)

    def __reduce__(self) -> Any:
        return Symbol, (self.path, self.order, self.role, self.value)


def _check(path: str, order: int, role: str, value: float | None) -> None:
    if not isinstance(path, str) or not path:
        raise ExpressionError(
            f"A symbol needs a path, a non-empty text such as 'kitchen/fridge_door', not {path!r}."
        )
    if "" in path.split("/") or _UNPRINTABLE.search(path):
        raise ExpressionError(
            f"The path {path!r} has an empty part, a control character or half of a surrogate pair."
        )
    if role not in ROLES:
        raise ExpressionError(f"Unknown role {role!r}; roles are {', '.join(ROLES)}.")
    if isinstance(order, bool) or not isinstance(order, int) or order < 0:
        raise ExpressionError(f"The order of a symbol is a whole number from 0 on, not {order!r}.")
    if role == "parameter":
        if order:
            raise ExpressionError("A parameter has no derivatives.")
        if value is None or not isinstance(value, float) or value != value:
            raise InvalidValueError(f"Parameter '{path}' needs a number as its value, not {value!r}.")
    elif value is not None:
        raise ExpressionError("Only parameters have a value of their own.")


def symbol(path: str, order: int = 0, role: Role = "dof") -> Symbol:
    """Return the symbol of any order and role.

    Examples
    --------
    >>> kv.symbols.symbol("door", order=2)
    door:acceleration
    """
    return Symbol(path, order, role)


def position(path: str) -> Symbol:
    """Return the position symbol of a degree of freedom.

    Examples
    --------
    >>> q = kv.position("door")
    >>> (1 - np.cos(q)).gradient()
    {door:velocity: sin(door)}
    """
    return Symbol(path)


def velocity(path: str) -> Symbol:
    """Return the velocity symbol of a degree of freedom.

    Examples
    --------
    >>> kv.velocity("door")
    door:velocity
    >>> kv.velocity("door") == kv.position("door").derivative()
    True
    """
    return Symbol(path, 1)


def acceleration(path: str) -> Symbol:
    """Return the acceleration symbol of a degree of freedom.

    Examples
    --------
    >>> kv.acceleration("door") == kv.velocity("door").derivative()
    True
    """
    return Symbol(path, 2)


def parameter(path: str, value: float) -> Symbol:
    """Return the symbol of a constant parameter with a default value.

    ``D`` of a parameter is empty. Parameters of one path with different values are different symbols.

    Examples
    --------
    >>> length = kv.parameter("arm/length", 0.4)
    >>> x = length * np.cos(kv.position("arm"))
    >>> x({"arm": 0}), x({"arm": 0, "arm/length": 0.5})
    (np.float64(0.4), np.float64(0.5))
    """
    number = None if isinstance(value, bool) else as_number(value)
    if number is None:
        raise InvalidValueError(f"Parameter '{path}' needs a number as its value, not {value!r}.")
    return Symbol(path, 0, "parameter", number)


def symbol_name(path: str, order: int) -> str:
    """Return the text name; ``%`` and ``:`` in the path are percent-escaped, so it can be parsed.

    Examples
    --------
    >>> kv.symbols.symbol_name("kitchen/door", 1)
    'kitchen/door:velocity'
    """
    escaped = path.replace("%", "%25").replace(":", "%3A") if "%" in path or ":" in path else path
    if order == 0:
        return escaped
    return f"{escaped}:{ORDER_NAMES[order] if order < len(ORDER_NAMES) else order}"


def parse_symbol_name(name: str) -> tuple[str, int]:
    """Return path and order of a text name; the inverse of :func:`symbol_name`.

    Raises
    ------
    ExpressionError
        If it is no text, or the part behind the colon is not an order.

    Examples
    --------
    >>> kv.symbols.parse_symbol_name("kitchen/door:velocity")
    ('kitchen/door', 1)
    """
    if not isinstance(name, str):
        raise ExpressionError(f"A symbol is asked for by its name, a text, not by {name!r:.80}.")
    escaped, colon, suffix = name.partition(":")
    path = re.sub("%(25|3A)", lambda m: {"25": "%", "3A": ":"}[m[1]], escaped)
    if not colon:
        return path, 0
    if suffix in ORDER_NAMES[1:]:
        return path, ORDER_NAMES.index(suffix)
    order = int(suffix) if _ORDER.fullmatch(suffix) else -1
    if order >= len(ORDER_NAMES):
        return path, order
    if order >= 0 or suffix == ORDER_NAMES[0]:
        meant = symbol_name(path, max(order, 0))
        raise ExpressionError(f"{name!r}: write {meant!r}; every symbol has one name.")
    raise ExpressionError(
        f"{name[:200]!r}: ':{suffix[:40]}' is not an order; write {', '.join(ORDER_NAMES[1:])} or, from "
        f"{len(ORDER_NAMES)} on, a number."
    )


def sort_symbols(symbols: Iterable[Symbol]) -> tuple[Symbol, ...]:
    """Return symbols sorted by path and order."""
    return tuple(sorted(symbols, key=lambda s: s.sort_key))


def check_symbols(symbols: Iterable[object]) -> Sequence[Symbol]:
    """Return the symbols as a sequence, and raise for other objects."""
    if isinstance(symbols, Symbol):
        raise ExpressionError(f"A sequence of symbols is wanted: [{symbols}].")
    if isinstance(symbols, str):
        raise ExpressionError(
            f"A sequence of symbols is wanted, not the text {symbols!r}: [model.symbol({symbols!r})]."
        )
    if not isinstance(symbols, Iterable):
        raise ExpressionError(f"A sequence of symbols is wanted, not {symbols!r:.80}.")
    checked = []
    for item in symbols:
        if not isinstance(item, Symbol):
            raise ExpressionError(
                f"{item!r} is not a symbol; symbols are made by kv.position('path') and the like."
            )
        checked.append(item)
    return checked
