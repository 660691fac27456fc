"""Tracks of markers: smoothing, noise, motion and outliers."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

pytest.importorskip("zenoh")

from kineverse.lie import pose_difference, retract, translation
from kineverse.live.marker_tracks import WINDOW, MarkerTracks

PLACE = translation(np.array([1.0, -2.0, 0.5]))
NOISE = np.repeat([0.004, 0.01], 3)


def feed(tracks, poses, begin=0.0, rate=30.0, seed=0, noise=NOISE):
    """Add poses of one marker with noise, and return the time after the last one [s]."""
    random = np.random.default_rng(seed)
    for k, pose in enumerate(poses):
        tracks.add({"marker": retract(pose, noise * random.standard_normal(6))}, begin + k / rate)
    return begin + len(poses) / rate


def test_a_marker_at_rest_is_averaged_and_its_noise_measured():
    tracks = MarkerTracks()
    feed(tracks, [PLACE] * 200)
    off = pose_difference(tracks.smoothed("marker"), PLACE)
    assert (np.abs(off) < 0.5 * NOISE).all()  # much better than one pose
    assert tracks.rests("marker")
    assert tracks.noise("marker") == pytest.approx((0.004, 0.01), rel=0.35)


def test_a_marker_that_moves_is_followed_and_comes_to_rest():
    tracks = MarkerTracks()
    way = [retract(PLACE, np.array([0.2 * k / 30, 0, 0, 0, 0, 0.3 * k / 30])) for k in range(60)]
    now = feed(tracks, [PLACE] * 40)
    now = feed(tracks, way, now, seed=1)
    assert not tracks.rests("marker")
    lag = pose_difference(way[-1], tracks.median("marker"))
    assert 0.0 < lag[0] < 0.05
    assert tracks.noise("marker")[0] < 0.008  # a steady motion is no noise
    feed(tracks, [way[-1]] * 40, now, seed=2)
    assert tracks.rests("marker")
    assert np.linalg.norm(pose_difference(tracks.smoothed("marker"), way[-1])[:3]) < 0.006


def test_a_burst_of_outliers_is_no_motion():
    tracks = MarkerTracks()
    now = feed(tracks, [PLACE] * 60)
    random = np.random.default_rng(3)
    strays = [retract(PLACE, random.uniform(-1, 1, 6)) for _ in range(WINDOW - 2)]
    now = feed(tracks, strays, now)
    feed(tracks, [PLACE] * 20, now)
    assert tracks.rests("marker")
    assert np.linalg.norm(pose_difference(tracks.smoothed("marker"), PLACE)[:3]) < 0.003


def test_rare_pictures_show_no_noise_but_a_place():
    tracks = MarkerTracks()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        feed(tracks, [PLACE] * 20, rate=1.0)
    assert tracks.is_known("marker")
    assert min(tracks.noise("marker")) > 0.005  # it is taken as large
    assert not tracks.is_known("another")
    assert tracks.seen("another") == -np.inf
