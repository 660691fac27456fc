"""Each example runs and prints what it is about; the list of the examples names them all."""

from __future__ import annotations

import ast
import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.formats.locate import locate_model
from kineverse_studies.bench.examples import EXAMPLES
from markdown_examples import ROOT, agree

FOLDER = ROOT / "examples"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
PUBLISHED = [s for library in ("pink", "mink") for s in sorted((FOLDER / f"from_{library}").glob("*.py"))]
LARGE = ("biped_cassie", "humanoid_g1_teleop")
"""Examples that take seconds to build; ``kineverse bench examples`` runs them."""
SLOW = ("humanoid_g1_com", "flying_dual_arm_ur3")
"""Examples that take more than a second each."""
CONTROL = [
    pytest.param(script, marks=pytest.mark.long) if script.stem in SLOW else script
    for script in PUBLISHED
    if script.stem not in LARGE
]

EXPECTED = {
    "01_load_and_view": "54 frames, 23 DoF, 46 constraints (version 1)\n...",
    "02_forward_kinematics_and_jacobians": "7 joints ...\nJacobian (6, 7)\nequal to finite differences: True",
    "03_a_joint_of_your_own": "...['garage/lock', 'garage/range']\ngarage/bolt:velocity 1.0\ngarage/door:velocity -1.0",
    "04_constraints_and_violations": "...2 violated\n...1 violated\n  clearance: ...\nState({a: 0.2, b: 0.8})",
    "05_edit_a_running_model": "changed: (...'frames/door')\nThe edit is refused, ...\n[0.4 0. 0. ] [0.4 1. 0. ]\n... version 2",
    "06_compile_and_batch": "... 11 inputs\n...(100000, 4, 4) (100000, 6, 11) in ... s\nTrue",
    "07_closed_loop": "(crank,)\n...1 violated\n  rocker/position: ...",
    "08_tendon_finger": "(finger/tendon,)\n...1 violated\n  finger/joint_1/position: ...",
    "09_rocker_switch": """-0.2 stable off
0.0 unstable off
0.2 stable on
released at -0.05: rests at -0.200, on: 0
released at 0.05: rests at 0.200, on: 1""",
    "10_ironing_board": """(slider,)
notch at 0.35 m: height 1.043 m, level: True
notch at 0.5 m: height 0.980 m, level: True
notch at 0.65 m: height 0.887 m, level: True
notch at 0.8 m: height 0.755 m, level: True
[-0.51] m of height per m of the slider""",
    "11_locks_and_interlocks": "...order: ['safe/key', 'safe/bolt', 'safe/door']\n1 violated\n  safe/bolt_lock: ...",
    "12_collision_distances": "kitchen/fridge_area and kitchen/fridge_door: ...\nkitchen/fridge_door:velocity ... m/rad",
    "13_identify_a_joint": "revolute with probability ...\naxis [0. 0. 1.] through [0.3 0. ]\nrevolute (door,)",
    "14_track_a_state": "...kitchen/fridge_door: 0.90 ± ...\nkitchen/oven_left_drawer: 0.20 ± ...",
    "15_convert_formats": "...True\ndiffers in ('bodies/handle',)\n...\nchanged: (...'frames/handle')",
    "16_mobile_base": "...{'base/angle': 0.8, 'base/x': 0.897, 'base/y': 0.379}",
    "17_operation_of_your_own": "[0.4 0. 0. ] [0.5 0. 0. ]\n['handle'] ['handle']",
    "18_reach": "pr2/r_gripper_tool_frame reaches 1.19 m far, ...",
    "19_open_a_door": "pr2 moves 12 joints, ...\nopen by 1.39 rad, ..., none violated",
    "20_plan_a_motion": "8 joints, ... points, ... s\nnothing is nearer than ... mm",
    "23_learn_a_hinge": "... mm between ...\nx = 301 mm, in truth 300 mm\ny = -201 mm, ...\nroll = 1.5°, in truth 1.5°\npitch = -2.0°, ...",
    "21_live_system": "...joint door is revolute\n...the door is open by 1.2 rad...",
    "22_calibrate": "Calibration of 13 parameters from 30 looks\n...in look 7\n...7 lines of the URDF are new",
    "24_check_a_model": "door: degrees_for_radians: ...\ndrawer: flipped_axis: ...\nmended: nothing is wrong",
}

NEEDED = {
    "12_collision_distances": ("coal",),
    "18_reach": ("matplotlib",),
    "19_open_a_door": ("daqp",),
    "20_plan_a_motion": ("coal",),
    "21_live_system": ("zenoh", "daqp", "coal"),
    "23_learn_a_hinge": ("jax",),
    "24_check_a_model": ("coal",),
}
"""The modules that examples need beyond the core."""

