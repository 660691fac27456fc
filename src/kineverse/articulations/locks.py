"""State-dependent limits: speed locks, position locks and tabulated limits.

Locks are constraints with expressions as bounds. :func:`speed_lock` and :func:`position_lock` return the
triple (lower, expression, upper), for ``edit.constrain(name, *triple)`` and for the constraints of an
operation's :class:`.Writes`; :func:`tabulated_limit` returns a bound. Conditions are expressions of logic,
such as ``bolt > 0.3``.
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

from .joint import check_joint_number, check_scalar

BoundedExpression: TypeAlias = tuple[Expression, Expression, Expression]


def speed_lock(
    speed: Expression,
    *,
    open_if: Expression,
    engaged_if: Expression | None = None,
    max_speed: float = 1.0,
    blocks: Literal["both", "forward", "backward"] = "both",
) -> BoundedExpression:
    """Return the lock of a speed: -c·max_speed <= q̇ <= c·max_speed with c = open_if (2022 paper, Eq. 13).

    The speed is 0 while the lock is closed. The gradients of the bounds are those of c, so they show the
    direction in which the lock opens.

    Parameters
    ----------
    speed
        The speed to lock; for an expression of positions q, its speed q̇.
    open_if
        Condition under which the lock is open.
    engaged_if
        Condition under which the lock catches, usually on q; elsewhere the speed is free, so that
        c = open_if | ~engaged_if.
    max_speed
        Limit of the speed while the lock is open [m/s] or [rad/s].
    blocks
        The directions that are locked. With ``"forward"``, the opposite direction is free:
        -max_speed <= q̇ <= c·max_speed.

    Raises
    ------
    InvalidValueError
        For an expression that is not a scalar, a limit that is not positive, or another direction.

    Examples
    --------
    >>> door, handle = kv.position("door"), kv.position("handle")
    >>> lock = kv.articulations.speed_lock(door, open_if=handle > 0.5, blocks="forward")
    >>> _, speed, upper = lock
    >>> upper({"handle": 0.0}), upper({"handle": 0.6})
    (np.float64(0.0), np.float64(1.0))
    >>> upper.gradient()  # pressing the handle opens it
    {handle:velocity: 1}
    """
    rate = check_scalar(speed, "The speed of a lock")
    if not any(s.order for s in rate.symbols):
        rate = total_derivative(rate)
    if not rate.symbols:
        raise InvalidValueError(f"The speed of a lock depends on coordinates, and {speed!r} does not.")
    check_joint_number(max_speed, "The max_speed of a lock", positive=True)
    free = _open_condition(open_if, engaged_if)
    if blocks not in ("both", "forward", "backward"):
        raise InvalidValueError(f"A lock blocks 'both', 'forward' or 'backward', not {blocks!r}.")
    most, open_ = as_expression(float(max_speed)), free * max_speed
    return -(most if blocks == "forward" else open_), rate, (most if blocks == "backward" else open_)


def position_lock(
    q: Expression,
    *,
    open_if: Expression,
    lower: ExpressionLike | None = None,
    upper: ExpressionLike | None = None,
    margin: float = 1e-3,
) -> BoundedExpression:
    """Return the lock of a position: q stays within [lower, upper] unless the lock is open.

    Note that a position that is *outside* already is free, and free to return. A bolt that springs out
    while the door stands open holds nothing; it holds the door once that is shut. With c = open_if, the
    bounds are::

        locked = ~c & (lower - margin < q) & (q < upper + margin)
        lower  = where(locked, lower, -∞),     upper = where(locked, upper, ∞)

    so the constraint can be satisfied at every q, and its velocity row asks for no jump. A position within
    the margin, by rounding or play, still counts as locked and is led back. The heuristic gradients of the
    bounds are those of ~locked: the direction in which the lock opens.

    Parameters
    ----------
    q
        The position to lock, an expression of positions.
    open_if
        Condition under which the lock is open.
    lower, upper
        Bounds while it is locked [m] or [rad], numbers or expressions; None leaves that side open. Equal
        bounds lock one position.
    margin
        Distance outside of the bounds up to which it is still locked [m] or [rad].

    Raises
    ------
    InvalidValueError
        For an expression that is not a scalar, bounds that leave nothing between them, NaN, or a margin that
        is not positive.

    Examples
    --------
    >>> door, bolt = kv.position("door"), kv.position("bolt")
    >>> lock = kv.articulations.position_lock(door, open_if=bolt > 0.01, lower=0, upper=0)
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("door", parent="world", transform=kv.rotation_z(door))
    ...     edit.constrain("door/lock", *lock)
    'frame door'
    'constraint door/lock'
    >>> model.limits("door", {"door": 0, "bolt": 0}), model.limits("door", {"door": 0, "bolt": 0.02})
    ((0.0, 0.0), (-inf, inf))
    """
    if not check_scalar(q, "The position of a lock").symbols or any(s.order for s in q.symbols):
        raise InvalidValueError(f"The position of a lock is an expression of positions, not {q!r}.")
    check_joint_number(margin, "The margin of a lock", positive=True)
    low = None if lower is None else _bound(lower, "The lower bound of a lock")
    high = None if upper is None else _bound(upper, "The upper bound of a lock")
    inside = [] if low is None else [low - margin < q]
    inside += [] if high is None else [q < high + margin]
    if not inside:
        raise InvalidValueError("The lock of a position has a lower or an upper bound, and neither is given.")
    if low is not None and high is not None and not low.symbols and not high.symbols:
        if float(low) > float(high):
            raise InvalidValueError(
                f"The lock of a position leaves nothing between the lower bound {float(low):g} "
                f"and the upper bound {float(high):g}."
            )
    free = _open_condition(open_if, logic_and(*inside))
    return _bound_while_locked(free, low, -1), q, _bound_while_locked(free, high, 1)


def tabulated_limit(
    driver: Expression, points: Mapping[float, float] | Iterable[tuple[float, float]], *, smooth: bool = False
) -> Expression:
    """Return a bound interpolated in a table of the driver, for ``lower=`` or ``upper=`` of any constraint.

    It is linear between the points and constant beyond them; its gradient at a point is that after the
    point. A velocity row follows the slope at its start, so a step across a point may pass the bound by the
    change of slope times the rest of the step.

    Parameters
    ----------
    driver
        The argument of the table, an expression of positions.
    points
        Increasing values of the driver with the values of the bound, at least two.
    smooth
        True for a cubic spline (:func:`kineverse.spline`), which has no corners but may overshoot the values.

    Raises
    ------
    InvalidValueError
        For a driver that is not a scalar, or points that do not increase, are too few or NaN.

    Examples
    --------
    >>> lift = kv.position("lift")
    >>> upper = kv.articulations.tabulated_limit(lift, {0.0: 0.2, 0.5: 1.5})
    >>> upper({"lift": 0.25}).round(3), upper({"lift": 2.0})
    (np.float64(0.85), np.float64(1.5))
    """
    x = check_scalar(driver, "The driver of a table of limits")
    try:
        pairs = [(float(t), float(y)) for t, y in (points.items() if isinstance(points, Mapping) else points)]
    except (TypeError, ValueError):
        wanted = "has points {driver: limit}, and is not"
        raise InvalidValueError(f"A table of limits {wanted} {points!r:.80}.") from None
    knots, values = [t for t, _ in pairs], [y for _, y in pairs]
    try:
        if smooth:
            return spline(x, knots, values)
        slopes = [(b - a) / (u - t) if u > t else 0.0 for (t, a), (u, b) in pairwise(pairs)]
        ends = [values[0], *values] if values else []
        return piecewise(x, False, knots, list(zip(ends, [0.0, *slopes, 0.0], strict=False)))
    except InvalidValueError as error:
        raise InvalidValueError(f"The table of limits is not valid. {error}") from None


def _open_condition(open_if: Expression, engaged_if: Expression | None) -> Expression:
    free = check_scalar(open_if, "The condition open_if of a lock")
    if engaged_if is None:
        return free
    return free | ~check_scalar(engaged_if, "The condition engaged_if of a lock")


def _bound_while_locked(free: Expression, bound: Expression | None, sign: int) -> Expression:
    """Return the bound while the lock is closed, with the trend of ``free`` as its heuristic gradient."""
    if bound is None:
        return as_expression(sign * math.inf)
    # At equality a condition is 0.5, which counts as locked.
    choice = where(1 - free, bound, sign * math.inf)
    out = {key: sign * entry for key, entry in free.gradient().items()}
    return choice.augment(out, heuristic=True) if out else choice


def _bound(given: ExpressionLike, what: str) -> Expression:
    if isinstance(given, Expression) and given.symbols:
        return check_scalar(given, what)
    return as_expression(check_joint_number(given, what))
