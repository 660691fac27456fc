"""Limits of coordinates and of their speeds, as constraints."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from kineverse._checks import real_number
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.expressions.gradient import total_derivative
from kineverse.model.constraint import Constraint


@dataclass(frozen=True)
class Limits:
    """Limits of one coordinate of a joint that has several.

    Attributes
    ----------
    lower, upper
        Limits of the coordinate [m] or [rad], numbers or expressions; None leaves that side open.
    velocity
        Limit of the magnitude of its speed [m/s] or [rad/s]; None for no limit.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.articulations.Cylindrical(
    ...             name="bolt", parent="world", child="bolt", slide=kv.Limits(0, 0.05, velocity=0.1)
    ...         )
    ...     )
    'joint bolt'
    >>> model.limits("bolt/slide"), model.limits("bolt/turn")
    ((0.0, 0.05), (-inf, inf))
    """

    lower: ExpressionLike | None = None
    upper: ExpressionLike | None = None
    velocity: float | None = None

    def constraints(self, name: str, q: Expression) -> Iterator[tuple[str, Constraint]]:
        """Yield the constraints ``name/position`` and ``name/velocity``, if there are such limits."""
        return limit_constraints(name, q, self.lower, self.upper, self.velocity)


FREE = Limits()  # no limits


def check_limits(given: object, what: str) -> None:
    """Check that limits are given as :class:`Limits`."""
    if not isinstance(given, Limits):
        raise InvalidValueError(f"{what} is kv.Limits(lower, upper, velocity), not {given!r}.")


def limit_constraints(
    name: str,
    q: Expression,
    lower: ExpressionLike | None,
    upper: ExpressionLike | None,
    velocity: float | None,
) -> Iterator[tuple[str, Constraint]]:
    """Yield the constraints ``name/position`` and ``name/velocity``, if there are such limits."""
    if (lower is not None or upper is not None) and q.symbols:
        try:
            low, high = -math.inf if lower is None else lower, math.inf if upper is None else upper
            position_range = Constraint.from_expressions(low, q, high)
        except KineverseError as error:
            raise InvalidValueError(f"The limits of '{name}' are no range. {error}") from None
        yield f"{name}/position", position_range
    bound = check_speed_limit(velocity, f"The velocity limit of '{name}'")
    if bound is not None:
        rate = total_derivative(q)
        if rate.symbols:
            yield f"{name}/velocity", Constraint.from_expressions(-bound, rate, bound)


def check_speed_limit(limit: object, what: str) -> float | None:
    """Return the limit of a speed as a number, None if it is absent or infinite."""
    if limit is None:
        return None
    try:
        value = real_number(limit)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"{what} is a number or None, not {limit!r}.") from None
    if not value >= 0:
        raise InvalidValueError(f"{what} is {limit!r}; it cannot be negative.")
    return value if math.isfinite(value) else None
