"""``control``: a PR2, a Fetch and an HSR open a fridge that they hold, beside pink and mink."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from typing import Any

from kineverse.errors import MissingDependencyError
from kineverse.state import State

from .controller_loop import ControllerLoop
from .harness import BenchmarkSettings, Contender, has_peer, install_advice, run_program, time_contenders
from .opening import CONTACTS, OPENING, PERIOD, STEPS, Opening, make_opening, peer_workload
from .result import BenchmarkResult, Comparison, bound_median, compare_speed
from .timed_loop import TimedLoop

COMPARED = "pr2"
"""Robot of the peers."""

BUILD, READY = f"{COMPARED}: build of the controller", f"{COMPARED}: from there until C runs"
PEERS = ("pink", "mink")
REDUCED = "reduced by hand"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the steps of controllers that open a fridge, without and with contact slots."""
    missing: list[str] = []
    plain: list[TimedLoop] = []
    close: list[TimedLoop] = []
    others: list[TimedLoop] = []
    for robot in settings.robots:
        opening = make_opening(robot)
        controller = opening.controller()
        controller.wait()
        start = opening.find_start(controller)
        plain.append(TimedLoop(f"{robot}: kineverse", ControllerLoop(controller, start), PERIOD, STEPS))
        if robot == COMPARED:
            others += [loop for peer in PEERS if has_peer(peer) for loop in _peers(peer, opening, start)]
            missing += [install_advice(peer) for peer in PEERS if not has_peer(peer)]
        try:
            close.append(_near_the_kitchen(opening))
        except MissingDependencyError as error:
            missing.append(f"contact slots are left out: {error}")
    own = [*plain, *close]
    loops = [*own, *others]
    errors = [loop.mean_error() for loop in (*plain, *others)]
    contenders = [loop.contender for loop in loops]
    measured = time_contenders("control", contenders, settings.rounds, settings.progress)
    fresh = time_contenders("control", _fresh_builds(), settings.processes, settings.progress)
    comparisons: list[Comparison] = [bound_median(fresh[BUILD], 0.3), bound_median(fresh[READY], 10.0)]
    for loop in plain:
        comparisons += loop.bounds(mean=50e-6, p99=200e-6, worst=2e-3)
    for loop in close:
        comparisons += loop.bounds(median=300e-6, p99=1e-3)
    ours = f"{COMPARED}: kineverse"
    if ours in measured:
        comparisons += [compare_speed(measured, ours, f"{COMPARED}: {peer}", 5.0) for peer in PEERS]
        comparisons += [compare_speed(measured, ours, f"{COMPARED}: {peer}, {REDUCED}") for peer in PEERS]
    return BenchmarkResult(
        name="control",
        work=(
            f"robots with base and arm hold a fridge's handle and open the door, {STEPS} steps of {PERIOD:g} "
            f"s: CPU time from the state to the command; with {CONTACTS} contact slots this includes the "
            "queries of the scene"
        ),
        measurements=(
            *fresh.values(),
            *measured.values(),
            *(alone for loop in own for alone in loop.solver_alone()),
            *(loop.p99() for loop in loops),
            *errors,
            *(loop.slots_in_use(CONTACTS) for loop in close),
        ),
        comparisons=tuple(comparisons),
        missing=tuple(dict.fromkeys(missing)),
    )


def _near_the_kitchen(opening: Opening) -> TimedLoop:
    scene = opening.scene()
    controller = opening.controller(scene)
    controller.wait()
    start = opening.find_start(controller, scene)
    name = f"{opening.robot}: kineverse, {CONTACTS} contact slots"
    return TimedLoop(name, ControllerLoop(controller, start), PERIOD, STEPS)


def _peers(library: str, opening: Opening, start: State) -> Iterator[TimedLoop]:
    """Yield a peer with all joints, and with those alone that our controller found."""
    moving = {symbol.path for task in opening.tasks for symbol in task.error.symbols}
    for name, kept in ((library, None), (f"{library}, {REDUCED}", moving)):
        workload = peer_workload(opening, start, kept)
        loop: Any
        if library == "pink":
            from .peers.pink_control import make_pink_loop

            loop = make_pink_loop(OPENING, workload)
        else:
            from .peers.mink_control import make_mink_loop

            loop = make_mink_loop(OPENING, workload)
        yield TimedLoop(f"{opening.robot}: {name}", loop, PERIOD, STEPS)


def _fresh_builds() -> list[Contender]:
    """Return the build in a fresh process with an empty cache, and the time until the program is compiled."""
    found: dict[str, float] = {}

    def build() -> float:
        with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as empty:
            found.update(run_program("build_controller", COMPARED, cache=empty))
        return found["build"]

    return [Contender(BUILD, build), Contender(READY, lambda: found["ready"])]
