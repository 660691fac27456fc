"""Turns of joints without limits: the estimate counts on, as integrators, controllers and gears do."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.articulations import DifferentialDrive, OmniBase
from kineverse.control import Controller, Goal
from kineverse.estimation import HypothesisBank, Tracker

DT = 1 / 30


def make_pinion(radius: float = 0.05) -> kv.Model:
    """Return a pinion without limits that drives a rack."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Continuous(name="q", parent="world", child="pinion", axis=(0, 0, 1)))
        edit.add_frame("rack", "world", kv.translation(radius * kv.position("q"), 0.05, 0))
    return model


MODEL = make_pinion()


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.parametrize("is_compiled", [True, False])
@pytest.mark.parametrize("process", ["position", "velocity"])
@pytest.mark.parametrize("outliers", [None, True])
def test_estimate_follows_a_joint_over_three_turns_and_back(is_compiled, process, outliers):
    tracker = Tracker(
        MODEL, ["pinion"], process=process, outliers=outliers, start={"q": 0.3}, process_noise={"q": 4.0}
    )
    assert tracker.periodic == {MODEL.symbol("q")}
    if is_compiled:
        assert tracker.wait()
    else:
        tracker._update_step.native = None
    observer, before, most = NoisyObserver(MODEL, ["pinion"]), 0.3, 0.0
    for k in range(120):
        truth = 0.3 + 10.0 * (1.0 - np.cos(0.05 * k))
        result = tracker.update(observer({"q": truth}), at=DT * k).state["q"]
        assert result == pytest.approx(truth, abs=0.2)
        # The rack, which is not observed, does not jump.
        assert abs(result - before) < 0.8
        before, most = result, max(most, result)
    assert most > 6 * np.pi


