"""``motion``: a step of all coordinates at constant speeds, and all constraints, at one configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse.model.violations import Violations
from kineverse.state import State

from .harness import BenchmarkSettings, Contender, time_calls, time_contenders
from .result import BenchmarkResult, bound_median
from .workloads import make_kitchen_model

INTEGRATOR, INTEGRATE = "kineverse, integrator", "kineverse, model.integrate"
CHECKER, VIOLATIONS = "kineverse, constraint checker", "kineverse, model.violations"

_STEP = 0.02
_CHECKED = 10


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the compiled objects, from arrays to arrays, and the plain methods, from states to states."""
    name, model = make_kitchen_model()
    count = settings.configurations
    random = np.random.default_rng(0)
    q = random.uniform(-1, 1, (count, len(model.symbols)))
    v = random.uniform(-1, 1, (count, len(model.speeds)))
    measured = time_contenders("motion", _steps(model, q, v), settings.rounds, settings.progress)
    measured |= time_contenders("motion", _checks(model, q, v), settings.rounds, settings.progress)
    return BenchmarkResult(
        name="motion",
        work=(
            f"{name}: {len(model.symbols)} coordinates after {_STEP} s at constant speeds, and "
            f"{len(model.constraints)} constraints; {count} random configurations"
        ),
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[INTEGRATOR], 5e-6), bound_median(measured[CHECKER], 5e-6)),
    )


def _steps(model: Model, q: Array, v: Array) -> list[Contender]:
    integrator = model.integrator()
    integrator.wait()
    symbols, columns = integrator.symbols, integrator.speeds
    states = [State(dict(zip(symbols, row, strict=True))) for row in q[:_CHECKED].tolist()]
    speeds = [dict(zip(columns, row, strict=True)) for row in v[:_CHECKED].tolist()]
    vectors = list(zip(q, v, strict=True))

    def run() -> None:
        for start, speed in vectors:
            integrator(start, speed, _STEP)

    def run_plain() -> list[State]:
        return [model.integrate(*pair, _STEP) for pair in zip(states, speeds, strict=True)]

    def ends() -> Sequence[Array]:
        return [integrator(*pair, _STEP) for pair in vectors[:_CHECKED]]

    def plain_ends() -> Sequence[Array]:
        return [np.array([after[s] for s in symbols]) for after in run_plain()]

    return [
        Contender(INTEGRATOR, time_calls(run, len(vectors)), ends),
        Contender(INTEGRATE, time_calls(run_plain, len(states)), plain_ends),
    ]


def _checks(model: Model, q: Array, v: Array) -> list[Contender]:
    symbols = (*model.symbols, *model.speeds)
    checker = model.constraint_checker(symbols)
    checker.wait()
    points = list(np.hstack([q, v]))
    states = [State(dict(zip(symbols, row.tolist(), strict=True))) for row in points[:_CHECKED]]

    def run() -> None:
        for point in points:
            checker(point)

    def run_plain() -> list[Violations]:
        return [model.violations(state) for state in states]

    def excesses(find: Callable[[], list[Violations]]) -> Sequence[Array]:
        return [np.array([violation.excess for violation in found]) for found in find()]

    return [
        Contender(
            CHECKER,
            time_calls(run, len(points)),
            lambda: excesses(lambda: [checker.violations(point) for point in points[:_CHECKED]]),
        ),
        Contender(VIOLATIONS, time_calls(run_plain, len(states)), lambda: excesses(run_plain)),
    ]
