import argparse
import contextlib
import re
import subprocess
import sys

import numpy as np
import pytest
from living_kitchen.unknown_mechanisms import MECHANISMS

import kineverse as kv
from kineverse.cli import main
from kineverse.cli.demo import add_arguments
from kineverse.cli.demo_living import MODELS, SAMPLES_PER_RANGE, STATE, _find_example, exercise_model


@pytest.fixture(scope="module")
def both():
    model = kv.Model()
    for name in MODELS:
        model.include(name)
    return model


def test_the_initial_state_is_valid_for_the_models(both):
    known = {str(symbol) for symbol in both.degrees_of_freedom}
    assert set(STATE) <= known
    assert list(both.violations(both.default_state().updated(STATE))) == []


@pytest.mark.parametrize("seconds", ["0", "nan", "1e9"])
def test_invalid_durations_are_refused(tmp_path, capsys, seconds):
    words = ["demo", "--living", "--headless", "--picture", str(tmp_path / "x.png"), "--seconds", seconds]
    assert main(words) == 2
    assert "--seconds is between" in capsys.readouterr().err


def test_the_choices_of_stranger_are_the_mechanisms():
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    (option,) = (action for action in parser._actions if action.dest == "stranger")
    assert sorted(option.choices) == sorted(MECHANISMS)


def test_headless_sliders_drive_all_coordinates_and_write_a_picture(tmp_path, capsys):
    path = tmp_path / "picture.png"
    assert main(["demo", "--sliders", "--headless", "--picture", str(path)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "45 DoF driven" in out
    assert "0 limits violated" in out
    assert path.read_bytes().startswith(b"\x89PNG")


def test_outside_a_checkout_there_is_no_kitchen_in_motion(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("kineverse.cli.demo_living._find_example", lambda: False)
    assert main(["demo", "--living", "--headless", "--picture", str(tmp_path / "x.png")]) == 2
    assert "source checkout" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--living", "--robot", "hsr"], "--robot is for the robot, not for --living"),
        (["--sliders", "--json"], "--json is for the robot, not for --sliders"),
        (["--stranger", "stool"], "--stranger is for --living"),
        (["--sliders", "--seconds", "3"], "--seconds is for --living"),
    ],
)
def test_options_of_another_demo_are_refused(words, message, capsys):
    assert main(["demo", "--headless", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("in_checkout", [True, False])
def test_the_example_is_found_beside_the_sources_only(tmp_path, monkeypatch, in_checkout):
    example = tmp_path / "examples" / "living_kitchen" / "__init__.py"
    if in_checkout:
        example.parent.mkdir(parents=True)
        example.touch()
    monkeypatch.setattr("kineverse.__file__", str(tmp_path / "src" / "kineverse" / "__init__.py"))
    monkeypatch.setattr(sys, "path", [])
    assert _find_example() is in_checkout
    assert sys.path == [str(tmp_path / "examples")] * in_checkout


@pytest.mark.long
def test_headless_demo_needs_the_core_only_and_prints_tables(tmp_path):
    """Numbers of longer simulations are those of ``tests/view/test_living_kitchen.py``."""
    extras = ("viser", "trimesh", "PIL", "scipy", "collada")
    code = (
        f"import sys\nfor name in {extras!r}: sys.modules[name] = None\n"
        f"from kineverse.cli import main\n"
        f"from kineverse.view import pictures\n"
        f"pictures.SAMPLES = 1\n"
        f"words = ['--living', '--headless', '--stranger', 'stool', '--seconds', '1']\n"
        f"sys.exit(main(['demo', *words, '--picture', {str(tmp_path / 'core.png')!r}]))"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for label in ("markers are off by", "the track is off by"):
        assert re.search(rf"^{label} +\d+ mm$", done.stdout, flags=re.MULTILINE)
    assert re.search(r"^the stranger, learned +stool$", done.stdout, flags=re.MULTILINE)
    assert "cannot tell" in done.stdout
    assert (tmp_path / "core.png").read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_demo_leaves_no_empty_picture(tmp_path, monkeypatch):
    def interrupted(self, dt):
        if dt > 0.0:
            raise KeyboardInterrupt

    monkeypatch.setattr("living_kitchen.Simulation.step", interrupted)
    with contextlib.suppress(KeyboardInterrupt):
        assert main(["demo", "--living", "--headless", "--picture", str(tmp_path / "x.png")]) != 0
    assert not list(tmp_path.iterdir())


def test_an_unwritable_picture_is_reported_in_one_line(tmp_path, capsys):
    assert main(["demo", "--living", "--headless", "--picture", str(tmp_path / "none" / "x.png")]) == 2
    err = capsys.readouterr().err
    assert err.endswith("No such file or directory\n")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("words", [[], ["--living"], ["--sliders"]])
def test_pictures_of_other_formats_are_refused(tmp_path, capsys, words):
    path = tmp_path / "x.jpg"
    assert main(["demo", "--headless", "--picture", str(path), *words]) == 2
    err = capsys.readouterr().err
    assert "written as .png, not .jpg" in err
    assert len(err.splitlines()) == 1
    assert not path.exists()


def test_exercise_model_reports_problems_of_a_model():
    a, b = kv.position("a"), kv.position("b")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("lid", parent="world", transform=kv.rotation_x(a))
        edit.add_frame("rod", parent="world", transform=kv.translation(0, 0, np.sqrt(b)))
        edit.constrain("a/range", 0, a, 1)
        edit.constrain("a/really", -1, 2 * a, 1)
        edit.constrain("b/range", -1, b, 1)
    result = exercise_model(model)
    assert result.freedoms == 2
    assert result.poses == 2 * 2 * SAMPLES_PER_RANGE
    assert result.violations == 1
    assert any("a/really" in line for line in result.problems)
    assert any(line.startswith("b: 1 frames have no rigid pose, such as rod") for line in result.problems)


def test_exercise_model_accepts_an_empty_model():
    result = exercise_model(kv.Model())
    assert (result.freedoms, result.poses, result.problems) == (0, 0, [])
