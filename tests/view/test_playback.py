"""Trajectories on the page: a clock, a slider for the time, and the values of the model."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.planning import Trajectory
from kineverse.view.animation import TrajectoryPlayback

pytest.importorskip("viser", reason="the page needs the extra 'view'")

DRAWER, DOOR = kv.position("cabinet/drawer"), kv.position("cabinet/door")


def opening(duration: float) -> Trajectory:
    """Return a motion that opens the drawer and the door."""
    return Trajectory((DRAWER, DOOR), [0, duration], [[0, 0], [0.4, 1.0]], np.zeros((2, 2)))


def test_a_playback_follows_its_clock(page):
    seen: list[object] = []
    trajectory = opening(2.0)
    playback = TrajectoryPlayback(
        page._server.gui, trajectory, speed=0.5, on_seek=seen.append, on_run=seen.append
    )
    playback.start(10.0)
    halfway = playback.values_at(12.0)
    assert halfway == {"cabinet/drawer": pytest.approx(0.2), "cabinet/door": pytest.approx(0.5)}
    assert playback.time == playback._slider.value == 1.0
    assert not playback.finished
    playback.pause()
    playback.start(100.0)
    assert playback.values_at(100.0) == halfway
    assert playback.values_at(200.0) == {"cabinet/drawer": 0.4, "cabinet/door": 1.0}
    assert playback.finished
    playback.start(300.0)
    assert playback.values_at(300.0)["cabinet/door"] == 0.0
    assert seen == []  # only what a user does comes back


def test_a_playback_in_a_loop_begins_again(page):
    playback = TrajectoryPlayback(
        page._server.gui, opening(2.0), loop=True, on_seek=lambda _: None, on_run=lambda _: None
    )
    playback.start(0.0)
    assert playback.values_at(7.0) == playback.values_at(1.0)
    assert not playback.finished


def test_a_played_trajectory_ends_at_its_end(page):
    page.play(opening(0.2), speed=2.0)
    with page._change:
        assert page._change.wait_for(lambda: page._animation is None, timeout=20.0)
    assert page.settled()
    assert page.values["cabinet/drawer"] == 0.4
    np.testing.assert_allclose(page.pose("cabinet/drawer")[:3, 3], [-0.4, 0, 0.7])
    page._seek(0.1)
    assert page.settled()
    assert page.values["cabinet/drawer"] == pytest.approx(0.2)
    page.reset()
    assert page.values["cabinet/drawer"] == 0.0


def test_another_animation_stops_the_trajectory(page):
    page.play(opening(100.0), loop=True)
    page.play()
    assert page._panel.playing.value
    assert not page._playback._running.value
    page._run(True)
    assert not page._panel.playing.value
    page.play(False)
    assert page._animation is None
    assert page.settled()


def test_a_trajectory_of_another_model_is_refused(page):
    other = Trajectory((kv.position("window"),), [0.0], [[0.0]], [[0.0]])
    with pytest.raises(UnknownNameError, match="window"):
        page.play(other)
    for speed in (0.0, -1.0, np.nan, "fast"):
        with pytest.raises(InvalidValueError, match="speed="):
            page.play(opening(1.0), speed=speed)
    assert page._playback is None


def test_the_controls_go_with_the_coordinates_that_they_move(page):
    page.play(opening(100.0))
    with page.model.edit() as edit:
        edit.add_frame("lid", parent="world", transform=kv.rotation_x(kv.position("lid")))
    assert page.settled()
    assert page._playback is not None
    assert page._animation is None