PICTURES = {
    "01_load_and_view": "kitchen.png",
    "18_reach": "reach.png",
    "19_open_a_door": "open.png",
    "20_plan_a_motion": "plan.png",
    "21_live_system": "live.png",
}

AS_PROGRAMS = ("03_a_joint_of_your_own", "21_live_system")
"""Examples that have processes of their own; the others run here, where modules and models are loaded already."""

TIMEOUT = 300
"""The longest that an example may take [s]; the slowest takes ten."""


@pytest.fixture
def here(tmp_path, monkeypatch, capsys):
    """Run a program in a folder of its own, but in this process, and return what it prints."""

    def run(program, *words):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(program), *words])
        monkeypatch.setattr(sys, "path", [*sys.path])
        try:
            runpy.run_path(str(program), run_name="__main__")
            status = None
        except SystemExit as end:
            status = end.code
        printed = capsys.readouterr()
        assert (status or 0, printed.err) == (0, "")
        return printed.out

    return run


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_an_example_runs_and_prints_its_result(script, tmp_path, here):
    _skip_without(*NEEDED.get(script.stem, ()))
    if script.stem in AS_PROGRAMS:
        printed = _run(script, "--headless", folder=tmp_path)
    else:
        printed = here(script, "--headless")
    assert agree(EXPECTED[script.stem], printed), printed
    picture = PICTURES.get(script.stem)
    assert picture is None or (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("script", CONTROL, ids=lambda path: path.stem)
def test_an_example_of_another_library_is_controlled(script):
    _skip_without("daqp")
    _skip_without_robots()
    example = runpy.run_path(str(script))
    if "controller" not in example:
        solver, target, hand = (example[name] for name in ("solver", "target", "hand"))
        assert solver.solve(target.values(hand(solver.model.default_state()))).solved
        return
    controller, time, state = (example[name] for name in ("controller", "time", "start"))
    controller.set(time, 2.5)
    errors = []
    for _ in range(10):
        command = controller.step(state)
        errors.append(command.residuals[controller.tasks[0].name])
        state = controller.model.integrate(state, command.speeds, controller.dt)
    assert errors[-1] < 0.99 * errors[0]
    assert not controller.model.violations(state)


def test_an_example_of_another_library_runs_as_a_program(tmp_path):
    _skip_without("daqp")
    _skip_without_robots()
    printed = _run(FOLDER / "from_pink" / "inverse_kinematics_ur10.py", folder=tmp_path)
    assert agree("20 of 20 poses reached\nlargest error: ...", printed), printed


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_not_longer_than_the_original(name):
    (script,) = (script for script in PUBLISHED if script.stem == name)
    lines = script.read_text(encoding="utf-8").splitlines()
    skipped = {
        line
        for node in ast.parse("\n".join(lines)).body
        if isinstance(node, ast.Import | ast.ImportFrom) or node.lineno == 1
        for line in range(node.lineno, (node.end_lineno or 0) + 1)
    }
    code = [line for k, line in enumerate(lines, 1) if k not in skipped and line.strip()]
    assert len([line for line in code if not line.strip().startswith("#")]) <= EXAMPLES[name].lines


def test_the_living_kitchen_runs_as_a_program(tmp_path, here):
    printed = here(FOLDER / "living_kitchen", "--headless", "--seconds", "1", "--picture", "end.png")
    assert agree("the kitchen, tracked 23 DoF\n...picture: end.png", printed), printed
    assert (tmp_path / "end.png").exists()


def test_examples_are_numbered_from_one_without_gaps():
    assert [int(script.stem[:2]) for script in SCRIPTS] == list(range(1, len(SCRIPTS) + 1))


def test_the_list_of_examples_names_each_once():
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| \[(\S+)\]\((\S+)\) \|", text, re.MULTILINE)
    published = [script.relative_to(FOLDER).as_posix() for script in PUBLISHED]
    listed = [
        (name, target) for name, target in listed if not name.startswith("notebooks/")
    ]  # test_notebooks
    assert [name for name, _ in listed] == [
        *(script.name for script in SCRIPTS),
        "living_kitchen",
        *published,
    ]
    assert all(name == target for name, target in listed)


def _skip_without(*modules: str) -> None:
    for module in modules:
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"there is no {module}")


def _skip_without_robots() -> None:
    try:
        locate_model("ur_description/urdf/ur5_robot.urdf")
    except kv.KineverseError:
        pytest.skip("there is no example-robot-data")


def _run(program: Path, *words: str, folder: Path) -> str:
    """Run a program in a folder, with warnings as errors, and return what it prints."""
    command = [sys.executable, "-X", "utf8", "-W", "error", str(program), *words]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, encoding="utf-8", check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout
