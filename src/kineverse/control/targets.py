"""Targets that change while a controller runs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, array
from kineverse.symbols import Symbol, parameter

_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


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
        self._transform = initial.shape == (4, 4)
        numbers = self._numbers(initial, initial.shape)
        self.parameters = tuple(parameter(f"{name}/{k}", v) for k, v in enumerate(numbers))
        entries: list[Expression | float] = [*self.parameters, *(_LAST_ROW if self._transform else ())]
        self.expression = array(entries).reshape(*initial.shape) if initial.shape else array(entries)[0]

    def values(self, value: npt.ArrayLike | Expression) -> dict[Symbol, float]:
        """Return the values of the parameters for a value of the target.

        Raises
        ------
        ShapeError, InvalidValueError
            For a value of another shape, a NaN, or a 4×4 matrix that is no transform.
        """
        numbers = self._numbers(self._as_array(value), self.expression.shape)
        return dict(zip(self.parameters, numbers, strict=True))

    def _as_array(self, value: npt.ArrayLike | Expression) -> npt.NDArray[np.float64]:
        if isinstance(value, Expression) and not value.symbols:
            value = value()
        try:
            return np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(
                f"The target '{self.name}' is a number or an array of numbers, not {value!r}."
            ) from error

    def _numbers(self, value: npt.NDArray[np.float64], shape: tuple[int, ...]) -> list[float]:
        if value.shape != shape:
            raise ShapeError(f"The target '{self.name}' has shape {shape}, not {value.shape}.")
        if not np.isfinite(value).all():
            raise InvalidValueError(f"The target '{self.name}' has to be finite.")
        if self._transform:
            rotation = value[:3, :3]
            if not (
                np.array_equal(value[3], _LAST_ROW)
                and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
                and np.linalg.det(rotation) > 0
            ):
                raise InvalidValueError(f"The target '{self.name}' is a transform, and this matrix is none.")
            value = value[:3]
        return [float(v) for v in value.ravel()]

    def __repr__(self) -> str:
        return f"Target({self.name!r}, {self.expression.shape})"
