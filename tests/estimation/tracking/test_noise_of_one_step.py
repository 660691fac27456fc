"""Noise that is stated for one step: covariances of an array of poses, process noise, refuted groups."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation import Tracker, pose_covariance
from kineverse.lie import retract

FRAMES = ["left_leaf", "right_leaf"]


@pytest.fixture(scope="module")
def model():
    model = kv.Model()
    with model.edit() as edit:
        for side, y in ("left", 0.5), ("right", -0.5):
            origin, leaf = kv.translation(0, y, 0), f"{side}_leaf"
            edit.apply(
                kv.Revolute(
                    name=side, parent="world", child=leaf, axis=(0, 0, 1), origin=origin, lower=0, upper=2
                )
            )
    return model


def look(model, rng, **values):
    true = np.array([model.fk(name)(kv.State(values)) for name in FRAMES])
    return retract(true, 0.01 * rng.standard_normal((len(FRAMES), 6)))


def test_covariances_of_an_array_are_those_of_pairs(model):
    rng = np.random.default_rng(0)
    by_array, by_pairs = Tracker(model, FRAMES), Tracker(model, FRAMES)
    for step in range(5):
        poses = look(model, rng, left=0.5, right=1.0)
        factors = rng.normal(size=(2, 6, 6))
        covariances = 1e-4 * (factors @ np.swapaxes(factors, 1, 2) + np.eye(6))
        seen = np.array([True, step % 2 == 0])
        covariances[~seen] = np.nan  # those of missing poses are not read
        pairs = {n: (poses[k], covariances[k]) for k, n in enumerate(FRAMES) if seen[k]}
        here = by_array.update_poses(poses, seen, covariances=covariances, at=0.1 * step)
        there = by_pairs.update(pairs, at=0.1 * step)
        assert dict(here.state) == pytest.approx(dict(there.state), abs=1e-12)
        np.testing.assert_allclose(here.covariance, there.covariance, rtol=1e-9)
        assert here.log_evidence == pytest.approx(there.log_evidence)


def test_process_noise_of_a_step_stands_for_that_of_the_tracker(model):
    rng = np.random.default_rng(1)
    usual, other = Tracker(model, FRAMES), Tracker(model, FRAMES, process_noise={"left": 0.3})
    for step in range(1, 5):
        poses = look(model, rng, left=0.5, right=1.0)
        here = usual.update_poses(poses, at=0.1 * step, process_noise={"left": 0.3})
        there = other.update_poses(poses, at=0.1 * step)
        np.testing.assert_allclose(here.covariance, there.covariance, rtol=1e-9)
    here, there = usual.predict(0.5, process_noise={"left:velocity": 0.0}), other.predict(0.5)
    assert here.deviation["left"] < there.deviation["left"]
    assert here.deviation["right"] == pytest.approx(there.deviation["right"])


def test_late_measurements_repeat_steps_with_their_own_noise(model):
    rng = np.random.default_rng(2)
    readings = [look(model, rng, left=0.5, right=1.0) for _ in range(4)]
    noises = [{"left": 0.2}, {}, {"right": 0.5}, {"left": 0.0}]

    def follow(order, lag):
        tracker = Tracker(model, FRAMES, lag=lag)
        for k in order:
            tracker.update_poses(readings[k], at=0.1 * (k + 1), process_noise=noises[k])
        return tracker.estimate

    np.testing.assert_allclose(
        follow((0, 1, 2, 3), 0.0).covariance, follow((0, 1, 2, 3), 1.0).covariance, rtol=1e-9
    )


def test_refuted_groups_are_those_that_moved(model):
    rng = np.random.default_rng(3)
    tracker = Tracker(model, FRAMES, process="static")
    covariances = np.tile(pose_covariance(0.01, 0.01), (2, 1, 1))
    for step in range(10):
        poses = look(model, rng, left=0.5, right=1.0)
        estimate = tracker.update_poses(poses, covariances=covariances, at=0.1 * step)
        assert estimate.refuted_groups == ()
    poses = look(model, rng, left=0.7, right=1.0)
    estimate = tracker.update_poses(poses, covariances=covariances, at=1.0)
    assert estimate.refuted_groups == ((model.symbol("left"),),)
    assert not estimate.lost


def test_wrong_noise_is_refused(model):
    tracker, poses = Tracker(model, FRAMES), np.tile(np.eye(4), (2, 1, 1))
    good = np.tile(np.eye(6), (2, 1, 1))
    with pytest.raises(ShapeError, match=r"covariances.*\(2, 6, 6\)"):
        tracker.update_poses(poses, covariances=good[0])
    for wrong in (np.nan, -1.0):
        bad = good.copy()
        bad[1, 2, 2] = wrong
        with pytest.raises(InvalidValueError, match="covariance of 'right_leaf'"):
            tracker.update_poses(poses, covariances=bad)
    with pytest.raises(InvalidValueError, match=r"process_noise= need the time"):
        tracker.update_poses(poses, process_noise={"left": 0.1})
    with pytest.raises(InvalidValueError, match="process noise of 'left'"):
        tracker.predict(0.1, process_noise={"left": -1.0})
    assert tracker.estimate.stamp is None
