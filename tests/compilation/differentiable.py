"""Expressions to differentiate, for the functions of JAX and PyTorch, and what those may hold."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from compiled_programs import BINARY, SPECIAL, UNARY, arm

import kineverse as kv
from kineverse.compilation.program import Program
from kineverse.expressions import Expression
from kineverse.expressions.expression import binary, unary
from kineverse.expressions.node import Node

A, B = kv.position("a"), kv.position("b")
SIZE = kv.parameter("size", 2.0)


@dataclass(frozen=True)
class Case:
    """Expressions, their inputs, and points, a row each."""

    outputs: list[Expression]
    inputs: list[kv.Symbol]
    points: np.ndarray

    def values(self) -> tuple[np.ndarray, ...]:
        values: tuple[np.ndarray, ...] = kv.compile(self.outputs, self.inputs, tier="interpreter").batch(
            self.points
        )
        return values

    def slopes(self) -> list[np.ndarray]:
        """Return the derivatives that the library gives, input by input."""
        columns = [[derivative(e, s) for s in self.inputs] for e in self.outputs]
        return [
            np.stack(kv.compile(one, self.inputs, tier="interpreter").batch(self.points), axis=-1)
            for one in columns
        ]


def derivative(e: Expression, symbol: kv.Symbol) -> Expression:
    """Return that of the augmented gradient by a position, and the plain one by any other input."""
    columns = e.partial([symbol]) if symbol == SIZE or symbol.order else e.jacobian([symbol])
    return columns[..., 0]


# Kinks, and places without a derivative: 0, equal arguments, and the ends of a range.
_KINKS = np.array([[0.0, 0.0], [1.0, 1.0], [0.0, 2.0], [-1.0, 1.0], [0.3, -0.7], [2.0, 0.0], [-0.4, -0.4]])


def kinks() -> Case:
    outputs = [
        abs(A),
        kv.norm(kv.array([A, B])),
        np.hypot(A, B),
        kv.maximum(A, B),
        kv.minimum(A, kv.maximum(B, 0)),
        kv.clip(A, -1, 1),
        kv.where(A < B, A * B, np.sin(A)),
        np.sign(A) * B,
        np.floor(B) + np.fmod(A, 0.3),
    ]
    return Case(outputs, [A, B], _KINKS)


def powers() -> Case:
    return Case([A**B], [A, B], np.array([[0.0, 1.0], [0.0, 2.0], [1.0, 0.0], [2.0, -1.0]]))


def augmented() -> Case:
    a_dot, b_dot = A.derivative(), B.derivative()
    outputs = [
        (A * B).augment({a_dot: B**2}),
        np.sin(A).with_gradient({b_dot: A, a_dot: SIZE}),
        (A < B) & (B < SIZE),
    ]
    return Case(outputs, [B, SIZE, A], np.random.default_rng(1).normal(size=(7, 3)))


def parameters() -> Case:
    velocity = A.derivative()
    outputs = [
        kv.rotation_z(A) @ kv.translation(SIZE, velocity, B * SIZE),
        (velocity * SIZE).augment({A.derivative(): 3.0}),
        kv.array(7.0),
        kv.array([[0.0, 1.0], [2.0, 0.0]]),
        kv.array([A, 1.0, SIZE]),
    ]
    return Case(outputs, [SIZE, A, velocity, B], np.random.default_rng(2).normal(size=(6, 4)))


def _mechanism(name: str, frame: str, lower: float, upper: float) -> Case:
    pose = kv.load(f"articulations/{name}").fk(f"{name}/{frame}")
    (symbol,) = pose.symbols
    return Case([pose], [symbol], np.linspace(lower, upper, 9)[:, None])


def four_bar() -> Case:
    return _mechanism("four_bar", "rocker", -3.0, 3.0)


def folding_door() -> Case:
    return _mechanism("folding_door", "door/lower_panel", 0.1, 1.7)


def robot_arm() -> Case:
    mechanism = arm(joints=4)
    points = np.random.default_rng(0).uniform(-3, 3, (11, 4))
    return Case([mechanism.pose, mechanism.jacobian], mechanism.symbols, points)


CASES: dict[str, Callable[[], Case]] = {
    make.__name__: make for make in (kinks, powers, augmented, parameters, four_bar, folding_door, robot_arm)
}


def operations() -> tuple[Program, np.ndarray]:
    """Return a program with an output for each operation, and points: special ones, whole ones, and others."""
    outputs = [unary(op, A) for op in UNARY] + [binary(op, A, B) for op in BINARY]
    normal = [x for x in SPECIAL if x == 0 or not abs(x) < 1e-300]
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(normal, normal), axis=-1).reshape(-1, 2)
    others = random.normal(0, 3, (500, 2)), random.integers(-6, 7, (300, 2)) / 2
    return Program(outputs, [A, B]), np.concatenate([grid, *others])


def assert_same_operations(found: np.ndarray, program: Program, points: np.ndarray) -> None:
    """Compare results, an output in each column, with those of CasADi's interpreter."""
    wanted = np.stack([o.full().ravel() for o in program.function.map(len(points))(points.T)], axis=-1)
    with np.errstate(all="ignore"):
        equal = (found == wanted) | (np.isnan(found) & np.isnan(wanted))
        # XLA takes numbers too small for full precision as zero.
        tiny = (abs(wanted) < 1e-300) & (abs(found) < 1e-300)
        close = abs(found - wanted) <= 1e-13 * abs(wanted)
    assert (equal | tiny | close).all(axis=0).tolist() == [True] * found.shape[1]


def held_objects(function: Any) -> Iterator[object]:
    """Yield all that a function holds: by closures, defaults and attributes, but for modules and classes."""
    waiting, seen = [function], {id(function)}
    while waiting:
        one = waiting.pop()
        yield one
        parts: list[Any] = []
        if isinstance(one, types.FunctionType):
            cells = one.__closure__ or ()
            parts = [*(c.cell_contents for c in cells), one.__defaults__, one.__kwdefaults__, one.__dict__]
        elif isinstance(one, dict):
            parts = [*one, *one.values()]
        elif isinstance(one, (list, tuple, set, frozenset)):
            parts = list(one)
        elif not isinstance(one, (type, types.ModuleType, str, bytes, int, float, np.ndarray)):
            names = [n for c in type(one).__mro__ for n in getattr(c, "__slots__", ())] + list(
                vars(one) if hasattr(one, "__dict__") else ()
            )
            names += ["__wrapped__", "__self__", "__func__", "fun", "jvp", "func", "args"]
            parts = [getattr(one, n) for n in names if isinstance(n, str) and hasattr(one, n)]
        for part in parts:
            if id(part) not in seen:
                seen.add(id(part))
                waiting.append(part)


def assert_holds_no_expressions(function: Any) -> None:
    held = list(held_objects(function))
    assert len(held) > 20  # it was looked into
    assert not [one for one in held if isinstance(one, (Expression, kv.Symbol, Node, kv.Model))]