def test_start_beyond_half_a_turn_stays_on_its_turn():
    tracker, observer = Tracker(MODEL, ["pinion"], start={"q": 20.0}), NoisyObserver(MODEL, ["pinion"])
    for truth in (20.0, 20.1):
        assert tracker.update(observer({"q": truth})).state["q"] == pytest.approx(truth, abs=0.1)
    assert tracker.predict(2.0, {"q:velocity": 1.0}).state["q"] == pytest.approx(22.1, abs=0.1)
    assert tracker.reset({"q": -9.0}).state["q"] == -9.0
    assert tracker.update(observer({"q": -8.9})).state["q"] == pytest.approx(-8.9, abs=0.1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("start", [0.0, 0.4])
@pytest.mark.parametrize("truth", [1.0, -2.5, 20.0])
@pytest.mark.parametrize("outliers", [None, True])
def test_a_turn_that_is_observed_is_found(truth, start, outliers):
    """The place of the rack determines the turn of the pinion, also from a start that is turns away."""
    frames = ["pinion", "rack"]
    tracker = Tracker(MODEL, frames, start={"q": start}, outliers=outliers)
    observer = NoisyObserver(MODEL, frames)
    assert not tracker.periodic
    for k in range(30):
        estimate = tracker.update(observer({"q": truth}), at=DT * k)
    assert estimate.state["q"] == pytest.approx(truth, abs=0.1)


def test_estimate_after_a_jump_has_the_turn_nearest_to_the_prediction():
    tracker = Tracker(MODEL, ["pinion"], process="static", outliers=True, lost_after=3)
    observer = NoisyObserver(MODEL, ["pinion"])
    place = {"q": 0.0}
    for k in range(100):
        place = {"q": 0.2 * k}
        tracker.update(observer(place), at=DT * k, commands={"q:velocity": 0.2 / DT})
    assert tracker.estimate.state["q"] == pytest.approx(19.8, abs=0.3)
    estimates = [tracker.update(observer({"q": 21.5}), at=4.0 + DT * k) for k in range(10)]
    assert estimates[-1].state["q"] == pytest.approx(21.5, abs=0.2)


@pytest.mark.parametrize(("ratio", "turns"), [(-1.5, 2), (1 / 3, 3)])
@pytest.mark.parametrize("steps", [15, pytest.param(30, marks=pytest.mark.long)])
def test_turns_that_no_gear_determines_are_those_nearest_to_the_prediction_after_a_jump(ratio, turns, steps):
    """A gear next to its driver stands as before after several turns."""
    model = make_pinion()
    with model.edit() as edit:
        edit.add_frame("gear", "world", kv.translation(0, 0.3, 0) @ kv.rotation_z(ratio * kv.position("q")))
    frames = ["pinion", "gear"]
    tracker = Tracker(model, frames, process="static", outliers=True, lost_after=3)
    assert tracker.periodic == {model.symbol("q")}
    observer, far = NoisyObserver(model, frames), 3.0 * turns * np.pi
    step = far / (steps - 1)
    for k in range(steps):
        tracker.update(observer({"q": step * k}), at=DT * k, commands={"q:velocity": step / DT})
    estimates = [tracker.update(observer({"q": far + 0.8}), at=4.0 + DT * k) for k in range(6)]
    assert estimates[-1].state["q"] == pytest.approx(far + 0.8, abs=0.2)
    assert tracker.rebuild().estimate.state["q"] == pytest.approx(far + 0.8, abs=0.2)


def test_late_measurements_and_copies_keep_the_turn():
    tracker = Tracker(MODEL, ["pinion"], lag=0.5, process="velocity")
    observer = NoisyObserver(MODEL, ["pinion"])
    for k in range(150):
        for step in (k + 1, k) if k % 2 else ():
            tracker.update(observer({"q": 0.1 * step}), at=DT * step)
    estimate = tracker.copy().update(observer({"q": 15.1}), at=DT * 151)
    assert estimate.state["q"] == pytest.approx(15.1, abs=0.2)


def test_rebuilt_tracker_keeps_the_turn():
    tracker, observer = Tracker(MODEL, ["pinion"], keep=20), NoisyObserver(MODEL, ["pinion"])
    for k in range(150):
        tracker.update(observer({"q": 0.1 * k}), at=DT * k)
    assert tracker.rebuild().estimate.state["q"] == pytest.approx(14.9, abs=0.3)


def test_all_trackers_of_a_bank_keep_the_turn():
    bank = HypothesisBank({"is": Tracker(MODEL, ["pinion"]), "other": Tracker(make_pinion(0.2), ["pinion"])})
    observer = NoisyObserver(MODEL, ["pinion"])
    for k in range(100):
        bank.update(observer({"q": 0.2 * k}), at=DT * k)
    for estimate in bank.estimates.values():
        assert estimate.state["q"] == pytest.approx(19.8, abs=0.3)


@pytest.mark.parametrize("joint", [OmniBase, DifferentialDrive])
@pytest.mark.parametrize("process", ["position", "velocity"])
def test_heading_of_a_base_that_drives_in_circles_counts_turns(joint, process):
    model = kv.Model()
    with model.edit() as edit:
        options = {} if joint is OmniBase else {"radius": 0.1, "track": 0.4}
        edit.apply(joint(name="base", parent="world", child="base", **options))
    observer = NoisyObserver(model, ["base"])
    tracker = Tracker(model, ["base"], process=process, start={"base/angle": 0.0})
    for k in range(100):
        turn = 0.15 * k
        truth = {"base/x": np.sin(turn), "base/y": 1.0 - np.cos(turn), "base/angle": turn}
        estimate = tracker.update(observer(truth), at=DT * k)
        assert estimate.state["base/angle"] == pytest.approx(turn, abs=0.2)
    assert tracker.predict(0.0).state["base/angle"] > 4 * np.pi


def test_controller_fed_by_a_tracker_arrives_beyond_half_a_turn():
    """Otherwise it would turn for ever towards a value that the tracker never reports."""
    q = MODEL.symbol("q")
    controller = Controller(MODEL, [Goal(q, 4.0, speed=1.0)], dt=DT)
    tracker, observer = Tracker(MODEL, ["pinion"], start={q: 0.0}), NoisyObserver(MODEL, ["pinion"])
    state, speeds = kv.State({q: 0.0}), {}
    for k in range(300):
        believed = tracker.update(observer(state), at=DT * k, commands=speeds).state
        speeds = dict(controller.step(believed).speeds)
        state = MODEL.integrate(state, speeds, DT)
    assert state[q] == pytest.approx(4.0, abs=0.1)
