"""Retraction and its derivatives, against the model's integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_observations import NoisyObserver

import kineverse as kv
from kineverse.estimation import ObservedPose, Tracker


def make_floating_body() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="box", parent="world", child="box"))
    return model


def make_drive() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Ackermann(name="car", parent="world", child="car", wheelbase=2.5))
    return model


@pytest.mark.parametrize("make", [make_floating_body, make_drive])
def test_flow_and_its_derivatives_equal_model_integration(make):
    model = make()
    (frame,) = [f for f in model.frames if model.speeds_of(f)][:1]
    process_model = Tracker(model, [frame])._update_step.process_model
    motion = process_model._flows[0]
    rng, h = np.random.default_rng(0), 1e-5

    def integrated(q, u):
        after = model.integrate(
            kv.State(dict(zip(motion.coordinates, q, strict=True))),
            dict(zip(motion.speeds, u, strict=True)),
            1.0,
        )
        return np.array([after[s] for s in motion.coordinates])

    for _ in range(3):
        q, u = rng.uniform(0.2, 0.8, len(motion.coordinates)), rng.uniform(-0.6, 0.6, len(motion.speeds))
        after, by_start, by_speeds = motion.integrate(q, u, np.empty(0))
        assert np.allclose(after, integrated(q, u), atol=1e-7)
        columns = [(integrated(q + d, u) - integrated(q - d, u)) / (2 * h) for d in h * np.eye(len(q))]
        assert np.allclose(by_start, np.transpose(columns), atol=1e-5)
        columns = [(integrated(q, u + d) - integrated(q, u - d)) / (2 * h) for d in h * np.eye(len(u))]
        assert np.allclose(by_speeds, np.transpose(columns), atol=1e-5)


@pytest.mark.parametrize("place", [(0.5, 1.0, -2.0), (300.0, -4000.0, 20.0)])
def test_floating_body_is_found_at_any_pose(place):
    model = make_floating_body()
    observer = NoisyObserver(model, ["box"])
    options = {"uncertainty": dict.fromkeys(("box/x", "box/y", "box/z"), 1e4)}
    first = Tracker(model, [ObservedPose("box", covariance=observer.covariance)], **options)
    for seed in range(8):
        turn = Rotation.random(random_state=seed)
        state = dict(zip(("box/x", "box/y", "box/z"), place, strict=True))
        state |= dict(zip(("box/qx", "box/qy", "box/qz", "box/qw"), turn.as_quat(), strict=True))
        tracker = first.copy()
        for _ in range(3):
            estimate = tracker.update(observer(state))
        said = Rotation.from_quat([estimate.state[f"box/q{c}"] for c in "xyzw"])
        assert (said * turn.inv()).magnitude() < np.radians(4)
        assert np.allclose([estimate.state[f"box/{c}"] for c in "xyz"], place, atol=0.05)
