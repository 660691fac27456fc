"""Control loops of the benchmarks: ours and those of pink and mink do the same task, one step each."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import kineverse as kv
from kineverse_studies.bench import control, run_benchmarks
from kineverse_studies.bench.control import (
    DOOR,
    OPENING,
    PERIOD,
    STEPS,
    ControllerLoop,
    TimedLoop,
    make_opening,
    make_peer_loop,
    peer_workload,
)
from kineverse_studies.bench.control_workloads import WORKLOADS, export_urdf
from kineverse_studies.bench.examples import EXAMPLES, make_example_loop
from kineverse_studies.bench.harness import Contender

pytest.importorskip("daqp")

SHORT = "arm_panda_dof_freezing"

export_urdf_once = cache(export_urdf)


@pytest.fixture(autouse=True)
def urdf_written_once(monkeypatch):
    """Have each robot written as URDF once for all peers and tests."""
    monkeypatch.setattr("kineverse_studies.bench.control_workloads.export_urdf", export_urdf_once)


def peer_loop(library, name, workload=None):
    pytest.importorskip(library)
    return make_peer_loop(library, name, workload)


@cache
def opened(robot):
    opening = make_opening(robot)
    controller = opening.controller()
    return opening, controller, opening.find_start(controller)


def skip_without_robots():
    try:
        kv.load("ur_description/urdf/ur5_robot.urdf")
    except kv.KineverseError:
        pytest.skip("there is no example-robot-data")


def test_a_robot_opens_the_fridge_within_its_limits():
    opening, controller, start = opened("hsr")
    loop = ControllerLoop(controller, start)
    assert loop.error() < 1e-6
    for _ in range(STEPS):
        loop.step()
        loop.advance()
    assert loop.state[opening.model.symbol(DOOR)] > 1.5
    assert loop.error() < 1e-4
    assert not opening.model.violations(loop.state)
    loop.reset()
    assert dict(loop.state) == dict(start)


@pytest.mark.long
@pytest.mark.parametrize("library", ["pink", "mink"])
def test_a_peer_opens_the_fridge_with_few_joints_as_with_all(library):
    opening, controller, start = opened("pr2")
    moving = [speed.position.path for speed in controller.speeds]
    doors = []
    for kept in (None, moving):
        loop = peer_loop(library, OPENING, peer_workload(opening, start, kept))
        loop.reset()
        loop.aim(0.0)
        assert loop.error() < 1e-6
        for _ in range(3):
            loop.step()
            loop.advance()
        assert loop.error() < 1e-3
        doors.append(loop._velocity[loop._velocity.argmax()])
    assert doors[0] == pytest.approx(doors[1], rel=0.05)
    assert len(loop._velocity) == len(moving)


@pytest.mark.parametrize("name", [name for name in WORKLOADS if "g1" not in name and "cassie" not in name])
@pytest.mark.sampled(2)
def test_an_original_takes_a_step_towards_its_target(name):
    skip_without_robots()
    loop = peer_loop(EXAMPLES[name].library, name)
    loop.reset()
    loop.aim(2.5)
    loop.step()
    first = loop.error()
    for _ in range(3):
        loop.advance()
        loop.step()
    loop.advance()
    assert np.isfinite(loop.error())
    assert loop.error() < max(first, 1e-3)
    assert set(EXAMPLES) == set(WORKLOADS)


@pytest.mark.long
def test_our_example_starts_with_the_error_of_the_original():
    skip_without_robots()
    ours, theirs = make_example_loop(SHORT), peer_loop("mink", SHORT)
    for loop in (ours, theirs):
        loop.reset()
        loop.aim(1.0)
    theirs.step()
    assert ours.error() == pytest.approx(theirs.error(), abs=1e-6)
    timed = TimedLoop("ours", ours, PERIOD, 5)
    assert timed.run() > 0.0
    assert len(timed.times) == 5
    assert timed.solver_alone() == []  # the first motion is not counted
    assert [c.name for c in timed.bounds(mean=1.0, worst=1.0)] == ["ours, mean", "ours, worst"]


@pytest.mark.long
def test_control_is_measured_without_contacts_where_coal_is_missing(tiny, monkeypatch):
    for library in ("pink", "mink"):
        pytest.importorskip(library)

    def refuse(opening):
        raise kv.errors.MissingDependencyError("distances need coal")

    monkeypatch.setattr(control, "_near_the_kitchen", refuse)
    monkeypatch.setattr(control, "TIMED_STEPS", 20)
    builds = [Contender(name, lambda: 0.1) for name in (control.BUILD, control.READY)]
    monkeypatch.setattr(control, "_fresh_builds", lambda: builds)
    (result,) = run_benchmarks(["control"], tiny)
    assert result.missing == ("contact slots are left out: distances need coal",)
    assert all(c.value is not None for c in result.comparisons)
    errors = [m.median for m in result.measurements if m.name.endswith("mean error")]
    assert len(errors) == 5
    assert max(errors) < 1e-3


def test_an_unknown_example_is_refused(tiny):
    with pytest.raises(kv.errors.UnknownNameError, match="arm_ur5'"):
        next(run_benchmarks(["examples"], replace(tiny, examples=("arm_ur",))))
