"""Compare the speed of two checkouts: python tools/bench_trees.py OLD NEW [--pairs 7] [--only NAME ...]

Each round starts one process of either checkout, the order alternating. Each process measures the same
workloads by public names alone. A ratio is the median over the rounds of old time / new time: above 1, the
new checkout is faster. Both run in this Python's environment and keep caches of their own, filled by a round
that does not count.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

LEAST_SECONDS = 0.25
"""Time for which a workload is repeated in one process."""


def workloads() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield names of workloads, and functions that do each of them once."""
    import numpy as np

    import kineverse as kv
    from kineverse.control import Controller, Goal, Hold, inverse_kinematics, same_pose
    from kineverse.estimation import ObservedPose, Tracker, identify, pose_covariance
    from kineverse.geometry import Scene
    from kineverse.planning import Planner
    from kineverse.reasoning import plan_unlocking

    random = np.random.default_rng(0)
    yield "load kitchen", lambda: _fresh_load(kv, "kitchen")
    alone = kv.load("kitchen")
    # Before others have their C compiled: one compiler runs at a time.
    angles = np.linspace(0, 1.2, 20)
    child = np.array([alone.fk("kitchen/fridge_door")({"kitchen/fridge_door": q}) for q in angles])
    child[:, :3, 3] += random.normal(0, 0.003, (20, 3))
    parent = np.broadcast_to(np.eye(4), child.shape)
    _until_compiled(lambda: identify(parent, child))
    yield "identify", lambda: identify(parent, child)

    kitchen = kv.load("kitchen")
    kitchen.include("pr2")
    yield (
        "fk and jacobian",
        lambda: (
            kitchen.copy().fk("pr2/r_gripper_tool_frame", "kitchen/fridge_door_handle"),
            kitchen.copy().jacobian("pr2/r_gripper_tool_frame"),
        ),
    )
    pose = kv.compile(kitchen.fk("pr2/r_gripper_tool_frame"), wait=True)
    row, rows = random.uniform(-1, 1, len(pose.inputs)), random.uniform(-1, 1, (20_000, len(pose.inputs)))
    evaluator = pose.bind()
    yield "call", lambda: [pose(row) for _ in range(100)]
    yield "bound call", lambda: [evaluator(row) for _ in range(100)]
    yield "batch", lambda: pose.batch(rows)

    door = kitchen.symbol("kitchen/fridge_door")
    handle = kitchen.fk("kitchen/fridge_door_handle") @ kv.rpy(np.pi / 2, 0, np.pi)
    grasp = Hold(same_pose(kitchen.fk("pr2/r_gripper_tool_frame"), handle), name="grasp")
    start = inverse_kinematics(kitchen, [grasp]).best
    controller = Controller(kitchen, [grasp, Goal(door, 1.5)], dt=0.02)
    controller.wait()
    yield "control step", lambda: [controller.step(start) for _ in range(20)]
    yield "inverse kinematics", lambda: inverse_kinematics(kitchen, [grasp])
    yield "controller made", lambda: Controller(kitchen, [grasp, Goal(door, 1.5)], dt=0.02)

    watched = ObservedPose("kitchen/fridge_door", covariance=pose_covariance(0.01, 0.03))
    tracker = Tracker(alone, [watched])
    tracker.wait()
    seen = {"kitchen/fridge_door": alone.fk("kitchen/fridge_door")({"kitchen/fridge_door": 0.4})}
    yield "track", lambda: [tracker.update(seen) for _ in range(20)]
    scene, state = Scene(kitchen), kitchen.default_state()
    moved = state.updated({"kitchen/fridge_door": 0.2})
    yield "scene, near pairs", lambda: (scene.update(state), scene.pairs_within(0.05), scene.update(moved))
    yield "scene made", lambda: Scene(kitchen)
    arm = kv.load("pr2")
    planner = Planner(
        arm, move=[str(s) for s in arm.symbols if "pr2/r_" in str(s) and "gripper" not in str(s)]
    )
    low = arm.default_state()
    planner.place(low)
    points = random.uniform(-0.3, 0.3, (2_000, len(planner.symbols)))
    yield "configurations checked", lambda: planner.valid(points)
    lockbox = kv.load("lockboxes/thesis")
    yield "plan unlocking", lambda: plan_unlocking(lockbox, {"lockbox/a": 1.2}, lockbox.default_state())
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder, "kitchen.kv.json"))
        yield "document written", lambda: alone.save(file)
        alone.save(file)
        yield "document read", lambda: _fresh_load(kv, file)
    yield "edit", lambda: _edit(kv, alone)
    yield "integrate", lambda: [kitchen.integrate(state, {}, 0.02) for _ in range(10)]
    yield "violations", lambda: [kitchen.violations(state) for _ in range(10)]


