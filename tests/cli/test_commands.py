import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import kineverse as kv

COMMAND = [sys.executable, "-m", "kineverse"]


def python(*words):
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=300, check=False)


def test_help_names_all_commands_and_gives_examples(run):
    status, out, err = run("--help")
    assert (status, err) == (0, "")
    for word in (
        "info",
        "fk",
        "view",
        "convert",
        "diff",
        "validate",
        "live",
        "bench",
        "reproduce",
        "examples",
    ):
        assert word in out
    for command in ("info", "fk", "view", "convert", "diff", "validate", "live", "bench", "reproduce"):
        status, out, _ = run(command, "--help")
        assert status == 0
        assert "examples:" in out


def test_version_option_prints_the_version(run):
    status, out, _ = run("--version")
    assert (status, out) == (0, f"kineverse {kv.__version__}\n")


@pytest.mark.parametrize("words", [["info"], ["fk", "kitchen"], ["view", "kitchen", "--port", "x"]])
def test_unknown_arguments_are_status_2(run, words):
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert "usage: kineverse" in err


def test_info_prints_a_text(run):
    status, out, err = run("info", "kitchen")
    assert (status, err) == (0, "")
    assert "54 frames, 23 DoF, 46 constraints" in out
    assert "kitchen/fridge_door" in out
    assert "rad" in out
    assert "--frames" in out
    status, out, _ = run("info", "kitchen", "--frames", "--constraints")
    assert "kitchen/fridge_door_handle" in out
    assert "<=" in out


