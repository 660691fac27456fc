"""State-dependent limits: speed locks, position locks and tabulated limits.

Bounds of constraints may be expressions anyway. :func:`speed_lock` and :func:`position_lock` return the
triple (lower, expression, upper), for ``edit.constrain(name, *triple)`` and for the constraints of an
operation's :class:`Writes`; :func:`tabulated_limit` returns a bound. Conditions are expressions of logic, such
as ``bolt > 0.3``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Literal, TypeAlias

from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.expressions.functions import where
from kineverse.expressions.gradient import total_derivative
from kineverse.expressions.piecewise import piecewise, spline
from kineverse.logic import logic_and

BoundedExpression: TypeAlias = tuple[Expression, Expression, Expression]


def speed_lock(
    moving: Expression,
    condition: Expression,
    *,
    at: Expression | None = None,
    speed: float = 1.0,
    blocks: Literal["both", "forward", "backward"] = "both",
) -> BoundedExpression:
    """Return the lock of a speed: -c·speed <= q̇ <= c·speed with c the condition (2022 paper, Eq. 13).

    The speed is 0 while the condition does not hold, and the gradients of the bounds tell what would unlock
    it: they are those of c.

    Parameters
    ----------
    moving
        What is locked: a speed, or a position q, whose speed is meant.
    condition
        The truth of its being unlocked.
    at
        The truth of being where the lock catches, usually something about q; elsewhere it moves freely, which
        makes c = condition | ~at.
    speed
        How fast it may move [m/s] or [rad/s].
    blocks
        The directions that are locked. With ``"forward"``, going back is free: -speed <= q̇ <= c·speed.

    Raises
    ------
    InvalidValueError
        For something that is not one number, a speed that is not positive, or another direction.
    """
    rate = _scalar(moving, "What is unlocked")
    if not any(s.order for s in rate.symbols):
        rate = total_derivative(rate)
    if not rate.symbols:
        raise InvalidValueError(f"What is unlocked moves, and {moving!r} does not.")
    if not _number(speed, "The speed of what is unlocked") > 0 or math.isinf(speed):
        raise InvalidValueError(f"The speed of what is unlocked is positive and finite, not {speed!r}.")
    free = _open_condition(condition, at)
    if blocks not in ("both", "forward", "backward"):
        raise InvalidValueError(f"A lock blocks 'both', 'forward' or 'backward', not {blocks!r}.")
    most, open_ = as_expression(float(speed)), free * speed
    return -(most if blocks == "forward" else open_), rate, (most if blocks == "backward" else open_)


def position_lock(
    coordinate: Expression,
    condition: Expression,
    *,
    lower: ExpressionLike | None = None,
    upper: ExpressionLike | None = None,
    margin: float = 1e-3,
) -> BoundedExpression:
    """Return the block of a position: it stays within [lower, upper] unless the condition holds.

    Surprise first: who is *outside* already is free, and free to come back. A bolt that springs out while the
    door stands open holds nothing; it holds the door once that is shut. With c the condition, the bounds are

        held  = ~c & (lower - margin < q) & (q < upper + margin)
        lower = where(held, lower, -∞),     upper = where(held, upper, ∞)

    so the constraint can be satisfied wherever the part is, and its velocity row asks for no jump. What has
    got into the margin, by rounding or play, still counts as held and is led back. The gradients of the
    bounds, as advice, are those of "not held": what would free it.

    Parameters
    ----------
    coordinate
        q, an expression of positions.
    condition
        The truth of its being free.
    lower, upper
        Where it is held [m] or [rad], numbers or expressions; None leaves that side open. The same twice
        holds it at a place.
    margin
        How far outside it is still held [m] or [rad].

    Raises
    ------
    InvalidValueError
        For something that is not one number, bounds that leave nothing between them, NaN, or a margin that is
        not positive.
    """
    q = _scalar(coordinate, "What is blocked")
    if not q.symbols or any(s.order for s in q.symbols):
        raise InvalidValueError(f"What is blocked is an expression of positions, not {coordinate!r}.")
    if not _number(margin, "The margin of what is blocked") > 0 or math.isinf(margin):
        raise InvalidValueError(f"The margin of what is blocked is positive and finite, not {margin!r}.")
    low, high = (
        None if bound is None else _bound(bound, name) for name, bound in (("lower", lower), ("upper", upper))
    )
    inside: list[Expression] = []
    if low is not None:
        inside.append(low - margin < q)
    if high is not None:
        inside.append(q < high + margin)
    if not inside:
        raise InvalidValueError("What is blocked has a lower or an upper bound, and neither is given.")
    if low is not None and high is not None and not low.symbols and not high.symbols:
        if float(low) > float(high):
            raise InvalidValueError(
                f"What is blocked has no place between the lower bound {float(low):g} "
                f"and the upper bound {float(high):g}."
            )
    free = _open_condition(condition, logic_and(*inside))
    return _bound_while_locked(free, low, -1), q, _bound_while_locked(free, high, 1)


def tabulated_limit(
    driver: Expression,
    points: Mapping[float, float] | Iterable[tuple[float, float]],
    *,
    smooth: bool = False,
) -> Expression:
    """Return a bound that follows a driver through points, for ``lower=`` or ``upper=`` of anything.

    It is straight between the points, and stays at the first and the last value beyond them; its gradient at
    a point is that after it. A velocity row follows the slope where it starts, so a step across a point may
    pass the bound by the change of slope times the rest of the step.

    Parameters
    ----------
    driver
        What the bound depends on, an expression of positions.
    points
        From values of the driver, increasing, to those of the bound: at least two.
    smooth
        A cubic spline (:func:`kineverse.spline`) instead, which has no corners but may swing a little beyond
        the values.

    Raises
    ------
    InvalidValueError
        For a driver that is not one number, or points that do not increase, are too few or NaN.
    """
    x = _scalar(driver, "The driver of a table of limits")
    try:
        pairs = [(float(t), float(y)) for t, y in (points.items() if isinstance(points, Mapping) else points)]
    except (TypeError, ValueError):
        raise InvalidValueError(
            f"A table of limits has points {{driver: limit}}, which is not so in {points!r:.80}."
        ) from None
    knots, values = [t for t, _ in pairs], [y for _, y in pairs]
    try:
        if smooth:
            return spline(x, knots, values)
        slopes = [(b - a) / (u - t) if u > t else 0.0 for (t, a), (u, b) in pairwise(pairs)]
        ends = [values[0], *values] if values else []
        return piecewise(x, False, knots, list(zip(ends, [0.0, *slopes, 0.0], strict=False)))
    except InvalidValueError as error:
        raise InvalidValueError(f"The table of limits is none. {error}") from None


def _open_condition(condition: Expression, at: Expression | None) -> Expression:
    free = _scalar(condition, "The condition of a lock")
    return free if at is None else free | ~_scalar(at, "Where a lock catches")


def _bound_while_locked(free: Expression, bound: Expression | None, sign: int) -> Expression:
    """Return the bound where it is not free, with the trend of being free as advice."""
    if bound is None:
        return as_expression(sign * math.inf)
    # Held in doubt: at equality a truth is 0.5.
    choice = where(1 - free, bound, sign * math.inf)
    out = {key: sign * entry for key, entry in free.gradient().items()}
    return choice.augment(out, heuristic=True) if out else choice


def _scalar(given: object, what: str) -> Expression:
    if not isinstance(given, Expression):
        raise InvalidValueError(f"{what} is an expression, not {given!r}.")
    if given.shape:
        raise InvalidValueError(f"{what} is a scalar, not of shape {given.shape}.")
    return given


def _bound(given: ExpressionLike, name: str) -> Expression:
    what = f"The {name} bound of what is blocked"
    if isinstance(given, Expression) and given.symbols:
        return _scalar(given, what)
    if not math.isfinite(_number(given, what)):
        raise InvalidValueError(f"{what} is a finite number, not {given!r}.")
    return as_expression(given)


def _number(given: object, what: str) -> float:
    try:
        return float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InvalidValueError(f"{what} is a number, not {given!r}.") from None
