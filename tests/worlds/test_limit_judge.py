"""Violations of limits in successive states, with speeds that are differences of states."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.worlds.run_metrics import LimitJudge

A, B = kv.position("a"), kv.position("b")


def judged(*states, dt=0.5):
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("range", 0, A, 1)
        edit.constrain("lock", -1, A.derivative(), 2 * (B > 0.5))
    judge = LimitJudge(model)
    assert judge.symbols == (A, B)
    for n, state in enumerate(states):
        judge.update(np.array(state), n * dt)
    return judge


def test_motion_within_limits_violates_nothing():
    judge = judged((0.0, 0.0), (0.0, 1.0), (1.0, 1.0))
    assert (judge.violation, judge.limit) == (0.0, "")


def test_motion_through_a_lock_is_measured_by_its_speed():
    judge = judged((0.0, 0.0), (0.2, 0.0))
    assert judge.violation == pytest.approx(0.4)
    assert judge.limit == "lock"


def test_lock_that_opens_or_closes_within_a_step_may_have_been_open():
    assert judged((0.0, 0.0), (0.5, 1.0)).limit == ""
    assert judged((0.0, 1.0), (0.5, 0.0)).limit == ""


def test_position_beyond_its_limit_is_the_largest_violation():
    judge = judged((0.0, 1.0), (1.0, 1.0), (1.3, 1.0), (1.0, 1.0))
    assert judge.violation == pytest.approx(0.3)
    assert judge.limit == "range"
    judge.reset()
    assert (judge.violation, judge.limit) == (0.0, "")
