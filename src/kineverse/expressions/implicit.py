"""Implicit functions: unknowns x(u) that make a residual r(x, u) zero.

The value of an :class:`Implicit` node is computed by a fixed number of Newton steps from a *seed*, which is a
function of the inputs. So the value, and the selected one of several solutions, depends on the inputs alone
and not on earlier calls. Derivatives follow from the implicit function theorem,

    ∂x/∂u = -(∂r/∂x)⁻¹ ∂r/∂u,

and not from the steps, so they are exact to every order. The value is NaN where the steps do not converge,
because there is no solution or it is singular; evaluation then raises the error of
:func:`explain_no_solution`. It is NaN as well outside of the *domain*, the inputs for which the seed is known
to lead to its branch: another solution has a residual of zero too.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, NoSolutionError, ShapeError

from .expression import Expression, from_casadi, union_nodes
from .functions import maximum, minimum
from .graph import expand_nodes, leaves, topological_order
from .layout import SX
from .node import Node
from .substitution import apply_substitution

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

RESIDUAL_TOLERANCE = 1e-10  # the largest norm of a residual at a solution, in its own unit [m] or [rad]

FLOAT_RESIDUAL_TOLERANCE = 1e-4
"""The largest norm of a residual at a solution in float, where rounding leaves 1e-6 in a loop of metres."""


@dataclass(frozen=True, eq=False)
class ImplicitFunction:
    """A definition of unknowns as a function of inputs."""

    name: str  # name in error messages
    unknowns: tuple[Symbol, ...]  # x, shape (n,)
    inputs: tuple[Symbol, ...]
    residual: Expression  # r(x, u), of shape (m,) with m at least n; all of it is zero at a solution
    rows: tuple[int, ...]  # n rows of the residual for Newton's method
    seed: Expression  # first guess of x, of shape (n,), a function of u alone
    steps: int  # number of Newton steps
    domain: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        n = len(self.unknowns)
        if not n or self.seed.shape != (n,) or len(self.rows) != n or self.residual.ndim != 1:
            raise ShapeError(
                f"'{self.name}' has {n} unknowns; seed and rows are as many, and the residual is a vector, "
                f"not {self.seed.shape}, ({len(self.rows)},) and {self.residual.shape}."
            )
        if not all(0 <= row < self.residual.shape[0] for row in self.rows) or len(set(self.rows)) < n:
            raise ShapeError(f"'{self.name}': rows are {n} different ones of {self.residual.shape[0]}.")
        if self.steps < 0:
            raise InvalidValueError(f"'{self.name}' cannot make {self.steps} steps.")
        if self.domain and len(self.domain) != len(self.inputs):
            counts = f"{len(self.inputs)} inputs, and a domain for {len(self.domain)}"
            raise ShapeError(f"'{self.name}' has {counts}.")
        domain = tuple((float(lower), float(upper)) for lower, upper in self.domain)
        for (lower, upper), symbol in zip(domain, self.inputs, strict=False):
            if not lower <= upper:
                what = f"{lower} <= {symbol} <= {upper}"
                raise InvalidValueError(f"'{self.name}': no value lies within {what}.")
        bounded = any(math.isfinite(end) for ends in domain for end in ends)
        object.__setattr__(self, "domain", domain if bounded else ())
        known = {*self.unknowns, *self.inputs}
        if len(known) < n + len(self.inputs):
            raise InvalidValueError(f"'{self.name}': a symbol is given twice.")
        for what, part, allowed in ("residual", self.residual, known), ("seed", self.seed, {*self.inputs}):
            strange = sorted(str(s) for s in part.symbols if s not in allowed)
            if strange:
                raise InvalidValueError(f"'{self.name}': the {what} is about {', '.join(strange)}, too.")

    @cached_property
    def key(self) -> bytes:
        """Digest of the content, the same in every process."""
        digest = hashlib.blake2b(digest_size=16)
        symbols = [[s.sort_key for s in group] for group in (self.unknowns, self.inputs)]
        digest.update(repr((self.name, symbols, self.rows, self.steps)).encode())
        digest.update(self.residual.key + self.seed.key)
        if self.domain:  # functions without a domain keep the digest of versions that had none
            digest.update(repr(self.domain).encode())
        return digest.digest()

    @cached_property
    def equations(self) -> Expression:
        """The rows of the residual for Newton's method, shape (n,)."""
        return self.residual[np.array(self.rows)]

    @cached_property
    def by_unknowns(self) -> Expression:
        """∂r/∂x of the equations, n×n."""
        return self.equations.partial(self.unknowns)

    @cached_property
    def by_inputs(self) -> Expression:
        """∂r/∂u of the equations, n×k."""
        return self.equations.partial(self.inputs)

    def apply(self, arguments: Sequence[Expression]) -> Expression:
        """Return the unknowns, shape (n,), at other inputs than the function's own."""
        if len(arguments) != len(self.inputs):
            counts = f"{len(self.inputs)} inputs, not of {len(arguments)}"
            raise ShapeError(f"'{self.name}' is a function of {counts}.")
        shapes = [a.shape for a in arguments if a.shape]
        if shapes:
            raise ShapeError(f"'{self.name}' is a function of scalars, not of arrays of shape {shapes[0]}.")
        return Implicit.from_arguments(tuple(arguments), (len(self.unknowns),), (self,))

    def substitute(self, part: Expression, x: Sequence[Expression], u: Sequence[Expression]) -> Expression:
        """Return a part of the definition at other unknowns and inputs."""
        return apply_substitution(part, dict(zip((*self.unknowns, *self.inputs), (*x, *u), strict=True)))

    def __reduce__(self) -> Any:
        return ImplicitFunction, (
            self.name, self.unknowns, self.inputs, self.residual, self.rows, self.seed, self.steps,
            self.domain,
        )  # fmt: skip


