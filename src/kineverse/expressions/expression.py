"""Arrays of symbolic expressions with augmented gradients.

An :class:`Expression` behaves like a numpy array of fixed shape and holds a CasADi ``SX``. Values that CasADi
cannot represent, such as gradients that differ from the partial derivatives, are opaque nodes
(:mod:`kineverse.expressions.node`): symbols of their own in the ``SX`` graph until the expression is lowered.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, overload
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse._synonyms import EXPRESSION_SYNONYMS
from kineverse.errors import ExpressionError, InvalidValueError, ShapeError, unknown_attribute_error

from . import layout
from .array_methods import ArrayMethods
from .layout import SX, ArrayShape

if TYPE_CHECKING:
    from typing_extensions import deprecated

    from kineverse.symbols import Symbol

    from .gradient import Gradient
    from .node import AccessListener, Node

ExpressionLike: TypeAlias = "Expression | float | int | npt.ArrayLike | Sequence[Any]"
"""Values that become an expression: numbers, arrays, expressions, and nested lists of these."""

NO_NODES: frozenset[Node] = frozenset()

# Symbols by the hash of their SX element. Strong on purpose: CasADi reuses the addresses (and so the hashes)
# of freed elements, and a symbol is a name, of which there are finitely many.
SYMBOLS: dict[int, Symbol] = {}

# Nodes likewise, but weakly: expressions hold the nodes in their graphs.
NODES: WeakValueDictionary[int, Node] = WeakValueDictionary()


class Expression(ArrayMethods):
    """An immutable array of symbolic expressions.

    Arithmetic, slicing and numpy's functions work as on arrays. Three things differ, each on purpose: ``==``
    and ``hash`` compare structure and give a plain ``bool``; ``<``, ``>``, ``&``, ``|`` and ``~`` build
    continuous logic (:mod:`kineverse.logic`); and :meth:`gradient` is a mapping from derivative symbols to
    expressions that may be overridden (:meth:`augment`).

    Examples
    --------
    >>> q = kv.position("door")
    >>> p = kv.array([np.cos(q), np.sin(q)]) * 0.4
    >>> p.shape, p.symbols
    ((2,), (door,))
    >>> p({"door": 0.5}).round(3)
    array([0.351, 0.192])
    >>> p.gradient()
    {door:velocity: Expression(2,)[-0.4*sin(door), 0.4*cos(door)]}
    """

    __slots__ = ("__weakref__", "_gradients", "_key", "_leaves", "_lowered", "_nodes", "_shape", "_sx")
    __array_priority__ = 1000.0

    _sx: SX
    _shape: ArrayShape
    _nodes: frozenset[Node]

    def __new__(cls, value: ExpressionLike) -> Expression:
        """Return numbers, arrays and nested sequences of expressions as an expression."""
        return as_expression(value)

    def _set(self, sx: SX, shape: ArrayShape, nodes: frozenset[Node]) -> None:
        self._sx = sx
        self._describe(shape, nodes)

    def _describe(self, shape: ArrayShape, nodes: frozenset[Node]) -> None:
        """Set all but the graph."""
        self._shape = shape
        self._nodes = nodes
        self._leaves: tuple[tuple[Symbol, ...], tuple[Node, ...]] | None = None
        self._gradients: dict[bool, Any] = {}
        self._key: bytes | None = None
        self._lowered: Any = None

    # -- properties ----------------------------------------------------------------------------------------

    @property
    def shape(self) -> ArrayShape:
        """The shape, as numpy has it; ``()`` for a scalar."""
        return self._shape

    @property
    def ndim(self) -> int:
        """The number of dimensions."""
        return len(self._shape)

    @property
    def size(self) -> int:
        """The number of elements."""
        return math.prod(self._shape)

    @property
    def casadi(self) -> SX:
        """CasADi's ``SX`` of the values, nodes lowered: (n, m) as stored, see :mod:`.layout`."""
        from .graph import expand_nodes

        return expand_nodes(self)

    @property
    def sx(self) -> SX:
        """CasADi's ``SX`` of the values, nodes as symbols: (n, m) as stored, see :mod:`.layout`."""
        return self._sx

    @property
    def nodes(self) -> frozenset[Node]:
        """The opaque nodes of the graph, without those inside of them."""
        return self._nodes

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The free symbols V(e) of the values, sorted by path and order (2022 paper, III-A)."""
        if self._leaves is not None and not self._leaves[1]:
            return self._leaves[0]
        from .graph import free_symbols

        return free_symbols(self)

    @property
    def is_constant(self) -> bool:
        """True if the value depends on no symbol and the gradient is empty."""
        if not self._nodes:
            return bool(self._sx.is_constant())
        from .graph import leaves

        symbols, nodes = leaves(notify_access(self))
        return not symbols and all(node.is_constant for node in nodes)

    @property
    def T(self) -> Expression:
        """The transpose."""
        return self.transpose()

    def __len__(self) -> int:
        if not self._shape:
            raise ExpressionError("len() of a scalar expression.")
        return self._shape[0]

    def __iter__(self) -> Iterator[Expression]:
        if not self._shape:
            raise ExpressionError("A scalar expression cannot be iterated over.")
        return (self[i] for i in range(self._shape[0]))

    def __getitem__(self, key: Any) -> Expression:
        if any(isinstance(k, Expression) for k in (key if isinstance(key, tuple) else (key,))):
            raise ExpressionError("An index is a number or a slice; use where(condition, a, b) to select.")
        if type(key) is tuple and len(key) == 2 and type(key[0]) is int and type(key[1]) is int:
            if len(self._shape) == 2 and 0 <= key[0] < self._shape[0] and 0 <= key[1] < self._shape[1]:
                return from_casadi(self._sx[key[0], key[1]], (), self._nodes)
        try:
            index = layout.indices(self._shape)[key]
        except IndexError as error:
            raise ShapeError(f"{error} (the expression has shape {self._shape}).") from None
        return self._rearranged(np.asarray(index))

    def __setitem__(self, key: Any, value: Any) -> None:
        raise ExpressionError(
            "Expressions are immutable; build a new one, for example with kv.array([[a, b], [c, d]]) "
            "or numpy.concatenate."
        )

    def _rearranged(self, index: layout.IndexArray) -> Expression:
        return from_casadi(layout.gather(self._sx, self._shape, index), index.shape, self._nodes)

    # -- rearranging (the other methods of arrays are in ArrayMethods) ---------------------------------------

    def reshape(self, *shape: Any) -> Expression:
        """Return the same elements, in C order, in another shape; one length may be -1.

        Examples
        --------
        >>> kv.array([1, kv.position("x"), 3, 4]).reshape(2, -1)
        Expression(2, 2)[1, x, 3, 4]
        """
        wanted = shape[0] if len(shape) == 1 and not isinstance(shape[0], (int, np.integer)) else shape
        try:
            return self._rearranged(layout.indices(self._shape).reshape(wanted))
        except ValueError:
            told = f"An expression of shape {self._shape} cannot be reshaped to {wanted}."
            raise ShapeError(told) from None

    def ravel(self) -> Expression:
        """Return the elements in C order, shape (size,)."""
        return self.reshape(-1)

    flatten = ravel

    def transpose(self, *axes: Any) -> Expression:
        """Return the array with its axes permuted; reversed if none are given."""
        if len(self._shape) == 2 and not axes:
            return from_casadi(self._sx.T, self._shape[::-1], self._nodes)
        return self._rearranged(layout.indices(self._shape).transpose(*axes))

    # -- arithmetic ----------------------------------------------------------------------------------------

    def __add__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_ADD, self, other)

    def __radd__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_ADD, other, self)

    def __sub__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_SUB, self, other)

    def __rsub__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_SUB, other, self)

    def __mul__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_MUL, self, other)

    def __rmul__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_MUL, other, self)

    def __truediv__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_DIV, self, other)

    def __rtruediv__(self, other: ExpressionLike) -> Expression:
        return binary(ca.OP_DIV, other, self)

    def __pow__(self, other: ExpressionLike) -> Expression:
        from .nonsmooth import power

        return power(self, other)

    def __rpow__(self, other: ExpressionLike) -> Expression:
        from .nonsmooth import power

        return power(other, self)

    def __mod__(self, other: ExpressionLike) -> Expression:
        from .functions import remainder

        return remainder(self, other)

    def __rmod__(self, other: ExpressionLike) -> Expression:
        from .functions import remainder

        return remainder(other, self)

    def __floordiv__(self, other: ExpressionLike) -> Expression:
        from .functions import floor_divide

        return floor_divide(self, other)

    def __rfloordiv__(self, other: ExpressionLike) -> Expression:
        from .functions import floor_divide

        return floor_divide(other, self)

    def __divmod__(self, other: ExpressionLike) -> tuple[Expression, Expression]:
        return self // other, self % other

    def __rdivmod__(self, other: ExpressionLike) -> tuple[Expression, Expression]:
        return self.__rfloordiv__(other), self.__rmod__(other)

    def __round__(self, decimals: int | None = None) -> Expression:
        from .functions import around

        return around(self, decimals or 0)

    def __neg__(self) -> Expression:
        return unary(ca.OP_NEG, self)

    def __pos__(self) -> Expression:
        return self

    def __abs__(self) -> Expression:
        return unary(ca.OP_FABS, self)

    def __matmul__(self, other: ExpressionLike) -> Expression:
        return matmul(self, other)

    def __rmatmul__(self, other: ExpressionLike) -> Expression:
        return matmul(other, self)

    # -- logic (see kineverse.logic) -----------------------------------------------------------------------

    def __lt__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import less

        return less(self, other)

    def __gt__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import less

        return less(other, self)

    __le__ = __lt__
    __ge__ = __gt__

    def __and__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import logic_and

        return logic_and(self, other)

    def __rand__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import logic_and

        return logic_and(other, self)

    def __or__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import logic_or

        return logic_or(self, other)

    def __ror__(self, other: ExpressionLike) -> Expression:
        from kineverse.logic import logic_or

        return logic_or(other, self)

    def __invert__(self) -> Expression:
        from kineverse.logic import logic_not

        return logic_not(self)

    def __bool__(self) -> bool:
        raise ExpressionError(
            "An expression has no truth value. Write (0.4 < b) & (b < 0.6) for 0.4 < b < 0.6, a & b for "
            "'a and b', ~a for 'not a', and kv.where(condition, a, b) for 'a if condition else b'."
        )

    # -- gradients -----------------------------------------------------------------------------------------

    def gradient(self, heuristic: bool = True) -> Gradient:
        """Return D(e): a mapping from derivative symbols to expressions of this shape.

        The augmented gradient of the papers (2022, Eqs. 5-8): where nothing was augmented, the entry of ``ȧ``
        is ∂e/∂a. Entries that are structurally zero are left out. The numbers of all entries,
        by name, are ``e.gradient()({name: number})``.

        Parameters
        ----------
        heuristic
            True if logic and ``augment(..., heuristic=True)`` contribute their trends. ``False`` takes a
            logic node as locally constant and such an augmentation as absent: only facts remain.

        Examples
        --------
        >>> x, y = kv.position("x"), kv.position("y")
        >>> (x * y).gradient()
        {x:velocity: y, y:velocity: x}
        >>> (x < y).gradient()
        {x:velocity: -1, y:velocity: 1}
        >>> (x < y).gradient(heuristic=False)
        {}
        """
        from .gradient import gradient

        return gradient(self, heuristic)

    def jacobian(self, symbols: Sequence[Symbol], heuristic: bool = True) -> Expression:
        """Return the derivatives by ``symbols``, shape ``e.shape + (n,)``.

        The column of ``x`` is ``D(e)[x.derivative()]``, zero where that has no entry.

        Raises
        ------
        ExpressionError
            For arguments that are not symbols, for a parameter, which has no derivative, and for speeds in
            place of positions: if no column has an entry, but D(e) has the symbols themselves as keys.

        Examples
        --------
        >>> x, y = kv.position("x"), kv.position("y")
        >>> kv.array([x * y, x + y]).jacobian([x, y])
        Expression(2, 2)[y, x, 1, 1]
        """
        from .gradient import jacobian

        return jacobian(self, symbols, heuristic)

    def partial(self, symbols: Sequence[Symbol]) -> Expression:
        """Return the plain partial derivatives of the value, shape ``e.shape + (n,)``.

        Augmentations are ignored and parameters are symbols like any other. A filter's transition matrix is
        one of these.

        Examples
        --------
        >>> q, length = kv.position("q"), kv.parameter("length", 0.4)
        >>> (length * np.cos(q)).partial([length])
        Expression(1,)[cos(q)]
        """
        from .gradient import partial

        return partial(self, symbols)

    def augment(self, gradient: Mapping[Symbol, ExpressionLike], heuristic: bool = False) -> Expression:
        """Return the same value with some entries of the gradient overridden or added, the others kept.

        Parameters
        ----------
        gradient
            From derivative symbols (order at least 1, also of symbols that the expression does not contain,
            such as the speeds of wheels) to expressions that fit this shape.
        heuristic
            Marks the entries as directions to try rather than rates (see :meth:`gradient`).

        Examples
        --------
        >>> x, wheel = kv.position("x"), kv.position("wheel")
        >>> rolled = (2 * x).augment({wheel.derivative(): 0.1})  # a wheel of radius 0.1 m moves it too
        >>> rolled.gradient()
        {wheel:velocity: 0.1, x:velocity: 2}
        """
        from .node import augment

        return augment(self, gradient, replace=False, heuristic=heuristic)

    def with_gradient(self, gradient: Mapping[Symbol, ExpressionLike]) -> Expression:
        """Return the same value with exactly this gradient.

        Examples
        --------
        >>> x, y = kv.position("x"), kv.position("y")
        >>> np.sin(x).with_gradient({y.derivative(): 1}).gradient()
        {y:velocity: 1}
        """
        from .node import augment

        return augment(self, gradient, replace=True, heuristic=False)

    # -- substitution and values ---------------------------------------------------------------------------

    def substitute(self, values: Mapping[Symbol, ExpressionLike]) -> Expression:
        """Return e∘S: symbols replaced by expressions or numbers, gradients by the chain rule.

        ``D(e∘S)[w] = Σ_a (D(e)[ȧ]∘S)·D(S(a))[w]`` plus the entries of D(e) that belong to no replaced symbol.

        Examples
        --------
        >>> x, q = kv.position("x"), kv.position("q")
        >>> e = (x**2).substitute({x: 3 * q})
        >>> e
        (3*q)**2
        >>> e.gradient()
        {q:velocity: 18*q}
        """
        from .substitution import substitute

        return substitute(self, values)

    def __call__(self, values: Mapping[Any, Any] | None = None, /, **by_name: float) -> npt.NDArray[Any]:
        """Return the value at numbers, as a fresh numpy array (a numpy scalar for a scalar).

        Parameters
        ----------
        values
            A mapping from symbols or their names to numbers, or a :class:`~kineverse.State`. A state may have
            values of more symbols than the expression contains, and so may a mapping by symbol, since a
            derivative depends on fewer symbols than its function. Names have to be those of symbols of the
            expression, if it has any. Parameters without a given value have their own.

        Raises
        ------
        UnknownNameError
            For missing values, listed, and for unknown names, with similar ones.
        """
        from .evaluation import evaluate

        return evaluate(self, {} if values is None else values, by_name)

    def __float__(self) -> float:
        if not self._shape and self._sx.is_constant():
            return float(self._sx)
        if self._shape or self.symbols:
            names = ", ".join(map(str, self.symbols[:6])) + (" ..." if len(self.symbols) > 6 else "")
            raise ExpressionError(
                f"float() needs a constant scalar; this has shape {self._shape} and the symbols {names}. "
                "Of expressions write numpy's functions rather than those of math: np.sin(q), not "
                "math.sin(q). For a number call it with values: e({name: number})."
            )
        return float(self())

    def __int__(self) -> int:
        return int(float(self))

    def __format__(self, spec: str) -> str:
        if not spec or not self.is_constant or self._shape:
            try:
                return format(str(self), spec)
            except ValueError:
                raise ExpressionError(
                    f"The format {spec!r} is one of numbers, and this is an expression. "
                    "For a number call it with values: e({name: number})."
                ) from None
        return format(float(self), spec)

    if not TYPE_CHECKING:  # a type checker reports unknown attributes itself

        def __getattr__(self, name):
            if hasattr(type(self), name):  # a slot without a value yet
                raise AttributeError(name)
            raise unknown_attribute_error("An expression", name, dir(type(self)), EXPRESSION_SYNONYMS)

    # -- identity ------------------------------------------------------------------------------------------

    @property
    def key(self) -> bytes:
        """Digest of shape and structure, the same in every process."""
        from .graph import structural_hash

        return structural_hash(notify_access(self))

    if TYPE_CHECKING:
        # For type checkers that report deprecated calls: comparing a symbol with a number is a mistake.
        @overload
        def __eq__(self, other: Expression) -> bool: ...
        @overload
        @deprecated("== compares structure, so an expression equals no number; call it with values first")
        def __eq__(self, other: float) -> bool: ...
        @overload
        def __eq__(self, other: object) -> bool: ...
        def __eq__(self, other: object) -> bool: ...
        @overload
        def __ne__(self, other: Expression) -> bool: ...
        @overload
        @deprecated("!= compares structure, so an expression equals no number; call it with values first")
        def __ne__(self, other: float) -> bool: ...
        @overload
        def __ne__(self, other: object) -> bool: ...
        def __ne__(self, other: object) -> bool: ...
    else:

        def __eq__(self, other: object) -> bool:
            if self is other:
                return True
            if not isinstance(other, Expression):
                try:
                    other = as_expression(other)
                except (ExpressionError, InvalidValueError, ShapeError):
                    return NotImplemented
            return self._shape == other._shape and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __reduce__(self) -> Any:
        from .graph import pack, unpack

        if not self._shape and self._sx.is_constant():
            return as_expression, (float(self._sx),)
        return unpack, pack(self)

    def __copy__(self) -> Expression:
        return self

    def __deepcopy__(self, memo: Any) -> Expression:
        return self

    def __repr__(self) -> str:
        from .printing import text

        return text(notify_access(self))

    def _repr_latex_(self) -> str:
        from .printing import expression_latex

        return f"$\\displaystyle {expression_latex(notify_access(self))}$"

    # -- numpy ---------------------------------------------------------------------------------------------

    def __array__(self, dtype: Any = None, copy: Any = None) -> npt.NDArray[Any]:
        raise ExpressionError(
            "An expression is not an array of numbers. Call it with values, e({name: number}), to get one; "
            "build arrays of expressions with kv.array([...]) or numpy.stack."
        )

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        from .numpy_protocol import apply_ufunc

        return apply_ufunc(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        from .numpy_protocol import apply_function

        return apply_function(function, args, options)


def access_listener(expression: Expression) -> AccessListener | None:
    """Return the listener of an expression that stands for a traced read; None outside of tracing."""
    if not expression._nodes:
        return None
    return next((node.listener for node in expression._nodes if node.listener is not None), None)


def notify_access(expression: Expression) -> Expression:
    """Notify the listener that code inspects an expression, and return the expression with its content."""
    listener = access_listener(expression)
    return expression if listener is None else listener.notify(expression)


def from_casadi(sx: SX, shape: ArrayShape, nodes: frozenset[Node]) -> Expression:
    """Wrap an ``SX`` that only contains known symbols and the symbols of ``nodes``.

    A scalar that consists of one symbol is that :class:`.Symbol`, so ``v[0]`` can be used as a key.
    """
    if not shape and sx.is_symbolic():
        symbol = SYMBOLS.get(sx.element_hash())
        if symbol is not None:
            return symbol
    expression = object.__new__(Expression)
    expression._set(sx, shape, nodes)
    return expression


def as_expression(value: ExpressionLike) -> Expression:
    """Return numbers, arrays and nested sequences of expressions as one expression.

    Raises
    ------
    InvalidValueError
        For NaN.
    ShapeError
        For ragged sequences.
    ExpressionError
        For other values that are not numeric.

    Examples
    --------
    >>> kv.expressions.as_expression([1, kv.position("x")]).shape
    (2,)
    >>> kv.expressions.as_expression([[1, 2], [3]])
    Traceback (most recent call last):
        ...
    kineverse.errors.ShapeError: Ragged array: entries of different shapes side by side.
    """
    if isinstance(value, Expression):
        return value
    if isinstance(value, (float, int)) and not isinstance(value, bool):
        if value != value:
            raise InvalidValueError("NaN is not accepted as a constant.")
        try:
            return _constant(float(value))
        except OverflowError:
            raise InvalidValueError("The number is too large for a 64-bit float.") from None
    if isinstance(value, (list, tuple)):
        return array(value)
    if isinstance(value, np.ndarray) and value.dtype == object and not isinstance(value, np.ma.MaskedArray):
        return array(value)
    # The import of numpy.ma takes 10 ms.
    is_special = isinstance(value, np.ndarray) and type(value) is not np.ndarray
    if is_special and isinstance(value, (np.ma.MaskedArray, np.matrix)):
        _refuse(value)
    if isinstance(value, (str, bytes, Mapping)) or value is None:
        hint = "Symbols are made by kv.position('path')."
        raise ExpressionError(f"{value!r} is not an expression or a number. {hint}")
    given = np.asarray(value)
    try:
        if given.dtype.kind not in "biufO":
            raise TypeError(f"its entries are of type {given.dtype}.")
        numbers = given.astype(float)
    except (TypeError, ValueError, OverflowError) as error:
        kind = type(value).__name__
        raise ExpressionError(f"{kind} is not an expression or an array of numbers: {error}") from None
    if np.isnan(numbers).any():
        raise InvalidValueError(f"NaN is not accepted as a constant (in an array of shape {numbers.shape}).")
    return from_casadi(layout.from_array(numbers), numbers.shape, NO_NODES)


def _refuse(value: object) -> NoReturn:
    """Raise the error for array types with their own semantics: masked arrays and matrices."""
    if isinstance(value, np.ma.MaskedArray):
        raise ExpressionError(
            "A masked array has elements without a value, which an expression cannot have. Write "
            "x.filled(number) to give them one, or x.compressed() to leave them out."
        )
    raise ExpressionError(
        "An np.matrix multiplies by *, where expressions multiply elementwise. Write np.asarray(m), and @ "
        "for the product of matrices."
    )


def _constant(number: float) -> Expression:
    expression = object.__new__(Expression)
    expression._set(ca.SX(number), (), NO_NODES)
    expression._leaves = (), ()
    return expression


def array(values: Any) -> Expression:
    """Return nested sequences of expressions and numbers as one expression, like ``numpy.array``.

    Examples
    --------
    >>> q = kv.position("q")
    >>> kv.array([[np.cos(q), -np.sin(q)], [np.sin(q), np.cos(q)]]) @ np.array([1, 0])
    Expression(2,)[cos(q), sin(q)]
    """
    if isinstance(values, Expression):
        return values
    if isinstance(values, np.ndarray) and values.dtype == object:
        if isinstance(values, np.ma.MaskedArray):
            _refuse(values)
        values = values.tolist()
    if not isinstance(values, (list, tuple)):
        return as_expression(values)
    if not values:
        return as_expression(np.zeros(0))
    if all(isinstance(v, (float, int, np.floating, np.integer)) and not isinstance(v, bool) for v in values):
        return as_expression(np.asarray(values))
    flat: list[Expression] = []
    full = _flatten(values, flat)
    if full is None:
        raise ShapeError("Ragged array: entries of different shapes side by side.")
    if all(not e.shape for e in flat):
        numbers = np.zeros(len(flat))
        symbolic = []
        for i, element in enumerate(flat):
            if element._sx.is_constant():
                numbers[i] = float(element._sx)
            else:
                symbolic.append(i)
        sx = layout.from_array(numbers.reshape(full))
        columns = 1 if len(full) == 1 else full[-1]
        for i in symbolic:
            sx[i // columns, i % columns] = flat[i]._sx
        return from_casadi(sx, full, union_nodes(flat))
    elements = ca.vertcat(*(layout.column(e._sx, e.shape) for e in flat))
    return from_casadi(layout.from_column(elements, full), full, union_nodes(flat))


_MOST_DIMENSIONS = 32  # the limit of the oldest supported version of numpy


def _flatten(values: Any, flat: list[Expression], depth: int = 0) -> ArrayShape | None:
    """Append the entries of nested sequences to ``flat``; return the shape, None if it is ragged."""
    if not isinstance(values, (list, tuple)):
        entry = as_expression(values)
        flat.append(entry)
        return entry.shape
    if depth == _MOST_DIMENSIONS:
        most = f"more than {_MOST_DIMENSIONS} deep"
        raise ShapeError(f"Sequences are nested {most}; no array has so many dimensions.")
    shapes = {_flatten(v, flat, depth + 1) for v in values}
    if not shapes:
        return (0,)
    inner = shapes.pop()
    return None if shapes or inner is None else (len(values), *inner)


def union_nodes(expressions: Sequence[Expression]) -> frozenset[Node]:
    """Return the nodes of several expressions together."""
    # Expressions of one model mostly share the same set.
    sets = {id(e._nodes): e._nodes for e in expressions if e._nodes}
    if len(sets) < 2:
        return next(iter(sets.values()), NO_NODES)
    return NO_NODES.union(*sets.values())


def unary(op: int, operand: Expression) -> Expression:
    """Apply an elementwise CasADi operation."""
    return from_casadi(ca.SX.unary(op, operand._sx), operand._shape, operand._nodes)


def binary(op: int, left: ExpressionLike, right: ExpressionLike) -> Expression:
    """Apply an elementwise CasADi operation of two operands, with numpy's broadcasting."""
    a, b = as_expression(left), as_expression(right)
    if a._nodes and a._nodes is not b._nodes:
        nodes = a._nodes | b._nodes if b._nodes else a._nodes
    else:
        nodes = b._nodes
    if a._shape != b._shape and a._shape and b._shape:
        a, b = broadcast(a, b)
    return from_casadi(ca.SX.binary(op, a._sx, b._sx), a._shape or b._shape, nodes)