def _fresh_load(kv: Any, name: str) -> object:
    from kineverse.formats import loader

    loader._REMEMBERED.clear()
    return kv.load(name)


def _until_compiled(work: Callable[[], object], seconds: float = 60.0) -> None:
    """Work until a call takes less than .3 s: C is compiled in the background."""
    begin = start = perf_counter()
    work()
    while perf_counter() - start > 0.3 and perf_counter() - begin < seconds:
        start = perf_counter()
        work()


def _edit(kv: Any, model: Any) -> None:
    with model.edit() as edit:
        edit.add_frame("bench/frame", parent="world", transform=kv.translation(0, 0, 1))
    with model.edit() as edit:
        edit.remove(list(model.history.tags)[-1])


def commands() -> Iterator[tuple[str, list[str]]]:
    """Yield names and arguments of whole processes, measured by their processor time."""
    yield "import", ["-c", "import kineverse"]
    yield "kineverse --help", ["-m", "kineverse", "--help"]
    yield "kineverse info kitchen", ["-m", "kineverse", "info", "kitchen"]


def measure(only: list[str]) -> dict[str, float]:
    """Return the least time of each workload in this process [s]."""
    times = {}
    for name, work in workloads():
        if only and name not in only:
            continue
        work()
        begin, least = perf_counter(), math.inf
        while perf_counter() - begin < LEAST_SECONDS:
            start = perf_counter()
            work()
            least = min(least, perf_counter() - start)
        times[name] = least
    for name, arguments in commands():
        if only and name not in only:
            continue
        least = math.inf
        for _ in range(3):
            start = os.times().children_user + os.times().children_system
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            least = min(least, os.times().children_user + os.times().children_system - start)
        times[name] = least
    return times


def main() -> int:
    """Measure the trees, and print ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--pairs", type=int, default=7, help="rounds that count (7)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="some workloads")
    options = parser.parse_args()
    trees = [options.old.resolve(), options.new.resolve()]
    for tree in trees:
        if not (tree / "src" / "kineverse").is_dir():
            parser.error(f"{tree} is no checkout: it has no src/kineverse")
    times: list[dict[str, list[float]]] = [{}, {}]
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as caches:
        for number in range(options.pairs + 1):
            for which in (0, 1) if number % 2 else (1, 0):
                measured = _run(trees[which], Path(caches, str(which)), options.only)
                print(
                    f"round {number} of {options.pairs}, {('old', 'new')[which]}", file=sys.stderr, flush=True
                )
                for name, time in measured.items() if number else ():
                    times[which].setdefault(name, []).append(time)
    ratios = {}
    print(f"{'workload':26}  {'old':>10}  {'new':>10}  old/new  (quartiles)")
    for name in times[0].keys() & times[1].keys():
        pairs = [a / b for a, b in zip(times[0][name], times[1][name], strict=True)]
        ratios[name] = statistics.median(pairs)
    for name in sorted(ratios, key=ratios.__getitem__):
        pairs = [a / b for a, b in zip(times[0][name], times[1][name], strict=True)]
        low, _, high = statistics.quantiles(pairs) if len(pairs) > 1 else pairs * 3
        old, new = (1e3 * statistics.median(times[which][name]) for which in (0, 1))
        print(f"{name:26}  {old:7.3f} ms  {new:7.3f} ms  {ratios[name]:7.3f}  ({low:.3f} to {high:.3f})")
    mean = math.exp(statistics.fmean(map(math.log, ratios.values())))
    print(f"geometric mean {mean:.3f}, least {min(ratios.values()):.3f}")
    return 0


def _run(tree: Path, cache: Path, only: list[str]) -> dict[str, float]:
    environment = os.environ | {
        "PYTHONPATH": str(tree / "src"),
        "KINEVERSE_CACHE_DIR": str(cache),
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, __file__, "--measure", *only]
    process = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE)
    printed = process.stdout.decode()
    measured: dict[str, float] = json.loads(printed.splitlines()[-1])
    return measured


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measure(sys.argv[2:])))
    else:
        raise SystemExit(main())
