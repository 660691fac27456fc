"""``kineverse plan``: paths as text, JSON, files and pictures."""

import importlib.util
import json

import numpy as np
import pytest

import kineverse as kv
from arm_and_box import ARM, SRDF
from kineverse.cli.plan_arguments import FrameTarget, parse_frame_target, parse_request, parse_robot
from kineverse.compilation.toolchain import toolchain
from kineverse.errors import InvalidValueError
from kineverse.planning import Trajectory

needs_planner = pytest.mark.skipif(
    toolchain() is None or importlib.util.find_spec("coal") is None, reason="needs a C compiler and coal"
)
ALL = ["--move", "j0", "j1", "j2"]


@needs_planner
def test_path_is_printed_saved_and_drawn(run, tmp_path):
    words = ["--from", "j0=1", "--to", "j0=-1", *ALL, "--save", tmp_path / "a.json"]
    status, out, err = run("plan", ARM, *words, "--picture", tmp_path / "a.png", "--verbose")
    assert status == 0
    assert out.startswith("j0=-1: found\n  moves      j0, j1, j2\n  points ")
    assert "time [s]" in out
    assert f"trajectory: {tmp_path / 'a.json'}" in out
    assert "picture:" in err
    trajectory = Trajectory.load(tmp_path / "a.json", kv.load(ARM))
    assert np.allclose(trajectory.positions[[0, -1]], [[1, 0, 0], [-1, 0, 0]])
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"


@needs_planner
def test_states_of_an_srdf_and_files_are_starts_and_goals(run, tmp_path):
    (tmp_path / "start.json").write_text('{"positions": {"j0": 1, "j1": 0.1}}')
    words = ["--srdf", SRDF, *ALL, "--json"]
    status, out, _ = run("plan", ARM, "--from", tmp_path / "start.json", "--to", "right", *words)
    answer = json.loads(out)
    assert (status, answer["found"], answer["coordinates"]) == (0, True, ["j0", "j1", "j2"])
    assert np.allclose(answer["points"][0], [1, 0.1, 0])
    assert answer["positions"] == pytest.approx({"j0": -1, "j1": 0.1, "j2": 0})
    assert answer["times"][0] == 0
    assert len(answer["times"]) == len(answer["points"])
    assert answer["clearance"] > 0


@needs_planner
def test_frames_are_brought_to_each_other_and_held(run):
    words = ["--from", "tip@knob:xy", "hinge=0", "--along", "tip@knob:xy", "--to", "hinge=0.5", "--json"]
    status, out, _ = run("plan", ARM, *words)
    answer = json.loads(out)
    assert (status, answer["found"]) == (0, True), answer["why"]
    assert set(answer["coordinates"]) == {"j0", "j1", "j2", "hinge"}
    model = kv.load(ARM)
    state = model.default_state().updated(answer["positions"])
    assert np.allclose(model.fk("tip")(state)[:2, 3], model.fk("knob")(state)[:2, 3], atol=1e-6)
    assert answer["positions"]["hinge"] == pytest.approx(0.5)


@needs_planner
def test_no_path_ends_with_status_1_and_the_reason(run):
    status, out, _ = run("plan", ARM, "--from", "j0=1", "--to", "j0=4", *ALL, "--json")
    answer = json.loads(out)
    assert (status, answer["found"], answer["times"]) == (1, False, None)
    assert "its range is -3 to 3" in answer["why"]
    status, out, _ = run("plan", ARM, "--to", "j0=4")
    assert (status, out.splitlines()[1].split()[:2]) == (1, ["moves", "j0;"])
    status, _, err = run("plan", "--to", "j0=1", str(ARM))
    assert (status, "MODEL comes first" in err) == (2, True)


@pytest.mark.compiler  # without one, the command refuses earlier
def test_without_a_compiler_it_says_what_works(run, monkeypatch):
    from kineverse.compilation.c_library import SourceLibrary

    monkeypatch.setattr(SourceLibrary, "prepare", lambda *_, **__: False)
    status, out, err = run("plan", ARM, "--to", "j0=1")
    assert (status, out) == (2, "")
    assert "kineverse reach" in err
    assert "controllers work without it" in err


@pytest.mark.parametrize(
    ("word", "wanted"),
    [
        ("a@b", FrameTarget("a", "b", (), "xyz rx ry rz")),
        ("a@b:xyz,rx", FrameTarget("a", "b", (), "xyz rx")),
        ("a@1,2cm,-3", FrameTarget("a", "world", (1.0, 0.02, -3.0), "xyz")),
        ("a@0,0,0,90deg,0,0", FrameTarget("a", "world", (0, 0, 0, np.pi / 2, 0, 0), "xyz rx ry rz")),
        ("a@b+1,0,0", FrameTarget("a", "b", (1.0, 0, 0), "xyz rx ry rz")),
        ("a@b+1,0,0:z", FrameTarget("a", "b", (1.0, 0, 0), "z")),
    ],
)
def test_targets_are_parsed(word, wanted):
    assert parse_frame_target(word, "--to") == wanted


@pytest.mark.parametrize("word", ["a@", "@b", "a@1,2", "a@b+", "a@b+1", "a@1,2,x", "a@b+1,2,nan"])
def test_wrong_targets_are_refused(word):
    with pytest.raises(InvalidValueError):
        parse_frame_target(word, "--to")


def test_requests_and_robots_are_parsed():
    request = parse_request(["a=30deg", "b@c", "ready"], "--to")
    assert request.values == pytest.approx({"a": np.pi / 6})
    assert [t.target for t in request.targets] == ["c"]
    request.resolve({"ready": {"a": 1.0, "d": 2.0}}, "--to")
    assert request.values == pytest.approx({"a": np.pi / 6, "d": 2.0})
    assert parse_robot("fetch") == ("fetch", None)
    assert parse_robot("fetch@1,-2cm,90deg") == ("fetch", (1.0, -0.02, np.pi / 2))
    assert parse_robot("arm.urdf@1,2,.5,0") == ("arm.urdf", (1.0, 2.0, 0.5, 0.0))
    with pytest.raises(InvalidValueError, match="X,Y,ANGLE"):
        parse_robot("fetch@1,2")


@needs_planner
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--to", "j9=1"], "j0, j1, j2"),
        (["--to", "right"], "need --srdf"),
        (["--to", "righ", "--srdf", str(SRDF)], "Did you mean 'right'"),
        (["--to", "tip@nob"], "knob"),
        (["--to", "tp@knob"], "'tip'"),
        (["--to", "tip@knob:q"], "mask="),
        (["--to", "j0=x"], "'x' is not a value"),
        (["--to", "j0=1", "--seconds", "0"], "--seconds is a positive number"),
        (["--to", "j0=1", "--margin", "-1cm"], "The margin"),
        (["--to", "j0=1", "--move", "j1"], "which --move does not list"),
        (["--to", "j0=1", "--picture", "a.jpg"], "written as .png"),
        (["--to", "j0=1", "--leave-out", "bax"], "Did you mean 'box'"),
        (["--to", "j0=1", "--save", "a.csv"], "written as .json"),
        (["--to", "j0=1", "--from", "none.json"], "none.json"),
        (["--to", "j0=1", "--from", "wrong.json"], "object of numbers"),
        (["--to", "tip@knob+1,0,0", "--along", "tip@knob+1,0,0"], "given there, with --from"),
    ],
)
def test_mistakes_are_reported_in_one_line(run, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.json").write_text("[1]")
    status, out, err = run("plan", ARM, *words)
    assert (status, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1
