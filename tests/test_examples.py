"""Each example runs as a program and prints what it is about; the list of the examples names them all."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from markdown_examples import ROOT, agree

FOLDER = ROOT / "examples"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))

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
    "15_convert_formats": "...True\ndiffers in ('bodies/handle',)\nchanged: (...'frames/handle')",
    "16_mobile_base": "...{'base/angle': 0.8, 'base/x': 0.897, 'base/y': 0.379}",
    "17_operation_of_your_own": "[0.4 0. 0. ] [0.5 0. 0. ]\n['handle'] ['handle']",
    "18_reach": "pr2/r_gripper_tool_frame reaches 1.19 m far, ...",
    "19_open_a_door": "pr2 moves 12 joints, ...\nopen by 1.39 rad, ..., none violated",
}

NEEDED = {"12_collision_distances": "coal", "18_reach": "matplotlib", "19_open_a_door": "daqp"}
"""The modules that examples need beyond the core."""

PICTURES = {"01_load_and_view": "kitchen.png", "18_reach": "reach.png", "19_open_a_door": "open.png"}

TIMEOUT = 300
"""The longest that an example may take [s]; the slowest takes three."""


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_an_example_runs_and_prints_its_result(script, tmp_path):
    _skip_without(NEEDED.get(script.stem))
    printed = _run(script, "--headless", folder=tmp_path)
    assert agree(EXPECTED[script.stem], printed), printed
    picture = PICTURES.get(script.stem)
    assert picture is None or (tmp_path / picture).read_bytes().startswith(b"\x89PNG")


def test_the_living_kitchen_runs_as_a_program(tmp_path):
    words = ["--headless", "--seconds", "1", "--picture", "end.png"]
    printed = _run(FOLDER / "living_kitchen", *words, folder=tmp_path)
    assert agree("the kitchen, tracked 23 DoF\n...picture: end.png", printed), printed
    assert (tmp_path / "end.png").exists()


def test_examples_are_numbered_from_one_without_gaps():
    assert [int(script.stem[:2]) for script in SCRIPTS] == list(range(1, len(SCRIPTS) + 1))


def test_the_list_of_examples_names_each_once():
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| \[(\S+)\]\((\S+)\) \|", text, re.MULTILINE)
    assert [name for name, _ in listed] == [*(script.name for script in SCRIPTS), "living_kitchen"]
    assert all(name == target for name, target in listed)


def _skip_without(module: str | None) -> None:
    if module is not None and importlib.util.find_spec(module) is None:
        pytest.skip(f"there is no {module}")


def _run(program: Path, *words: str, folder: Path) -> str:
    """Run a program in a folder, with warnings as errors, and return what it prints."""
    command = [sys.executable, "-X", "utf8", "-W", "error", str(program), *words]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, encoding="utf-8", check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout
