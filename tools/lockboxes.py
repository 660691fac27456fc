"""Compare plans for random lockboxes with exhaustive search on what the boxes were drawn from.

    python tools/lockboxes.py --boxes 2000 --seed 0

The boxes have two to five sliders. A slider rises and falls if conditions hold: windows of others, or what is
outside of them, joined by and, or and not, and latches of its own. Some can only be beyond a stop while a
condition holds. The search and the simulation know the
conditions as they were drawn, and neither the model nor the library. It is counted what a plan finds, refutes
and leaves undecided; wrong is a refutation of what can be reached, a plan for what cannot, and one that the
library's own check or the simulation refuses. The exit status is 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from time import process_time

import numpy as np

import kineverse as kv
from kineverse.reasoning import plan_unlocking, plan_violations, refutation_gaps

State = Mapping[str, float]


@dataclass(frozen=True)
class Beyond:
    """Condition that a slider is above a threshold, or below it."""

    name: str
    threshold: float
    above: bool

    def holds(self, state: State) -> bool:
        """Return whether it holds; at the threshold it does not."""
        here = state[self.name]
        return here > self.threshold if self.above else here < self.threshold

    def expression(self, q: Mapping[str, kv.Symbol]) -> kv.Expression:
        """Return the condition for the library."""
        return q[self.name] > self.threshold if self.above else q[self.name] < self.threshold

    def thresholds(self) -> Iterator[tuple[str, float]]:
        """Yield the thresholds."""
        yield self.name, self.threshold


@dataclass(frozen=True)
class Joined:
    """Conjunction or disjunction of conditions, or its negation."""

    conditions: tuple[Beyond | Joined, ...]
    every: bool
    negated: bool = False

    def holds(self, state: State) -> bool:
        """Return whether it holds."""
        truths = [c.holds(state) for c in self.conditions]
        return (all(truths) if self.every else any(truths)) != self.negated

    def expression(self, q: Mapping[str, kv.Symbol]) -> kv.Expression:
        """Return the condition for the library."""
        first, *rest = (c.expression(q) for c in self.conditions)
        for other in rest:
            first = first & other if self.every else first | other
        return ~first if self.negated else first

    def thresholds(self) -> Iterator[tuple[str, float]]:
        """Yield the thresholds."""
        for c in self.conditions:
            yield from c.thresholds()


@dataclass(frozen=True)
class Slider:
    """Slider with its range, and the conditions under which it rises and falls; None for always.

    A stop is a position beyond which it can only be while a condition holds.
    """

    lower: float
    upper: float
    rises: Beyond | Joined | None = None
    falls: Beyond | Joined | None = None
    stop: tuple[float, Beyond | Joined] | None = None


@dataclass(frozen=True)
class Box:
    """Sliders by name, where they are, where some of them are to be, and how the model states the locks."""

    sliders: Mapping[str, Slider]
    start: State
    goal: State
    form: str = "one"

    def thresholds(self, name: str) -> list[float]:
        """Return the thresholds of a slider, sorted."""
        every = [c for s in self.sliders.values() for c in (s.rises, s.falls) if c is not None]
        every += [s.stop[1] for s in self.sliders.values() if s.stop]
        return sorted({x for c in every for other, x in c.thresholds() if other == name})

    def is_stopped(self, state: State) -> bool:
        """Return whether a slider is where it cannot be."""
        stops = ((state[name], *s.stop) for name, s in self.sliders.items() if s.stop)
        return any(here > stop and not condition.holds(state) for here, stop, condition in stops)


def draw_box(seed: int) -> Box:
    """Return a random box."""
    rng = np.random.default_rng(seed)
    names = [f"s{k}" for k in range(int(rng.integers(2, 6)))]
    grid = 0.05 if rng.random() < 0.5 else 0.001  # a coarse grid has equal thresholds in several locks
    ranges = {name: (0.0, 1.0) if rng.random() < 0.7 else (-1.0, 1.0) for name in names}

    def number(name: str) -> float:
        low, high = ranges[name]
        return round(low + grid * float(rng.integers(1, round((high - low) / grid))), 6)

    def simple(name: str) -> Beyond | Joined:
        x, y = sorted((number(name), number(name)))
        kind = rng.random()
        if x == y or kind < 0.4:
            return Beyond(name, x, bool(rng.random() < 0.5))
        if kind < 0.75:
            window = Joined((Beyond(name, x, True), Beyond(name, y, False)), True)
        else:
            window = Joined((Beyond(name, x, False), Beyond(name, y, True)), False)
        return Joined((window,), True, True) if rng.random() < 0.2 else window

    def condition(name: str) -> Beyond | Joined:
        others = [other for other in names if other != name]
        about = [str(rng.choice(others)) for _ in range(1 + int(rng.random() < 0.5))]
        if rng.random() < 0.25:
            about.append(name)  # a latch
        parts = [simple(other) for other in about]
        if len(parts) == 1:
            return parts[0]
        return Joined(tuple(parts), bool(rng.random() < 0.6), bool(rng.random() < 0.15))

    sliders = {}
    for name in names:
        rises = falls = condition(name) if rng.random() < 0.85 else None
        kind = rng.random()
        if kind < 0.3:
            falls = None
        elif kind < 0.5:
            rises = None
        elif kind < 0.8:
            falls = condition(name)
        sliders[name] = Slider(*ranges[name], rises, falls)
    box = Box(sliders, {}, {})

    def place(name: str) -> float:
        low, high = ranges[name]
        if rng.random() < 0.4:
            return low if rng.random() < 0.5 else high
        while True:
            x = round(float(rng.uniform(low, high)), 3)
            if all(abs(x - t) > 2e-3 for t in box.thresholds(name)) and low < x < high:
                return x

    if rng.random() < 0.3:
        name = str(rng.choice(names))
        others = [other for other in names if other != name]
        stop = 0.0, simple(str(rng.choice(others)))
        sliders[name] = replace(sliders[name], stop=stop)
        low, high = ranges[name]
        while any(abs(stop[0] - t) <= 2e-3 for t in (low, high, *box.thresholds(name))):
            stop = round(float(rng.uniform(low, high)), 3), stop[1]
        sliders[name] = replace(sliders[name], stop=stop)
    start = {name: place(name) for name in names}
    while box.is_stopped(start):
        start = {name: place(name) for name in names}
    wanted = rng.choice(names, 1 + int(rng.random() < 0.3), replace=False).tolist()
    goal = {name: place(name) for name in wanted}
    return Box(sliders, start, goal, str(rng.choice(["one", "two", "where", "product"])))


def make_model(box: Box) -> kv.Model:
    """Return the model of a box."""
    q = {name: kv.position(name) for name in box.sliders}

    def speed_limit(condition: Beyond | Joined | None) -> kv.Expression | float:
        if condition is None:
            return 1.0
        if box.form == "product" and isinstance(condition, Joined) and condition.every:
            product = math.prod(c.expression(q) for c in condition.conditions)
            return 0.7 * (1 - product if condition.negated else product)
        open_ = condition.expression(q)
        return kv.where(open_, 1.0, 0.0) if box.form == "where" else open_

    model = kv.Model()
    with model.edit() as edit:
        for name, slider in box.sliders.items():
            edit.constrain(f"{name} range", slider.lower, q[name], slider.upper)
            speed, rises, falls = q[name].derivative(), speed_limit(slider.rises), speed_limit(slider.falls)
            if box.form == "two":
                edit.constrain(f"{name} rises", -2, speed, rises)
                edit.constrain(f"{name} falls", -falls, speed, 2)
            else:
                edit.constrain(f"{name} lock", -falls, speed, rises)
            if slider.stop:
                stop, condition = slider.stop
                bound = kv.where(condition.expression(q), slider.upper + 1.0, stop)
                edit.constrain(f"{name} stop", slider.lower - 1.0, q[name], bound)
    return model


def can_be_reached(box: Box) -> bool:
    """Return whether moves of one slider at a time lead to the goal, by search over all intervals."""
    places: dict[str, list[float]] = {}
    index: dict[str, dict[float, int]] = {}
    for name, slider in box.sliders.items():
        own = {slider.lower, slider.upper, box.start[name], box.goal.get(name, box.start[name])}
        own |= {slider.stop[0]} if slider.stop else set()
        cuts = sorted({*own, *box.thresholds(name)})
        found = [x for a, b in pairwise(cuts) for x in (a, (a + b) / 2) if x != a or x in own]
        places[name] = [*found, slider.upper]
        index[name] = {x: n for n, x in enumerate(places[name])}
    names = list(box.sliders)
    start = tuple(index[name][box.start[name]] for name in names)
    goal = {names.index(name): index[name][x] for name, x in box.goal.items()}
    seen, waiting = {start}, [start]
    free: dict[tuple[tuple[int, ...], int, int], bool] = {}

    def is_free(here: tuple[int, ...], k: int, way: int) -> bool:
        key = here, k, way
        if key not in free:
            slider = box.sliders[names[k]]
            condition = slider.rises if way > 0 else slider.falls
            state = {name: places[name][n] for name, n in zip(names, here, strict=True)}
            free[key] = condition is None or condition.holds(state)
        return free[key]

    while waiting:
        here = waiting.pop()
        if all(here[k] == n for k, n in goal.items()):
            return True
        for k, name in enumerate(names):
            for way in (1, -1):
                n = here[k] + way
                if not 0 <= n < len(places[name]):
                    continue
                there = (*here[:k], n, *here[k + 1 :])
                if there in seen or not (is_free(here, k, way) and is_free(there, k, way)):
                    continue
                if not box.is_stopped(
                    {other: places[other][m] for other, m in zip(names, there, strict=True)}
                ):
                    seen.add(there)
                    waiting.append(there)
    return False


def simulation_error(box: Box, moves: list[tuple[str, float]]) -> str:
    """Return why moves are impossible, or do not end at the goal; empty if they are right."""
    state = dict(box.start)
    for n, (name, target) in enumerate(moves, 1):
        slider, cuts = box.sliders[name], box.thresholds(name)
        if not slider.lower - 1e-12 <= target <= slider.upper + 1e-12:
            return f"move {n} leaves the range of {name}"
        condition = slider.rises if target > state[name] else slider.falls
        low, high = sorted((state[name], target))
        within = [x for x in cuts if low < x < high]
        points = [*np.linspace(low, high, max(2, round((high - low) / 2e-3))).tolist()]
        points += [(x + y) / 2 for x, y in pairwise([low, *within, high])]
        for x in sorted(points, reverse=target < state[name])[:-1]:
            at_threshold = any(abs(x - t) < 1e-9 for t in cuts)
            state[name] = x
            if not (at_threshold or condition is None or condition.holds(state)):
                return f"{name} is held at {x:g} in move {n}"
            if not at_threshold and box.is_stopped(state):
                return f"move {n} brings a slider beyond its stop"
        state[name] = target
        if box.is_stopped(state):
            return f"move {n} ends beyond a stop"
    missed = [name for name, x in box.goal.items() if abs(state[name] - x) > 1e-9]
    return f"{missed} missed" if missed else ""


@dataclass(frozen=True)
class Answer:
    """Verdict of a plan, what is wrong with it, and the time that it took [s]."""

    verdict: str
    wrong: str
    reason: str
    seconds: float


def try_box(box: Box) -> Answer:
    """Plan the opening of a box, and compare with exhaustive search and simulation."""
    model, expected = make_model(box), can_be_reached(box)
    begin = process_time()
    plan = plan_unlocking(model, box.goal, box.start)
    seconds = process_time() - begin
    wrong = ""
    if plan.verdict == "found":
        wrong = "; ".join(plan_violations(model, plan, box.start)) or simulation_error(
            box, [(str(step.coordinate), step.target) for step in plan.steps]
        )
        wrong = wrong or ("" if expected else "a plan for what is out of reach")
    elif plan.verdict == "refuted":
        wrong = "; ".join(refutation_gaps(model, plan, box.start))
        wrong = "refuted, though it can be reached" if expected else wrong
    return Answer(plan.verdict, wrong, plan.reason or ("within reach" if expected else ""), seconds)


def main() -> int:
    """Compare as many boxes as the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--boxes", type=int, default=2000, help="how many (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first one (%(default)s)")
    given = parser.parse_args()
    count: dict[str, int] = dict.fromkeys(("found", "refuted", "undecided", "wrong"), 0)
    times = list[float]()
    for seed in range(given.seed, given.seed + given.boxes):
        answer = try_box(draw_box(seed))
        count[answer.verdict] += 1
        count["wrong"] += bool(answer.wrong)
        times.append(answer.seconds)
        if answer.wrong or answer.verdict == "undecided":
            print(f"box {seed}: {answer.verdict}: {answer.wrong or answer.reason}")
    print(", ".join(f"{number} {what}" for what, number in count.items()))
    print(f"a plan took {1e3 * np.median(times):.0f} ms, and at most {1e3 * max(times):.0f} ms")
    return 1 if count["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