class Implicit(Node):
    """The unknowns of an :class:`ImplicitFunction` at some inputs, its arguments."""

    __slots__ = ()
    kind = "implicit"
    own_partials = True

    @property
    def function(self) -> ImplicitFunction:
        """The definition of the function."""
        function: ImplicitFunction = self.options[0]
        return function

    @property
    def parts(self) -> tuple[Expression, ...]:
        """The arguments, residual and seed."""
        return (*self.arguments, self.function.residual, self.function.seed)

    @property
    def label(self) -> str:
        """The name of the function."""
        return self.function.name

    @classmethod
    def _options_key(cls, options: tuple[ImplicitFunction, ...]) -> str:
        return options[0].key.hex()

    def _value(self) -> Expression:
        f, u = self.function, self.arguments
        n = len(f.unknowns)
        x = f.substitute(f.seed, f.unknowns, u)
        for _ in range(f.steps):
            point = [x[i] for i in range(n)]
            matrix, residual = f.substitute(f.by_unknowns, point, u), f.substitute(f.equations, point, u)
            x = x - _solve(matrix, residual)
        error = f.substitute(f.residual, [x[i] for i in range(n)], u)
        fits = ca.sumsqr(error._sx) <= RESIDUAL_TOLERANCE**2
        for argument, (lower, upper) in zip(u, f.domain, strict=False):
            if lower > -math.inf:
                fits = ca.logic_and(fits, lower <= argument._sx)
            if upper < math.inf:
                fits = ca.logic_and(fits, argument._sx <= upper)
        return from_casadi(ca.if_else(fits, x._sx, ca.SX.nan(n, 1)), (n,), union_nodes((x, error)))

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        f, u = self.function, self.arguments
        gradients = [a.gradient(heuristic) for a in u]
        keys = sorted(set().union(*gradients), key=lambda s: s.sort_key)
        if not keys:
            return {}
        itself = from_casadi(self.sx, self.shape, frozenset((self,)))
        x = [itself[i] for i in range(len(f.unknowns))]
        matrix, by_inputs = f.substitute(f.by_unknowns, x, u), f.substitute(f.by_inputs, x, u)
        columns = []
        for key in keys:
            entries = [g.get(key) for g in gradients]
            parts = [by_inputs[:, j] * e for j, e in enumerate(entries) if e is not None]
            columns.append(sum(parts[1:], parts[0]))
        stacked = ca.horzcat(*(ca.densify(c._sx) for c in columns))
        solved = _solve(matrix, from_casadi(stacked, (len(x), len(keys)), union_nodes(tuple(columns))))
        return {key: -solved[:, i] for i, key in enumerate(keys)}


