"""Clips: animated pictures of sweeps, trajectories and recordings."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from small_models import cabinet

from kineverse.cli.command_line import main
from kineverse.errors import ShapeError
from kineverse.planning import Trajectory
from kineverse.view import Camera, clips
from kineverse.view.clips import ClipMoment, clip_times, draw_clip, encode_clip, sweep_ranges

SMALL = (96, 72)
FRONT = Camera((-3.0, 0.9, 1.0), (0.0, 0.0, 0.5))
HELD = [word for name in ("door", "drawer", "knob") for word in ("--set", f"cabinet/{name}=0")]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Draw few and small pictures."""
    monkeypatch.setattr(clips, "RATE", 1.0)
    monkeypatch.setattr(clips.draw_clip, "__defaults__", (SMALL, *clips.draw_clip.__defaults__[1:]))


def decode(data):
    frames = []
    with Image.open(io.BytesIO(data)) as image:
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.asarray(image.convert("RGB"), dtype=int))
        return frames, image.info


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_clip_shows_its_pictures_at_its_rate_again_and_again(suffix):
    colours = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200]], dtype=np.uint8)
    pictures = [np.broadcast_to(colour, (12, 16, 3)).copy() for colour in colours]
    frames, info = decode(encode_clip(pictures, suffix, rate=10.0))
    assert len(frames) == 3
    for frame, colour in zip(frames, colours, strict=True):
        np.testing.assert_allclose(frame, np.broadcast_to(colour, frame.shape), atol=12)
    assert info["duration"] == 100  # [ms]
    assert info["loop"] == 0


def test_pictures_of_different_sizes_are_refused():
    with pytest.raises(ShapeError, match="one size"):
        encode_clip([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], ".gif")
    with pytest.raises(ShapeError, match="one or more"):
        encode_clip([], ".gif")


def test_floor_and_camera_stand_still_while_a_part_moves():
    """Only what moves, and its shadow, changes: the corners of the picture are the same in all pictures."""
    moments = [ClipMoment({"cabinet/drawer": value}) for value in (0.0, 0.2, 0.4)]
    first, second, third = (picture.astype(int) for picture in draw_clip(cabinet(), moments, camera=FRONT))
    changed = (first != third).any(axis=2)
    assert 10 < changed.sum() < 0.5 * changed.size
    assert (second != first).any()
    for corner in (np.s_[:4, :4], np.s_[:4, -4:], np.s_[-4:, :4]):
        np.testing.assert_array_equal(first[corner], third[corner])


def test_a_sweep_goes_through_all_ranges_and_ends_where_it_begins():
    moments = sweep_ranges(cabinet())
    model = cabinet()
    for symbol in map(model.symbol, ("cabinet/drawer", "cabinet/door")):
        lower, upper = model.limits(symbol)
        values = np.array([moment.state[str(symbol)] for moment in moments])
        assert (values >= lower - 1e-9).all()
        assert (values <= upper + 1e-9).all()
        assert np.ptp(values) > 0.8 * (upper - lower)
        assert abs(values[0] - values[-1]) < 0.4 * (upper - lower)  # one of eight steps


def test_a_sweep_holds_what_it_is_told_to_hold():
    held = {"cabinet/drawer": 0.1}
    assert {moment.state["cabinet/drawer"] for moment in sweep_ranges(cabinet(), held, held=held)} == {0.1}
    everything = {str(symbol): 0.0 for symbol in cabinet().degrees_of_freedom}
    assert sweep_ranges(cabinet(), everything, held=everything) == []


def test_times_follow_the_speed():
    assert clip_times(4.0) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert clip_times(4.0, speed=2.0) == [0.0, 2.0, 4.0]
    assert clip_times(0.0) == [0.0]


def test_the_command_writes_a_clip_of_a_model_and_of_a_trajectory(tmp_path, capsys):
    file, sweep, played = (str(tmp_path / name) for name in ("cabinet.kv.json", "sweep.webp", "played.gif"))
    model = cabinet()
    model.save(file)
    assert main(["view", file, "--picture", sweep]) == 0
    assert f"clip: {sweep}" in capsys.readouterr().out
    frames, _ = decode((tmp_path / "sweep.webp").read_bytes())
    assert len(frames) == clips.PERIOD
    assert len({frame.tobytes() for frame in frames}) > 1

    drawer = model.symbol("cabinet/drawer")
    way = Trajectory((drawer,), np.array([0.0, 2.0]), np.array([[0.0], [0.4]]), np.full((2, 1), 0.2))
    way.save(tmp_path / "way.json")
    assert main(["view", file, "--play", str(tmp_path / "way.json"), "--picture", played]) == 0
    frames, _ = decode((tmp_path / "played.gif").read_bytes())
    assert len(frames) == 3


@pytest.mark.parametrize("words", [("--near", "5cm"), HELD])
def test_the_command_refuses_clips_that_show_no_motion(words, tmp_path, capsys):
    file = str(tmp_path / "cabinet.kv.json")
    cabinet().save(file)
    assert main(["view", file, "--picture", str(tmp_path / "a.webp"), *words]) == 2
    assert ".png" in capsys.readouterr().err
    assert not (tmp_path / "a.webp").exists()


def test_other_commands_name_the_one_that_writes_clips(capsys):
    assert main(["reach", "fetch", "fetch/gripper_link", "--pose", "1", "0", "1", "--picture", "a.webp"]) == 2
    assert "kineverse view" in capsys.readouterr().err
