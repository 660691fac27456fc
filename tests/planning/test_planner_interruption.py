"""Limits of time and signals: no search outlasts them by much, however far away its goals are."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from time import process_time

import numpy as np
import pytest
from planning_models import body

import kineverse as kv
from kineverse.model.body import Box, Sphere
from kineverse.planning import Planner

pytestmark = pytest.mark.compiler

# Seconds of the processor; without an end they took a minute and more.
MUCH = 20.0


@pytest.fixture(scope="module")
def ball() -> Planner:
    """A ball in a plane without limits beside a box, and a lock that has to be sampled finely."""
    x, y = kv.position("x"), kv.position("y")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, y, 0), body(Sphere(0.1)))
        edit.add_frame("box", "world", kv.translation(5, 0, 0), body(Box((1, 1, 1))))
        edit.constrain("lock", -1e7 + 1e7 * ((x > -3) & (x < -2)), y, 1e7)
    return Planner(model, [x, y])


@pytest.mark.sampled(3)
@pytest.mark.parametrize("method", ["rrt-connect", "prm"])
@pytest.mark.parametrize("far", [1e5, 1e6])
def test_goals_far_away_are_answered_in_time(ball: Planner, method: str, far: float) -> None:
    begin = process_time()
    path = ball.plan([0, 0], [far, 1], seconds=0.2, method=method)
    assert process_time() - begin < MUCH
    assert path or path.why
    held = ball.plan([0, 0], [far, 0], along=kv.control.Hold(kv.position("y"), 0.0), seconds=0.2)
    assert process_time() - begin < 2 * MUCH
    assert not held
    assert held.why


def test_goals_some_kilometres_away_are_reached(ball: Planner) -> None:
    path = ball.plan([0, 0], [3000, 1], seconds=60)
    assert path, path.why
    assert 3000 < path.length < 3010
    assert ball.edges(path.points[:-1], path.points[1:]).all()


def test_long_edges_are_certified_throughout(ball: Planner) -> None:
    # A post that a ball of 1 cm meets by far between the intervals of which a way has a limited number.
    x, model = kv.position("x"), kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, 0, 0), body(Sphere(0.01)))
        edit.add_frame("post", "world", kv.translation(4000.3, 0, 0), body(Box((0.01, 0.01, 0.01))))
    checker = Planner(model, [x]).checker
    assert checker.find_collision(np.array([[0.0], [4000.0]], dtype=np.float32)) is None
    edge, fraction = checker.find_collision(np.array([[0.0], [9000.0]], dtype=np.float32)) or (-1, 0.0)
    assert edge == 0
    assert fraction * 9000 == pytest.approx(4000.3, abs=0.1)


class HandlerError(Exception):
    """What the handler of a signal raises."""


def raise_error(*_: object) -> None:
    raise HandlerError


@pytest.mark.parametrize(
    "last",
    [
        lambda ball: ball.plan([0, 0], [1e6, 1], seconds=600),
        lambda ball: ball.plan([0, 0], [1e6, 1], seconds=600, method="prm"),
        lambda ball: ball.plan([0, 0], [8, 0], seconds=600, along=kv.control.Hold(kv.position("y"), 0.0)),
        lambda ball: ball.edges(np.tile([-1e6, 3], (10_000, 1)), np.tile([1e6, 3], (10_000, 1))),
    ],
    ids=["plan", "roadmap", "hold", "edges"],
)
def test_signals_end_what_lasts(ball: Planner, last: Callable[[Planner], object]) -> None:
    before = signal.signal(signal.SIGUSR1, raise_error)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGUSR1))
    timer.start()
    try:
        with pytest.raises(HandlerError):
            last(ball)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, before)
    # What was begun is not taken for known.
    assert ball.plan([0, 0], [4, 1], seconds=30, method="prm")
    assert ball.edges([[0, 0]], [[4, 1]]).all()


def test_batches_end_at_signals_when_no_thread_writes_any_more() -> None:
    f = kv.compile(np.sin(kv.position("x")) ** 2, tier="c", wait=True)
    x = np.zeros((1_000_000, 1))
    f.batch(x)
    before = signal.signal(signal.SIGUSR1, raise_error)
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGUSR1))
    timer.start()
    try:
        with pytest.raises(HandlerError):
            while True:
                f.batch(x)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, before)
    assert (f.batch(np.ones((20_000, 1))) == f([1.0])).all()
