"""The program of the living kitchen: its options, its tables, and mistakes."""

import contextlib
import re
import subprocess
import sys

import pytest

from markdown_examples import ROOT

PROGRAM = ROOT / "examples" / "living_kitchen" / "__main__.py"


@pytest.fixture(scope="module")
def program():
    path = list(sys.path)
    try:
        yield __import__("living_kitchen.__main__", fromlist=["main"]).main
    finally:
        sys.path[:] = path


@pytest.mark.parametrize("seconds", ["0", "nan", "1e9"])
def test_invalid_durations_are_refused(program, tmp_path, capsys, seconds):
    assert program(["--headless", "--picture", str(tmp_path / "x.png"), "--seconds", seconds]) == 2
    assert "--seconds is between" in capsys.readouterr().err


@pytest.mark.long
def test_without_a_page_it_needs_the_core_only_and_prints_tables(tmp_path):
    """Numbers of longer simulations are those of ``test_living_kitchen.py``."""
    extras = ("viser", "trimesh", "PIL", "scipy", "collada")
    words = ["--headless", "--stranger", "stool", "--seconds", "1", "--picture", str(tmp_path / "core.png")]
    code = (
        f"import runpy, sys\nfor name in {extras!r}: sys.modules[name] = None\n"
        f"from kineverse.view import pictures\npictures.SAMPLES = 1\n"
        f"sys.argv = ['living_kitchen', *{words!r}]\n"
        f"runpy.run_path({str(PROGRAM)!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", timeout=300, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    for label in ("markers are off by", "the track is off by"):
        assert re.search(rf"^{label} +\d+ mm$", done.stdout, flags=re.MULTILINE)
    assert re.search(r"^the stranger, learned +stool$", done.stdout, flags=re.MULTILINE)
    assert "cannot tell" in done.stdout
    assert (tmp_path / "core.png").read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_run_leaves_no_empty_picture(program, tmp_path, monkeypatch):
    def interrupted(self, dt):
        if dt > 0.0:
            raise KeyboardInterrupt

    monkeypatch.setattr("living_kitchen.simulation.Simulation.step", interrupted)
    with contextlib.suppress(KeyboardInterrupt):
        assert program(["--headless", "--picture", str(tmp_path / "x.png")]) != 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"), [("none/x.png", "No such file or directory"), ("x.jpg", "written as .png, not .jpg")]
)
def test_pictures_that_cannot_be_written_are_reported_in_one_line(program, tmp_path, capsys, name, message):
    assert program(["--headless", "--picture", str(tmp_path / name)]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())
