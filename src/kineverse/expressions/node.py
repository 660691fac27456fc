"""Opaque nodes: values with a gradient of their own.

A node is a symbol of its own in a CasADi graph. It has a value and a D, so CasADi's partial derivatives and
the chain rule give the gradient of expressions that contain it. The override belongs to the node:
``g(augmented) + h(a)`` keeps ``h'``. Nodes with equal content are the same object, so two equal augmentations
cancel.
"""

from __future__ import annotations

import hashlib
import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol
from weakref import WeakValueDictionary

import casadi as ca

from kineverse.errors import ExpressionError, ShapeError

from . import layout
from .expression import NODES, Expression, ExpressionLike, as_expression, broadcast_to, from_casadi
from .graph import gradient_keys, node_symbols, structural_hash

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .substitution import Substitution

_INTERNED: WeakValueDictionary[bytes, Node] = WeakValueDictionary()
_INTERNING = threading.Lock()


class AccessListener(Protocol):
    """Callback invoked when traced code inspects an expression, see :mod:`kineverse.model.traces`."""

    def notify(self, expression: Expression) -> Expression:
        """Record that an expression was inspected, and return it with its actual content."""

    def ask(self, kind: str, *arguments: Any) -> Any:
        """Record a call of a function that depends on its arguments' content, and return its result."""


class Node(ABC):
    """A value with a gradient of its own; immutable, and interned by content.

    Subclasses define their ``kind``, their value (:meth:`_value`) and their gradient (:meth:`_gradient`) in
    terms of their ``arguments``.
    """

    __slots__ = (
        "__weakref__",
        "_gradients",
        "_keys",
        "_symbols",
        "_value_cache",
        "arguments",
        "depth",
        "elements",
        "key",
        "listener",
        "options",
        "shape",
        "sx",
    )

    kind: ClassVar[str]
    own_partials: ClassVar[bool] = False
    """True if partial derivatives are those of :meth:`_gradient`: those of the value are NaN at a kink."""

    arguments: tuple[Expression, ...]
    options: tuple[Any, ...]
    depth: int
    listener: AccessListener | None

    @classmethod
    def from_arguments(
        cls, arguments: tuple[Expression, ...], shape: layout.ArrayShape, options: tuple[Any, ...] = ()
    ) -> Expression:
        """Return the node as an expression; one node for equal arguments and options."""
        key = cls._content_key(arguments, shape, options)
        node = _INTERNED.get(key)
        if node is None:
            node = cls.__new__(cls)
            node._initialise(key, arguments, shape, options)
            with _INTERNING:
                node = _INTERNED.setdefault(key, node)
                NODES.update(dict.fromkeys(node.elements, node))
        return from_casadi(node.sx, node.shape, frozenset((node,)))

    @classmethod
    def _content_key(
        cls, arguments: tuple[Expression, ...], shape: layout.ArrayShape, options: tuple[Any, ...]
    ) -> bytes:
        digest = hashlib.blake2b(f"{cls.kind}{shape}{cls._options_key(options)}".encode(), digest_size=16)
        for argument in arguments:
            digest.update(structural_hash(argument))
        return digest.digest()

    @classmethod
    def _options_key(cls, options: tuple[Any, ...]) -> str:
        return repr(options)

    def _initialise(
        self,
        key: bytes,
        arguments: tuple[Expression, ...],
        shape: layout.ArrayShape,
        options: tuple[Any, ...],
    ) -> None:
        self.key = key
        self.arguments = arguments
        self.options = options
        self.shape = shape
        # CasADi serialises the name, so it must be the same in every process.
        self.sx = ca.SX.sym(key.hex(), *layout.rows_and_columns(shape))
        self.elements = tuple(e.element_hash() for e in ca.symvar(self.sx))
        self._value_cache: Expression | None = None
        self._gradients: dict[bool, Mapping[Symbol, Expression]] = {}
        self._keys: dict[bool, frozenset[Symbol]] = {}
        self._symbols: frozenset[Symbol] | None = None
        self.depth = 1 + max((inner.depth for a in arguments for inner in a._nodes), default=0)
        self.listener = next((w for a in arguments for inner in a._nodes if (w := inner.listener)), None)

    @property
    def symbols(self) -> frozenset[Symbol]:
        """The symbols that the value depends on."""
        if self._symbols is None:
            self._symbols = node_symbols(self)
        return self._symbols

    @property
    def is_constant(self) -> bool:
        """True if the value depends on no symbol and the gradient is empty."""
        return not self.symbols and not self.gradient(True)

    @property
    def parts(self) -> tuple[Expression, ...]:
        """All expressions of the node, those among its options included."""
        return self.arguments

    @property
    def size(self) -> int:
        """The number of elements."""
        return math.prod(self.shape)

    @property
    def label(self) -> str:
        """The name in printed expressions."""
        return self.kind

    @property
    def value(self) -> Expression:
        """The value as an expression of the arguments."""
        if self._value_cache is None:
            self._value_cache = self._value()
        return self._value_cache

    def gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        """Return D of the node, entries of its shape."""
        known = self._gradients.get(heuristic)
        if known is None:
            every = self._gradient(heuristic).items()
            known = self._gradients[heuristic] = {key: e for key, e in every if not e._sx.is_zero()}
        return known

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the keys that :meth:`gradient` can have, without computing entries where possible."""
        return frozenset().union(*(gradient_keys(a, heuristic) for a in self.differentiated(heuristic)))

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the arguments from whose D this node's D is computed."""
        return self.arguments

    def depends_on(self, substitution: Substitution) -> bool:
        """Return True if value or gradient contain one of the replaced symbols."""
        return any(substitution.changes(argument) for argument in self.arguments)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the composition: the same kind of node over the substituted arguments."""
        from .substitution import apply_substitution

        arguments = tuple(apply_substitution(a, substitution) for a in self.arguments)
        return type(self).from_arguments(arguments, self.shape, self.options)

    def __reduce__(self) -> Any:
        return _restore, (type(self), self.arguments, self.shape, self.options)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.shape}>"

    @abstractmethod
    def _value(self) -> Expression:
        """Compute the value from the arguments."""

    @abstractmethod
    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        """Compute D from the arguments."""


def _restore(
    kind: type[Node], arguments: tuple[Expression, ...], shape: layout.ArrayShape, options: tuple[Any, ...]
) -> Node:
    (node,) = kind.from_arguments(arguments, shape, options)._nodes
    return node


class Augment(Node):
    """A value with given entries of its gradient: ``augment`` and ``with_gradient``.

    The arguments are the value and the given entries. The options are ``replace`` (the given entries are the
    whole gradient), ``heuristic`` (the entries are trends) and the keys of the entries.
    """

    __slots__ = ()
    kind = "augment"

    @property
    def replace(self) -> bool:
        """True if the entries are the whole gradient."""
        return bool(self.options[0])

    @property
    def heuristic(self) -> bool:
        """True if the entries are trends rather than facts."""
        return bool(self.options[1])

    @property
    def entries(self) -> dict[Symbol, Expression]:
        """The given entries."""
        return dict(zip(self.options[2:], self.arguments[1:], strict=True))

    @classmethod
    def _options_key(cls, options: tuple[Any, ...]) -> str:
        return repr((options[:2], [k.sort_key for k in options[2:]]))

    def _value(self) -> Expression:
        return self.arguments[0]

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        if self.heuristic and not heuristic:
            return self.arguments[0].gradient(heuristic)
        return self.entries if self.replace else {**self.arguments[0].gradient(heuristic), **self.entries}

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the derivative symbols of the gradient, without building it."""
        if self.heuristic and not heuristic:
            return gradient_keys(self.arguments[0], heuristic)
        return super().gradient_keys(heuristic).union(self.options[2:])

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the value, unless its own gradient is replaced."""
        return () if self.replace and (heuristic or not self.heuristic) else self.arguments[:1]

    def depends_on(self, substitution: Substitution) -> bool:
        """Return True if a substitution changes the node."""
        # An entry for ȧ is mapped along D(S(a)) even if the value does not contain a.
        replaced = (a.derivative() for a in substitution if a.has_derivative)
        return super().depends_on(substitution) or any(speed in self.options[2:] for speed in replaced)

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the composition of the node with a substitution."""
        from .substitution import apply_substitution, compose_gradient

        # After composition an overridden ẇ may also be reached through a replaced symbol. So "override these,
        # keep the others" becomes the complete mapping, for facts and trends separately.
        value = apply_substitution(self.arguments[0], substitution)
        facts = compose_gradient(self.gradient(False), substitution, False)
        trends = compose_gradient(self.gradient(True), substitution, True)
        result = augment(value, facts, replace=True, heuristic=False)
        if facts == trends:
            return result
        return augment(result, trends, replace=True, heuristic=True)