def _solve(matrix: Expression, right: Expression) -> Expression:
    """Return matrix⁻¹ right, which has one or two dimensions."""
    a, b = matrix._sx, right._sx
    sx: SX = b / a if a.numel() == 1 else ca.solve(ca.densify(a), ca.densify(b))
    return from_casadi(sx, right.shape, union_nodes((matrix, right)))


def clamp_to_domains(expression: Expression) -> Expression:
    """Replace the inputs of all implicit functions in an expression by their values clamped to the domains.

    Outside of a domain the expression then has the value at its boundary, so that a controller can evaluate
    it there and lead back.
    """
    bounded = [n for n in implicit_nodes([expression]) if n.function.domain] if expression._nodes else []
    if not bounded:
        return expression
    ends: dict[Symbol, tuple[float, float]] = {}
    for node in bounded:
        for argument, (lower, upper) in zip(node.arguments, node.function.domain, strict=True):
            symbol = _symbol_of(argument)
            if symbol is not None:
                low, high = ends.get(symbol, (-math.inf, math.inf))
                ends[symbol] = max(low, lower), min(high, upper)
    clamped = {s: maximum(low, minimum(high, s)) for s, (low, high) in ends.items()}
    return apply_substitution(expression, clamped)


def _symbol_of(argument: Expression) -> Symbol | None:
    """Return the symbol that an argument is equal to; None if there is none."""
    symbols = argument.symbols
    if len(symbols) == 1 and ca.is_equal(expand_nodes(argument), symbols[0]._sx):
        return symbols[0]
    return None


def implicit_nodes(expressions: Sequence[Expression]) -> tuple[Implicit, ...]:
    """Return the implicit functions in the values of expressions, inner ones first."""
    nodes = (n for e in expressions for n in leaves(e)[1])
    every = topological_order(nodes, lambda n: (n.value, *n.arguments), lambda _: False)
    return tuple(dict.fromkeys(node for node in every if isinstance(node, Implicit)))


def explain_no_solution(
    nodes: Sequence[Implicit], symbols: Sequence[Symbol], numbers: npt.NDArray[np.float64]
) -> NoSolutionError | None:
    """Return the error of the first implicit function without a solution at given numbers, if any."""
    if not nodes:
        return None
    vector = ca.vertcat(*(s._sx for s in symbols)) if symbols else ca.SX(0, 1)
    for node in nodes:
        arguments = [ca.densify(expand_nodes(a)) for a in node.arguments]
        outputs = [ca.densify(expand_nodes(node.value)), ca.vertcat(*arguments)]
        # Symbols that cancel in the expression have no given value; any value will do.
        given = {s.element_hash() for s in ca.symvar(vector)}
        others = [s for s in ca.symvar(ca.vertcat(*outputs)) if s.element_hash() not in given]
        found = ca.Function("at", [vector, ca.vertcat(*others)], outputs)
        value, inputs = (np.array(part).ravel() for part in found(numbers, 0))
        # At NaN inputs the cause is another function, which is earlier in the order.
        if np.isnan(value).any() and not np.isnan(inputs).any():
            names = node.function.inputs
            for symbol, x, (lower, upper) in zip(names, inputs, node.function.domain, strict=False):
                if not lower <= x <= upper:
                    return NoSolutionError(
                        f"'{node.label}' has no solution at {symbol} = {x:.6g} that is known to be on its "
                        f"branch: it holds for {lower:.6g} <= {symbol} <= {upper:.6g}, the limits it was "
                        "made for and a margin around them. Stay within, or make it for wider limits."
                    )
            where = ", ".join(f"{s} = {x:.6g}" for s, x in zip(names, inputs, strict=True))
            return NoSolutionError(
                f"'{node.label}' has no solution at {where}. Stay within the limits it was made for, "
                "or away from configurations in which it is singular."
            )
    return None