def test_info_as_json_is_one_object(run):
    status, out, err = run("info", "pr2", "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    model = kv.load("pr2")
    assert answer["counts"]["frames"] == len(answer["frames"]) == len(model.frames)
    assert [dof["name"] for dof in answer["dof"]] == [str(s) for s in model.degrees_of_freedom]
    assert [c["name"] for c in answer["constraints"]] == list(model.constraints)
    by_name = {dof["name"]: dof for dof in answer["dof"]}
    assert by_name["pr2/torso_lift_joint"]["unit"] == "m"
    assert by_name["pr2/l_elbow_flex_joint"]["unit"] == "rad"
    assert by_name["pr2/l_forearm_roll_joint"]["lower"] is None
    assert by_name["pr2/head_tilt_joint"]["upper"] == pytest.approx(model.limits("pr2/head_tilt_joint")[1])
    assert all(edge > 0.3 for edge in answer["size"]["extent"])
    assert answer["size"]["mass"] > 10


def test_info_lists_interlocks(run):
    status, out, _ = run("info", "articulations/garage_door")
    assert status == 0
    assert (
        "interlocks\n  garage_door/garage/door:velocity stands still: when garage_door/garage/bolt < 0.3"
        in out
    )
    assert "other constraints" not in out, "in words they are said already"
    _, out, _ = run("info", "articulations/garage_door", "--constraints")
    assert out.count("garage_door/garage/lock") > 1
    _, out, _ = run("info", "articulations/microwave", "--json")
    answer = json.loads(out)
    assert answer["interlocks"][0]["held"] == "microwave/oven/door"
    assert answer["undecided"] == []
    _, out, _ = run("info", "kitchen", "--json")
    assert json.loads(out)["interlocks"] == []


@pytest.mark.parametrize("name", kv.shipped_models())
def test_info_of_shipped_models(run, name):
    status, out, err = run("info", name)
    assert (status, err) == (0, "")
    assert "DoF" in out


def test_fk_as_text_and_as_json(run):
    words = ("fk", "kitchen", "kitchen/fridge_door_handle", "--set", "kitchen/fridge_door=30deg")
    status, out, err = run(*words)
    assert (status, err) == (0, "")
    assert "position" in out
    status, out, err = run(*words, "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out)
    expected = kv.load("kitchen").fk("kitchen/fridge_door_handle")({"kitchen/fridge_door": np.pi / 6})
    np.testing.assert_allclose(answer["transform"], expected, atol=1e-12)
    np.testing.assert_allclose(answer["position"], np.asarray(expected)[:3, 3], atol=1e-12)
    assert answer["depends_on"] == {"kitchen/fridge_door": pytest.approx(np.pi / 6)}


def test_fk_relative_to_a_frame(run):
    _, out, _ = run(
        "fk", "kitchen", "kitchen/fridge_door_handle", "--relative-to", "kitchen/fridge", "--json"
    )
    expected = kv.load("kitchen").fk("kitchen/fridge_door_handle", "kitchen/fridge")(
        {"kitchen/fridge_door": 0.0}
    )
    np.testing.assert_allclose(json.loads(out)["transform"], expected, atol=1e-12)


def test_fk_beyond_limits_is_evaluated_with_a_note(run):
    status, out, err = run(
        "fk", "kitchen", "kitchen/fridge_door", "--set", "kitchen/fridge_door=9.9", "--json"
    )
    assert status == 0
    assert json.loads(out)
    assert "beyond its limits [0, 1.571]" in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("assigned", "reason"),
    [
        ("fridge_door=5mm", "'kitchen/fridge_door' is in rad; write 30deg or 0.5, for instance."),
        (
            "sink_left_upper_drawer=10deg",
            "'kitchen/sink_left_upper_drawer' is in m; write 12cm or 0.12, for instance.",
        ),
        ("fridge_door=pi/4", ""),
        ("sink_left_upper_drawer=10cm", ""),
    ],
)
def test_a_unit_of_another_quantity_is_refused(run, assigned, reason):
    status, out, err = run("fk", "kitchen", "kitchen/fridge_door", "--set", f"kitchen/{assigned}")
    if not reason:
        assert (status, err) == (0, "")
    else:
        assert (status, out, err) == (2, "", f"kineverse: --set kitchen/{assigned}: {reason}\n")


@pytest.mark.parametrize(
    "words", [("-v", "info", "shelf_door"), ("info", "shelf_door", "-v"), ("info", "-v", "shelf_door")]
)
def test_verbose_may_stand_before_or_after_the_command(run, words):
    status, out, _ = run(*words)
    assert (status, out.splitlines()[0]) == (0, "shelf_door")


def test_info_counts_one_thing_and_names_missing_meshes(run, tmp_path):
    robot = tmp_path / "r.urdf"
    visual = '<visual><geometry><mesh filename="nowhere.stl"/></geometry></visual>'
    robot.write_text(f'<robot name="r"><link name="arm">{visual}</link></robot>', encoding="utf-8")
    status, out, _ = run("info", str(robot))
    assert status == 0
    assert "  1 frame, 0 DoF, 0 constraints\n" in out
    assert '1 shape, 1 of them not loaded\n  arm: "nowhere.stl": there is no such file.' in out
    assert f"Looked for: {tmp_path / 'nowhere.stl'}\n" in out
    robot.write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="prismatic"><parent link="a"/>'
        '<child link="b"/><limit lower="-0.0" upper="1" velocity="0" effort="1"/></joint></robot>',
        encoding="utf-8",
    )
    status, out, _ = run("info", str(robot), "--constraints")
    assert status == 0
    assert "-0" not in "".join(line for line in out.splitlines() if "r.urdf" not in line)


def test_picture_that_cannot_be_written_is_refused_before_the_work(run, tmp_path):
    for words in (
        ("open", "kitchen", "--robot", "hsr", "--what", "kitchen/fridge_door"),
        ("reach", "fetch", "fetch/gripper_link", "--pose", "0.7", "0.2", "0.9"),
        ("view", "kitchen"),
    ):
        status, out, err = run(*words, "--picture", str(tmp_path / "none" / "x.png"))
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert "No such file" in err


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("info", "kitchn"), "kitchen"),
        (("info", "/nowhere/robot.urdf"), "robot.urdf"),
        (("info", "."), ""),
        (("fk", "kitchen", "kitchen/fridge_dor"), "kitchen/fridge_door"),
        (("fk", "kitchen", "kitchen/fridge_door", "--set", "fridge_door=1"), "kitchen/fridge_door"),
        (("fk", "kitchen", "kitchen/fridge_door", "--set", "kitchen/fridge_door=nan"), "finite"),
        (("fk", "kitchen", "kitchen/fridge_door", "--relative-to", "wrld"), "wrld"),
        (("view", "kitchn"), "kitchen"),
        (("view", "kitchen", "--port", "99999"), "65535"),
        (("view", "kitchen", "--set", "nothing"), "NAME=VALUE"),
    ],
)
def test_errors_are_one_line_with_suggestions_and_status_2(run, words, hint):
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.startswith("kineverse: ")
    assert hint in err
    assert "Traceback" not in err


