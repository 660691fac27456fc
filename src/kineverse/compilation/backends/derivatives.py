"""Programs of expressions and of their derivatives by the inputs, order by order.

The derivatives are those of the library, also at kinks and where a gradient is augmented. They are not made
by automatic differentiation of a program. The column of an input is that of :meth:`.Expression.jacobian`, the
column of a parameter that of :meth:`.Expression.partial`.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Sequence

from kineverse.compilation.program import Program
from kineverse.compilation.signature import make_signature, name_list
from kineverse.errors import CompileError, ExpressionError, InvalidValueError, ShapeError, UnknownNameError
from kineverse.expressions import Expression, ExpressionLike, array
from kineverse.expressions.expression import NO_NODES, from_casadi
from kineverse.expressions.gradient import stack_columns
from kineverse.expressions.layout import ArrayShape
from kineverse.symbols import Symbol


class DerivativePrograms:
    """Programs of the outputs and of their derivatives up to any order.

    It keeps a pickle instead of expressions, because JAX and PyTorch look into what a function holds. So a
    further order is built when it is differentiated for the first time.
    """

    single: bool  # True for a single expression, whose value is an array and not a tuple of one
    count: int  # of expressions
    names: tuple[str, ...]  # of the inputs

    def __init__(
        self, expressions: ExpressionLike | Sequence[ExpressionLike], inputs: Iterable[Symbol], caller: str
    ) -> None:
        self.single = not isinstance(expressions, (list, tuple))
        outputs = tuple(array(e) for e in ((expressions,) if self.single else expressions))  # type: ignore[union-attr]
        if not outputs:
            raise CompileError("There is no expression to make a function of.")
        call = f"{caller}(expressions, inputs)"
        if inputs is None:
            raise ExpressionError(f"The inputs are missing: it is {call}, such as {caller}(e, e.symbols).")
        signature = make_signature(outputs, inputs, call)
        if not signature.size:
            raise ExpressionError(
                f"There are no inputs to differentiate by: it is {call}, with at least one symbol."
            )
        self.count, self.names = len(outputs), signature.names
        first = _differentiate(outputs, signature.inputs)
        self._pickled = pickle.dumps(([outputs, first], signature.inputs))
        self._programs: dict[int, tuple[Program, tuple[ArrayShape, ...]]] = {}

    def program(self, order: int) -> tuple[Program, tuple[ArrayShape, ...]]:
        """Return the program of the outputs and all derivatives up to an order, and their shapes.

        All outputs come first, then their first derivatives, and so on. A derivative has a further last axis,
        of the inputs.
        """
        if order not in self._programs:
            orders: list[tuple[Expression, ...]]
            orders, inputs = pickle.loads(self._pickled)
            while len(orders) <= order:
                orders.append(_differentiate(orders[-1], inputs))
            wanted = [e for expressions in orders[: order + 1] for e in expressions]
            # Without nodes the result is NaN, and no error, where a loop does not close.
            lowered = [from_casadi(e.casadi, e.shape, NO_NODES) for e in wanted]
            self._programs[order] = Program(lowered, inputs), tuple(e.shape for e in wanted)
        return self._programs[order]

    def check_shape(self, shape: Sequence[int]) -> None:
        """Raise an error unless the last of some axes has an entry for each input."""
        count = len(self.names)
        if not shape or shape[-1] != count:
            raise ShapeError(
                f"Expected an array of shape (..., {count}), with {name_list(self.names)} along its last "
                f"axis, not one of shape {tuple(shape)}."
            )


def check_tier(tier: str) -> None:
    """Raise an error for an unknown tier."""
    if tier not in ("auto", "c", "operations"):
        raise InvalidValueError(f"Unknown tier {tier!r}; tiers are 'auto', 'c' and 'operations'.")


def array_error(x: object) -> ShapeError:
    """Return the error for what is no array of numbers."""
    of = " of entries that form no array" if isinstance(x, (list, tuple)) else ""
    return ShapeError(
        f"Expected one array of numbers, in the order of the inputs, not a {type(x).__name__}{of}."
    )


def dtype_error(dtype: object) -> InvalidValueError:
    """Return the error for numbers of another type than float and double."""
    return InvalidValueError(
        f"Numbers are float32 or float64, not {dtype}: a pose of fewer digits is off by millimetres. Convert "
        "the argument, and if need be the result."
    )


def _differentiate(expressions: Sequence[Expression], inputs: Sequence[Symbol]) -> tuple[Expression, ...]:
    derivatives = tuple(_derivative(e, inputs) for e in expressions)
    needed = set().union(*(e.symbols for e in derivatives))
    missing = sorted(map(str, needed.difference(inputs)))
    if missing:
        raise UnknownNameError(
            f"The gradients depend on symbols that are not among the inputs: {name_list(missing)}. Add them, "
            "or replace them by numbers (substitute)."
        )
    return derivatives


def _derivative(expression: Expression, inputs: Sequence[Symbol]) -> Expression:
    """Return the derivative by the inputs, along a further last axis."""
    entries = expression.gradient()
    known = set(expression.symbols)
    parameters = [s for s in inputs if not s.has_derivative and s in known]
    columns = {s: entries.get(s.derivative()) for s in inputs if s.has_derivative}
    if parameters:
        partial = expression.partial(parameters)
        columns |= {s: partial[..., i] for i, s in enumerate(parameters)}
    return stack_columns([columns.get(s) for s in inputs], expression.shape)
