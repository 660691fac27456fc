"""Locks that a controller opens on its way to a goal, with each rule of trends.

The lockbox is that of the thesis behind the 2020 paper: six bolts a to f, of which a is to be opened. Random
boxes have conditions on earlier bolts alone, so each can be opened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_, mul, or_
from time import thread_time
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from kineverse.control import Controller, Goal
from kineverse.expressions.expression import Expression
from kineverse.expressions.functions import sqrt
from kineverse.logic import less
from kineverse.model.model import Model
from kineverse.symbols import Symbol, position

Rule: TypeAlias = Literal["and", "product", "none"]
RULES: Mapping[Rule, str] = MappingProxyType(
    {
        "and": "trends of & and |",
        "product": "product rule",
        "none": "exact gradients alone",
    }
)
"""Rules of trends, with their names in tables."""

DT, STEPS = 0.19, 200
"""Control period [s] and largest number of steps (thesis)."""
_RATE = 0.2
"""Rate at which a condition is pursued along its trend [1/s], as far as speeds allow."""
_REACHED = 0.01
_SHUT = 0.5

Condition: TypeAlias = tuple[str, float]
Bolts: TypeAlias = Mapping[str, Sequence[Sequence[Condition]]]
"""Conditions of each bolt: all of the groups have to hold, each by one of its members ``bolt > value``."""

THESIS: Bolts = MappingProxyType(
    {
        "a": ((("b", 0.4),), (("c", 0.6),)),
        "b": ((("d", 0.8),),),
        "c": ((("d", 0.5),), (("e", 1.0),)),
        "d": ((("e", 0.9),),),
        "e": ((("f", 1.2),),),
        "f": (),
    }
)
UPPER: Mapping[str, float] = MappingProxyType({"a": 1.2, "b": 0.7, "c": 0.8, "d": 0.9, "e": 1.1})
"""Upper limits of the bolts of the thesis; the goal is that of a."""
_FAST, _SLOW = 0.4, 0.1


@dataclass(frozen=True, slots=True)
class UnlockingRun:
    """Opening of a box.

    Attributes
    ----------
    done, steps
        Whether the goal was reached, and the number of steps.
    order
        Bolts in the order in which they began to move by more than a tenth of their range.
    cpu
        CPU times of the steps [s].
    """

    done: bool
    steps: int
    order: tuple[str, ...]
    cpu: tuple[float, ...]


def unlock(
    bolts: Bolts, goal: str, upper: Mapping[str, float], rule: Rule, steps: int = STEPS
) -> UnlockingRun:
    """Open a box by a controller whose goals are the last bolt, and each condition along its trend.

    Parameters
    ----------
    bolts, upper
        Conditions, and upper limits [m]; a bolt without limit has none.
    goal
        The bolt to open.
    rule
        Rule of trends.
    steps
        Largest number of steps.
    """
    model, q, conditions = make_box(bolts, upper, rule)
    tasks = [Goal(q[goal], upper[goal], name="goal", gain=1.0)]
    if rule != "none":
        tasks += [_pursue(name, condition) for name, condition in conditions.items()]
    controller = Controller(model, tasks, dt=DT, smooth=1e-3, posture=0.0)
    state = model.default_state()
    order: dict[str, None] = {}
    cpu: list[float] = []
    for step in range(steps):
        if state[q[goal]] >= upper[goal] - _REACHED:
            return UnlockingRun(True, step, tuple(order), tuple(cpu))
        begin = thread_time()
        command = controller.step(state)
        cpu.append(thread_time() - begin)
        state = model.integrate(state, command.speeds, DT)
        order.update(dict.fromkeys(name for name, s in q.items() if state[s] > 0.1 * upper.get(name, 1.0)))
    return UnlockingRun(False, steps, tuple(order), tuple(cpu))


def make_box(
    bolts: Bolts, upper: Mapping[str, float], rule: Rule
) -> tuple[Model, dict[str, Symbol], dict[str, Expression]]:
    """Return the model of a box, its bolts, and the condition of each bolt that has one.

    Back is always free: a bolt with a condition c moves at speeds from -.1 to .1 c; the goal of the thesis at
    ±.4 c, one without a condition at ±.4 [m/s].
    """
    q = {name: position(f"box/{name}") for name in bolts}
    both = mul if rule == "product" else and_
    conditions: dict[str, Expression] = {}
    model = Model()
    with model.edit() as edit:
        for name, groups in bolts.items():
            symbol, speed = q[name], q[name].derivative()
            if name in upper:
                edit.constrain(f"{name}/position", 0, symbol, upper[name])
            else:
                edit.constrain(f"{name}/position", 0, symbol, 10.0)
            if not groups:
                edit.constrain(f"{name}/velocity", -_FAST, speed, _FAST)
                continue
            held = [reduce(or_, [less(value, q[other]) for other, value in group]) for group in groups]
            condition = conditions[name] = reduce(both, held)
            if name == "a":
                edit.constrain(f"{name}/velocity", -_FAST * condition, speed, _FAST * condition)
            else:
                edit.constrain(f"{name}/velocity", -_SLOW, speed, _SLOW * condition)
    return model, q, conditions


def draw_box(parts: int, seed: int) -> tuple[Bolts, str, dict[str, float]]:
    """Return a random box with one to three conditions each, 30 % of them or; the last bolt; and limits."""
    rng = np.random.default_rng(seed)
    names = [f"bolt_{k}" for k in range(parts)]
    bolts: dict[str, Sequence[Sequence[Condition]]] = {names[0]: ()}
    for k in range(1, parts):
        others = rng.permutation(k)[: int(rng.integers(1, 4))]
        conditions = [(names[j], round(float(rng.uniform(0.2, 0.8)), 2)) for j in others.tolist()]
        groups: list[list[Condition]] = []
        for condition in conditions:
            if groups and rng.random() < 0.3:
                groups[-1].append(condition)
            else:
                groups.append([condition])
        bolts[names[k]] = groups
    return bolts, names[-1], dict.fromkeys(names, 1.0)


def _pursue(name: str, condition: Expression) -> Goal:
    """Return the goal of moving along the unit vector of a condition's trend while it does not hold."""
    trend = condition.gradient()
    length = sqrt(sum(slope * slope for slope in trend.values()) + 1e-12)
    along = sum(slope * speed for speed, slope in trend.items()) / length
    return Goal(along, _RATE, name=f"unlock {name}", weight=less(condition, _SHUT))