def augment(
    value: Expression, gradient: Mapping[Symbol, ExpressionLike], *, replace: bool, heuristic: bool
) -> Expression:
    """Return ``value`` with a gradient that is overridden or replaced, see :meth:`Expression.augment`."""
    from kineverse.symbols import Symbol

    if not isinstance(gradient, Mapping):
        raise ExpressionError("A gradient is a mapping from derivative symbols to expressions.")
    entries: dict[Symbol, Expression] = {}
    for key, entry in gradient.items():
        if not isinstance(key, Symbol):
            raise ExpressionError(f"{key!r} is not a symbol; write {{kv.velocity('path'): expression}}.")
        if key.order < 1:
            hint = f"'{key.derivative()}'" if key.has_derivative else "a velocity symbol"
            raise ExpressionError(f"A gradient has derivative symbols as keys: {hint}, not '{key}'.")
        try:
            entries[key] = broadcast_to(as_expression(entry), value.shape)
        except ShapeError:
            shapes = f"{as_expression(entry).shape}; the expression has {value.shape}"
            raise ShapeError(f"The entry of '{key}' has shape {shapes}.") from None
    if not replace and not entries:
        return value
    if replace:
        entries = {k: e for k, e in entries.items() if not e._sx.is_zero()}
    keys = tuple(sorted(entries, key=lambda s: s.sort_key))
    arguments = value, *(entries[k] for k in keys)
    return Augment.from_arguments(arguments, value.shape, (replace, heuristic, *keys))