def test_a_file_without_a_model_is_an_error_of_one_line(run, tmp_path):
    path = tmp_path / "broken.urdf"
    path.write_text("<robot name='x'><link name='a'>")
    status, out, err = run("info", path)
    assert (status, out, len(err.splitlines())) == (2, "", 1)


def test_missing_meshes_are_counted(run, tmp_path):
    path = tmp_path / "box.urdf"
    mesh = "<geometry><mesh filename='package://nowhere/box.stl'/></geometry>"
    path.write_text(f"<robot name='x'><link name='a'><visual>{mesh}</visual></link></robot>")
    status, out, err = run("info", path)
    assert (status, err) == (0, "")
    assert "1 shape, 1 of them not loaded" in out
    _, out, _ = run("info", path, "--json")
    assert json.loads(out)["not_loaded"] == ["a"]


def test_a_closed_pipe_prints_no_error():
    done = subprocess.run(
        f"'{sys.executable}' -m kineverse info shelf_drawers --frames --constraints | head -n 1",
        shell=True,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout == "shelf_drawers\n"
    assert done.stderr == ""


@pytest.mark.parametrize("words", [("info", "kitchen"), ("fk", "kitchen", "kitchen/fridge_door")])
def test_commands_give_equal_results_without_a_compiler(run, request, words):
    expected = run(*words)
    request.getfixturevalue("no_compiler")
    assert run(*words) == expected
    assert (expected[0], expected[2]) == (0, "")


@pytest.mark.usefixtures("no_compiler")
def test_a_missing_compiler_is_reported_only_with_verbose(run, monkeypatch, tmp_path):
    words = ("view", "shelf_door", "--picture", tmp_path / "picture.png")
    # What was not found on one path is logged once, so there are two.
    monkeypatch.setenv("PATH", str(tmp_path / "first"))
    status, _, err = run(*words)
    assert status == 0
    assert "no C compiler" not in err
    monkeypatch.setenv("PATH", str(tmp_path / "second"))
    status, _, err = run("--verbose", *words)
    assert status == 0
    assert "no C compiler" in err


def test_ctrl_c_gives_status_130_and_an_empty_line(monkeypatch, run):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(kv, "load", interrupted)
    assert run("info", "kitchen") == (130, "", "\n")


@pytest.mark.parametrize(
    ("stop", "words"),
    [
        (signal.SIGINT, ["view", "shelf_door", "--port", "0"]),
        pytest.param(signal.SIGTERM, ["view", "shelf_door", "--port", "0"], marks=pytest.mark.long),
    ],
)
def test_pages_end_with_status_0(stop, words, hears_ctrl_c):
    pytest.importorskip("viser")
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")}
    with subprocess.Popen(
        [*COMMAND, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**environment, "PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            assert process.stdout.readline().startswith("http://127.0.0.1:")
            assert "DoF" in process.stdout.readline()
            process.send_signal(stop)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "Traceback" not in err
    assert "viser" not in out + err


def test_fk_accepts_positions_and_refuses_speeds(run):
    words = ("fk", "kitchen", "kitchen/fridge_door", "--set", "kitchen/fridge_door:velocity=1")
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert "'kitchen/fridge_door:velocity' is a speed" in err
    assert "positions only" in err
