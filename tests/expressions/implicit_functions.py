"""Implicit functions whose solutions are known in closed form."""

from __future__ import annotations

import gradient_oracle as oracle
import numpy as np

import kineverse as kv
from kineverse.expressions import array
from kineverse.expressions import functions as f
from kineverse.expressions.implicit import ImplicitFunction

# The functions' own symbols, which are seen nowhere outside of them.
x, y, z = (kv.position(f"unknown/{n}") for n in "xyz")
u, v, w = (kv.position(f"input/{n}") for n in "uvw")


def kepler() -> ImplicitFunction:
    """The eccentric anomaly x of mean anomaly u and eccentricity v: x - v sin x = u."""
    return ImplicitFunction("Kepler", (x,), (u, v), array([x - v * f.sin(x) - u]), (0,), array([u]), 9)


def cubic() -> ImplicitFunction:
    """The real root of x³ + x = u."""
    return ImplicitFunction("cubic", (x,), (u,), array([x**3 + x - u]), (0,), array([f.arcsinh(u)]), 12)


def cubic_root(u: float) -> float:
    """By Cardano."""
    return 2 / np.sqrt(3) * np.sinh(np.arcsinh(1.5 * np.sqrt(3) * u) / 3)


def polar() -> ImplicitFunction:
    """Radius x and angle y of a point (u, v) in the right half plane, by two of three equations."""
    residual = array([x * x - u * u - v * v, x * f.cos(y) - u, x * f.sin(y) - v])
    return ImplicitFunction("polar", (x, y), (u, v), residual, (1, 2), array([u + 0.3, v / (u + 0.3)]), 12)


def spherical() -> ImplicitFunction:
    """Radius x, azimuth y and elevation z of a point (u, v, w)."""
    residual = array([x * f.cos(z) * f.cos(y) - u, x * f.cos(z) * f.sin(y) - v, x * f.sin(z) - w])
    return ImplicitFunction(
        "spherical", (x, y, z), (u, v, w), residual, (0, 1, 2), array([u, v / u, w / u]), 14
    )


def half_circle() -> ImplicitFunction:
    """The positive root of x² + u² = 1, which there is for |u| < 1 alone."""
    return ImplicitFunction("half circle", (x,), (u,), array([x * x + u * u - 1.0]), (0,), array([1.0]), 12)


def radius_and_height() -> ImplicitFunction:
    """The positive root of x² + u² = v²."""
    return ImplicitFunction("height", (x,), (u, v), array([x * x + u * u - v * v]), (0,), array([v]), 12)


# -- the theorem, by itself --------------------------------------------------------------------------------


def kepler_oracle(mean: oracle.Value, eccentricity: oracle.Value) -> oracle.Value:
    """x' = (u' + v' sin x) / (1 - v cos x), the value by bisection."""
    low, high = float(mean.v) - 2.0, float(mean.v) + 2.0
    for _ in range(80):
        middle = (low + high) / 2
        too_low = middle - float(eccentricity.v) * np.sin(middle) < float(mean.v)
        low, high = (middle, high) if too_low else (low, middle)

    def gradient(heuristic):
        slope = oracle.sub(oracle.Value(1.0), oracle.mul(eccentricity, oracle.cos(itself)))
        by_mean = oracle.reciprocal(slope)
        by_eccentricity = oracle.div(oracle.sin(itself), slope)
        return oracle.chain(itself.v, (lambda: by_mean, mean), (lambda: by_eccentricity, eccentricity)).D(
            heuristic
        )

    itself = oracle.Value((low + high) / 2, gradient)
    return itself


def polar_oracle(first: oracle.Value, second: oracle.Value) -> oracle.Value:
    """Radius and angle, a vector, with D by A⁻¹ b."""

    def gradient(heuristic):
        radius, angle = (oracle.linear(lambda r, i=i: r[i], itself) for i in (0, 1))
        c, s = oracle.cos(angle), oracle.sin(angle)
        matrix = oracle.linear(
            lambda *e: np.array(e).reshape(2, 2),
            c, oracle.neg(oracle.mul(radius, s)), s, oracle.mul(radius, c),
        )  # fmt: skip
        moved = oracle.linear(lambda *e: np.array(e), first, second).D(heuristic)
        return {key: oracle.matmul(oracle.inverse(matrix), entry) for key, entry in moved.items()}

    a, b = float(first.v), float(second.v)
    itself = oracle.Value(np.array([np.hypot(a, b), np.arctan2(b, a)]), gradient)
    return itself
