"""Suggestions for mistyped names, missing prefixes, missing units and missing commands."""

import subprocess
import sys

import pytest

HANDLE = ("fk", "kitchen", "kitchen/fridge_door_handle")


@pytest.mark.parametrize("words", [(), ("-v",)])
def test_without_a_command_the_help_is_printed(run, words):
    status, out, err = run(*words)
    assert (status, err) == (0, "")
    assert out == run("--help")[1]
    assert "kineverse info kitchen" in out


def test_python_m_kineverse_is_the_command():
    said = subprocess.run([sys.executable, "-m", "kineverse"], capture_output=True, text=True, check=True)
    assert said.stdout.startswith("usage: kineverse ")
    assert said.stderr == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("inof", "kitchen"),
            "There is no command 'inof'. Did you mean 'info'? 'kineverse --help' says what each does.",
        ),
        (
            ("kitchen",),
            "There is no command 'kitchen'. It is a model or file: 'kineverse info kitchen' says what it "
            "consists of.",
        ),
        (("info", "kitchen", "--jsno"), "kineverse info has no option '--jsno'. Did you mean '--json'?"),
        (
            ("fk", "kitchen", "world", "--sset=a"),
            "kineverse fk has no option '--sset'. Did you mean '--set'?",
        ),
        (
            ("info", "kitchen", "pr2"),
            "kineverse info takes no argument 'pr2'. 'kineverse info --help' lists those that it takes.",
        ),
        (
            ("info", "r.urdf.xacro", "side:=left"),
            "kineverse info takes the arguments of a template with its path, in quotes: "
            "'robot.urdf.xacro side:=left'.",
        ),
        (
            ("fk", "kitchen", "fridge_door_handle"),
            "There is no frame 'fridge_door_handle'. Did you mean 'kitchen/fridge_door_handle' or "
            "'kitchen/oven_door_handle' or 'kitchen/fridge_lower_drawer_handle'?",
        ),
        (
            (*HANDLE, "--set", "fridge_door=1"),
            "The model has no symbol 'fridge_door'. Did you mean 'kitchen/fridge_door'?",
        ),
    ],
)
def test_an_error_suggests_the_intended_value(run, words, said):
    assert run(*words) == (2, "", f"kineverse: {said}\n")


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        (
            "kitchen/fridge_door=30",
            "kitchen/fridge_door = 30 rad is beyond its limits [0, 1.571]; in degrees it is "
            "--set kitchen/fridge_door=30deg",
        ),
        ("kitchen/fridge_door=300", "kitchen/fridge_door = 300 rad is beyond its limits [0, 1.571]"),
        ("kitchen/fridge_door=95deg", "kitchen/fridge_door = 1.65806 rad is beyond its limits [0, 1.571]"),
        (
            "kitchen/sink_trash_drawer=30",
            "kitchen/sink_trash_drawer = 30 m is beyond its limits [0, 0.48]; in cm it is "
            "--set kitchen/sink_trash_drawer=30cm",
        ),
        (
            "kitchen/sink_trash_drawer=300",
            "kitchen/sink_trash_drawer = 300 m is beyond its limits [0, 0.48]; in mm it is "
            "--set kitchen/sink_trash_drawer=300mm",
        ),
    ],
)
def test_a_missing_unit_is_noted(run, assignment, said):
    status, out, err = run(*HANDLE, "--set", assignment)
    assert status == 0
    assert out
    assert err == f"kineverse: note: {said}\n"


def test_large_values_of_continuous_joints_suggest_degrees(run):
    words = ("fk", "pr2", "pr2/r_gripper_tool_frame", "--set")
    _, _, err = run(*words, "pr2/r_forearm_roll_joint=90")
    assert err == (
        "kineverse: note: pr2/r_forearm_roll_joint = 90 rad is 14.3 turns; in degrees it is "
        "--set pr2/r_forearm_roll_joint=90deg\n"
    )
    for value in ("3", "90rad", "90deg", "20pi"):
        assert run(*words, f"pr2/r_forearm_roll_joint={value}")[2] == ""


def test_view_notes_a_missing_unit(run, tmp_path):
    picture = tmp_path / "kitchen.png"
    _, _, err = run("view", "kitchen", "--set", "kitchen/fridge_door=30", "--picture", picture)
    assert "--set kitchen/fridge_door=30deg" in err
    assert picture.exists()