def broadcast(*operands: Expression) -> tuple[Expression, ...]:
    """Bring operands to their common shape."""
    try:
        shape = np.broadcast_shapes(*(o.shape for o in operands))
    except ValueError:
        shapes = " and ".join(str(o.shape) for o in operands)
        raise ShapeError(f"Shapes {shapes} cannot be broadcast together.") from None
    return tuple(broadcast_to(o, shape) for o in operands)


def broadcast_to(operand: Expression, shape: ArrayShape) -> Expression:
    """Repeat an operand to fill ``shape``."""
    if operand.shape == shape:
        return operand
    try:
        return operand._rearranged(np.broadcast_to(layout.indices(operand.shape), shape))
    except ValueError:
        raise ShapeError(f"An expression of shape {operand.shape} does not fit shape {shape}.") from None


def matmul(left: ExpressionLike, right: ExpressionLike) -> Expression:
    """Return the matrix product with numpy's rules: vectors, matrices, and stacks of matrices."""
    a, b = as_expression(left), as_expression(right)
    if not a.ndim or not b.ndim or a.shape[-1] != b.shape[-2 if b.ndim > 1 else 0]:
        raise ShapeError(
            f"Shapes {a.shape} and {b.shape} cannot be multiplied as matrices"
            + ("; use * to scale by a number." if not a.ndim or not b.ndim else ".")
        )
    if a.ndim > 2 or b.ndim > 2:
        from .linear_algebra import stacked_product

        return stacked_product(a, b)
    product = ca.mtimes(a._sx.T if a.ndim == 1 else a._sx, b._sx)
    stored = product.T if a.ndim == 1 else product
    return from_casadi(stored, a.shape[:-1] + b.shape[1:], union_nodes((a, b)))
