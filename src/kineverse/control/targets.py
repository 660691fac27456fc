"""Targets that change while a controller runs."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, array
from kineverse.symbols import Symbol, parameter

_LAST_ROW = [0.0, 0.0, 0.0, 1.0]
_LENGTH_TOLERANCE, _ANGLE_TOLERANCE = 1.1e-5, 1e-6
"""Tolerances of the squared lengths and of the scalar products of a rotation's rows."""


class Target:
    """Array of parameters: a pose, a point or other numbers that change without another compilation.

    Use :attr:`expression` in tasks, and :meth:`.Controller.set` while the controller runs. Elsewhere
    :meth:`values` gives the entries of a state.

    Parameters
    ----------
    name
        Path of the parameters.
    value
        Initial value: a number, a vector, or a 4×4 transform, whose last row stays (0, 0, 0, 1). Constant
        expressions are values, too.

    Attributes
    ----------
    expression
        The parameters in the shape of the value.
    parameters
        The parameters, row by row.
    """

    expression: Expression
    parameters: tuple[Symbol, ...]

    def __init__(self, name: str, value: npt.ArrayLike | Expression) -> None:
        self.name = name
        initial = self._as_array(value)
        self._shape, self._transform = initial.shape, initial.shape == (4, 4)
        numbers = self._check(initial, initial.shape)
        self.parameters = tuple(parameter(f"{name}/{k}", v) for k, v in enumerate(numbers.tolist()))
        entries: list[Expression | float] = [*self.parameters, *(_LAST_ROW if self._transform else ())]
        self.expression = array(entries).reshape(*initial.shape) if initial.shape else array(entries)[0]

    def values(self, value: npt.ArrayLike | Expression) -> dict[Symbol, float]:
        """Return the values of the parameters for a value of the target.

        Raises
        ------
        ShapeError, InvalidValueError
            For a value of another shape, a NaN, or a 4×4 matrix that is no transform.
        """
        return dict(zip(self.parameters, self.numbers(value).tolist(), strict=True))

    def numbers(self, value: npt.ArrayLike | Expression) -> npt.NDArray[np.float64]:
        """Return the values of the parameters in their order; for errors see :meth:`values`."""
        return self._check(self._as_array(value), self._shape)

    def _as_array(self, value: npt.ArrayLike | Expression) -> npt.NDArray[np.float64]:
        if isinstance(value, Expression) and not value.symbols:
            value = value()
        try:
            return np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(
                f"The target '{self.name}' is a number or an array of numbers, not {value!r}."
            ) from error

    def _check(self, value: npt.NDArray[np.float64], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
        if value.shape != shape:
            raise ShapeError(f"The target '{self.name}' has shape {shape}, not {value.shape}.")
        flat = value.ravel()
        if not math.isfinite(flat.dot(flat)) and not np.isfinite(flat).all():
            raise InvalidValueError(f"The target '{self.name}' has to be finite.")
        if self._transform:
            if not _is_transform(value):
                raise InvalidValueError(f"The target '{self.name}' is a transform, and this matrix is none.")
            return flat[:12]
        return flat

    def __repr__(self) -> str:
        return f"Target({self.name!r}, {self.expression.shape})"


def _is_transform(matrix: npt.NDArray[np.float64]) -> bool:
    """Return whether a finite (4, 4) matrix is a transform, ten times as fast as by numpy's functions."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = matrix.tolist()
    lengths = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
    products = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    return bool(
        last == _LAST_ROW
        and max(abs(length - 1.0) for length in lengths) <= _LENGTH_TOLERANCE
        and max(map(abs, products)) <= _ANGLE_TOLERANCE
        and a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0.0
    )
