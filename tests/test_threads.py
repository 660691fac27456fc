"""Objects that several threads share: their calls wait for each other, and each gets its own answer."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import kineverse as kv
from kineverse._runtime import CallLock
from kineverse.model.body import Body, Box, Capsule, Shape, Sphere

THREADS, CALLS = 4, 40
x, y = kv.position("x"), kv.position("y")


def in_threads(work: Callable[[int], object]) -> None:
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, range(THREADS)))


@pytest.fixture(scope="module")
def model() -> kv.Model:
    made = kv.Model()
    with made.edit() as edit:
        edit.add_frame("hand", "world", kv.translation(x, y, 0), Body(collisions=(Shape(Capsule(0.1, 0.2)),)))
        for k, solid in enumerate(itertools.islice(itertools.cycle((Box((0.2, 0.2, 0.2)), Sphere(0.1))), 60)):
            place = kv.translation(k % 8 - 4, k // 8 - 4, 0)
            edit.add_frame(f"post{k}", "world", place, Body(collisions=(Shape(solid),)))
    return made


def test_locks_are_copied_and_pickled_as_other_locks() -> None:
    lock = CallLock()
    with lock, lock:
        for other in (copy.deepcopy(lock), pickle.loads(pickle.dumps(lock))):
            with other:
                assert other is not lock


def test_scene_that_threads_ask_has_the_answers_of_one(model: kv.Model) -> None:
    scene = kv.geometry.Scene(model)
    query = scene.watch(moving=[x, y], radius=1.0)
    places = np.random.default_rng(0).uniform(-4, 4, (THREADS, CALLS, 2))
    alone = [[[(r.a, r.b, r.distance) for r in query.at(q)] for q in row] for row in places]

    def work(k: int) -> None:
        for q, wanted in zip(places[k], alone[k], strict=True):
            assert [(r.a, r.b, r.distance) for r in query.at(q)] == wanted
            scene.update(q)
            scene.pairs_within(0.5)
            scene.first_contact()

    in_threads(work)


def test_controller_that_threads_step_goes_on(model: kv.Model) -> None:
    scene = kv.geometry.Scene(model)
    controller = kv.control.Controller(
        model, [kv.control.Goal(x, 10.0), kv.control.Goal(y, 1.0)], scene=scene, dt=0.01
    )

    def work(k: int) -> None:
        for i in range(CALLS):
            command = controller.step({"x": -4.5 + 0.1 * k, "y": -4.5 + 0.01 * i})
            assert np.isfinite(list(command.speeds.values())).all()

    in_threads(work)


def test_tracker_that_threads_update_has_seen_all(model: kv.Model) -> None:
    tracker = kv.estimation.Tracker(model, ["hand"], start={"x": 0.0, "y": 0.0})
    tracker.wait()

    def work(k: int) -> None:
        for _ in range(CALLS):
            tracker.update({"hand": np.array(kv.translation(0.2, 0.1, 0)())})
            tracker.copy()

    in_threads(work)
    assert tracker.estimate.state[x] == pytest.approx(0.2, abs=0.01)


def test_identifier_that_threads_feed_has_seen_all() -> None:
    identifier = kv.estimation.Identifier(noise=1e-4 * np.eye(6))

    def work(k: int) -> None:
        for i in range(10):
            identifier.add(np.eye(4), np.array(kv.translation(0.01 * (10 * k + i), 0, 0)()))
            if i == 5 and len(identifier) > 2:
                assert identifier.result is not None

    in_threads(work)
    assert len(identifier) == 10 * THREADS


def test_evaluator_that_threads_share_does_no_harm() -> None:
    evaluate = kv.compile([np.sin(x) * np.ones((40, 40)), x + y], [x, y], tier="c", wait=True).bind()

    def work(k: int) -> None:
        for _ in range(50 * CALLS):
            evaluate([0.5, 0.5])

    in_threads(work)
    assert evaluate.outputs[1] == 1.0
