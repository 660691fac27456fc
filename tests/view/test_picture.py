import errno
import os
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from small_models import BLUE, RED, cabinet

import kineverse as kv
from kineverse.errors import FormatError, InvalidValueError, ShapeError, UnknownNameError
from kineverse.view import Camera, picture, save_picture
from kineverse.view.pictures import encode_png, write_png

pytestmark = pytest.mark.usefixtures("fine_pictures")

FRONT = Camera((-3.0, 0.3, 1.0), (0.0, 0.0, 0.5))
SMALL = (160, 120)


def reddish(image):
    r, g, b = np.moveaxis(image.astype(int), -1, 0)
    return (r > 1.8 * g) & (r > 1.8 * b)


def bluish(image):
    r, g, b = np.moveaxis(image.astype(int), -1, 0)
    return (b > 1.4 * r) & (b > 1.4 * g)


def test_parts_are_drawn_in_their_colours():
    image = picture(cabinet(), camera=FRONT, size=SMALL)
    assert image.shape == (120, 160, 3)
    assert image.dtype == np.uint8
    assert 150 < reddish(image).sum() < 3000
    assert bluish(image).sum() > 300


def test_opening_the_drawer_moves_red_pixels_and_shows_more_of_it():
    model, side = cabinet(), Camera((-2.0, -3.0, 1.2), (0.0, 0.0, 0.5))
    shut = reddish(picture(model, camera=side, size=SMALL))
    open_ = reddish(picture(model, {"cabinet/drawer": 0.4}, camera=side, size=SMALL))
    assert open_.sum() > 1.5 * shut.sum()


def test_parts_behind_others_are_hidden():
    image = picture(cabinet(), camera=Camera((3.0, 0.0, 1.0), (0.0, 0.0, 0.5)), size=SMALL)
    assert reddish(image).sum() == bluish(image).sum() == 0


def test_the_automatic_camera_shows_moving_parts():
    image = picture(cabinet(), size=SMALL)
    assert reddish(image).sum() > 50
    assert bluish(image).sum() > 50


def test_states_are_given_by_symbol_by_name_or_as_larger_states():
    model, door = cabinet(), kv.position("cabinet/door")
    by_name = picture(model, {"cabinet/door": 1.0}, camera=FRONT, size=SMALL)
    np.testing.assert_array_equal(by_name, picture(model, {door: 1.0}, camera=FRONT, size=SMALL))
    more = kv.State({door: 1.0, kv.position("elsewhere"): 3.0})
    np.testing.assert_array_equal(by_name, picture(model, more, camera=FRONT, size=SMALL))
    np.testing.assert_array_equal(by_name, picture(model.snapshot(), more, camera=FRONT, size=SMALL))


def test_unknown_names_are_refused_with_the_right_ones():
    with pytest.raises(UnknownNameError, match="cabinet/door"):
        picture(cabinet(), {"cabinet/dor": 1.0}, size=SMALL)


def test_frames_are_drawn_on_demand_and_through_bodies():
    plain = picture(cabinet(), camera=FRONT, size=(480, 360))
    axes = picture(cabinet(), camera=FRONT, size=(480, 360), frames=True)
    assert 200 < (plain != axes).any(axis=2).sum() < 10_000


def test_collision_shapes_on_demand():
    assert bluish(picture(cabinet(), camera=FRONT, size=SMALL, collisions=True)).sum() == 0


@pytest.mark.parametrize("frames", [False, True])
def test_models_without_bodies_show_their_frames(frames):
    model = kv.Model()
    assert picture(model, size=(64, 48), frames=frames).shape == (48, 64, 3)
    with model.edit() as edit:
        edit.add_frame("a", parent="world", transform=kv.translation(1, kv.position("a"), 0))
    assert len(np.unique(picture(model, size=(64, 48)).reshape(-1, 3), axis=0)) > 20


@pytest.mark.parametrize("size", [(0, 10), (10, -1), (100_000, 100_000)])
def test_invalid_picture_sizes_are_refused(size):
    with pytest.raises(InvalidValueError):
        picture(cabinet(), size=size)


@pytest.mark.parametrize("name", kv.shipped_models())
@pytest.mark.sampled(3)
def test_every_shipped_model_makes_a_picture(name):
    assert len(np.unique(picture(kv.load(name), size=SMALL).reshape(-1, 3), axis=0)) > 200


def test_pictures_are_deterministic():
    np.testing.assert_array_equal(picture(cabinet(), size=SMALL), picture(cabinet(), size=SMALL))


def test_save_picture_writes_a_png_that_other_libraries_read(tmp_path):
    imaging = pytest.importorskip("PIL.Image")
    save_picture(tmp_path / "cabinet.png", cabinet(), {"cabinet/door": 0.7}, size=SMALL)
    with imaging.open(tmp_path / "cabinet.png") as file:
        np.testing.assert_array_equal(np.asarray(file), picture(cabinet(), {"cabinet/door": 0.7}, size=SMALL))


@pytest.mark.parametrize("channels", [3, 4])
def test_encode_png_writes_valid_chunks(channels):
    data = encode_png(np.random.default_rng(0).integers(0, 256, (5, 7, channels), dtype=np.uint8))
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    position, kinds = 8, []
    while position < len(data):
        (length,), kind = (
            struct.unpack(">I", data[position : position + 4]),
            data[position + 4 : position + 8],
        )
        body = data[position + 8 : position + 8 + length]
        (check,) = struct.unpack(">I", data[position + 8 + length : position + 12 + length])
        assert check == zlib.crc32(kind + body)
        kinds.append(kind)
        position += 12 + length
    assert kinds == [b"IHDR", b"IDAT", b"IEND"]


@pytest.mark.parametrize(
    "wrong", [np.zeros((4, 4)), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4, 3), np.uint8)]
)
def test_arrays_that_are_no_image_are_refused(wrong):
    with pytest.raises(ShapeError):
        encode_png(wrong)


def test_the_colours_of_the_test_models_are_as_assumed():
    assert RED[0] > 1.8 * max(RED[1:3])
    assert BLUE[2] > 1.4 * max(BLUE[:2])


def test_picture_names_of_other_formats_are_refused(tmp_path):
    pixels = np.zeros((2, 2, 3), dtype=np.uint8)
    for name in ("x.png", "x.PNG", "x"):
        write_png(tmp_path / name, pixels)
        assert (tmp_path / name).read_bytes() == encode_png(pixels)
    with pytest.raises(FormatError, match=r"written as \.png, not \.jpg"):
        write_png(tmp_path / "x.jpg", pixels)
    assert not (tmp_path / "x.jpg").exists()


def test_a_picture_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    file = tmp_path / "picture.png"
    write_png(file, np.zeros((2, 2, 3), np.uint8))
    before = file.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FormatError, match=r"picture\.png cannot be written: No space left on device"):
        write_png(file, np.ones((2, 2, 3), np.uint8))
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_a_picture_goes_through_a_pipe_that_stays_one(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit((tmp_path / "pipe.png").read_bytes)
        write_png(tmp_path / "pipe.png", np.zeros((2, 2, 3), np.uint8))
        assert read.result(60).startswith(b"\x89PNG")
    assert (tmp_path / "pipe.png").is_fifo()
