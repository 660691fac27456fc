"""``kineverse unlock``: steps with reasons, exit status, and what it refuses."""

import json

import pytest

import kineverse as kv
from kineverse.cli.command_line import main

THESIS = ("unlock", "lockboxes/thesis", "--goal", "lockbox/a=1.2")


@pytest.fixture
def circle(tmp_path):
    """Return a file of three sliders that lock each other in a circle, and a lock that cannot be read."""
    model, q = kv.Model(), [kv.position(name) for name in "abcd"]
    with model.edit() as edit:
        for slider in q:
            edit.constrain(f"{slider} range", 0, slider, 1)
        for slider, key in zip(q[:3], (*q[1:3], q[0]), strict=True):
            edit.constrain(f"{slider} lock", -1, slider.derivative(), key > 0.5)
        edit.constrain("d lock", -1, q[3].derivative(), q[0] * q[1] > 0.5)
    path = tmp_path / "circle.kv.json"
    model.save(path)
    return str(path)


def test_unlock_prints_steps_with_reasons(capsys):
    assert main(THESIS) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    assert lines[0] == "1. raise lockbox/f above 1.2: it holds lockbox/e"


def test_unlock_json(capsys):
    assert main([*THESIS, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [step["coordinate"][-1] for step in data["steps"]] == list("fedbca")
    assert data["goal"] == {"lockbox/a": 1.2}


def test_unlock_from_a_state_with_a_unit(capsys):
    words = ["unlock", "articulations/microwave", "--goal", "microwave/oven/door=90deg"]
    assert main(words) == 0
    assert "raise microwave/oven/button above 0.004: it holds microwave/oven/door" in capsys.readouterr().out
    assert main([*words, "--from", "microwave/oven/door=1.0"]) == 0
    assert capsys.readouterr().out == "1. raise microwave/oven/door to 1.5708: it is the goal\n"


def test_unlock_refutes_with_the_circle(capsys, circle):
    assert main(["unlock", circle, "--goal", "a=1"]) == 1
    out = capsys.readouterr().out
    assert out.startswith("a = 1: cannot be reached, since these lock each other in a circle\n")
    assert out.count("cannot increase") == 3


def test_unlock_says_what_it_could_not_read(capsys, circle):
    assert main(["unlock", circle, "--goal", "d=1"]) == 3
    out = capsys.readouterr().out
    assert "treated as shut, since they could not be read:" in out
    assert "d lock: unknown" in out
    assert main(["unlock", circle, "--goal", "d=1", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["verdict"] == "undecided"


def test_unlock_without_what_is_stuck(capsys):
    assert main([*THESIS, "--still", "lockbox/f"]) == 1
    assert "cannot be reached without lockbox/f" in capsys.readouterr().out


def test_unlock_execute_moves_the_parts_and_records_them(capsys, tmp_path):
    path = tmp_path / "run.mcap"
    assert main([*THESIS, "--execute", "--record", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "1. lockbox/f moved to 1.25 in 3.5 s: it holds lockbox/e"
    assert lines[6:] == ["the goal is reached"]
    run = kv.worlds.read_run_recording(path)
    assert run.phases.entries[:2] == ("raise lockbox/f", "raise lockbox/e")
    assert run.outcome["done"]
    assert run.states.at(run.duration)[kv.position("lockbox/a")] == pytest.approx(1.2, abs=2e-4)


def test_unlock_execute_with_a_jammed_part(capsys):
    assert main([*THESIS, "--execute", "--jam", "lockbox/e", "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert data["stuck"] == ["lockbox/e"]
    assert not data["done"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--goal", "lockbox/a"], "write NAME=VALUE"),
        (["--goal", "lockbox/x=1"], "'lockbox/x' is no degree of freedom"),
        (["--goal", "lockbox/a=2"], "beyond its limits [0, 1.2]"),
        (["--goal", "lockbox/a=1", "--from", "lockbox/x=1"], "lockbox/x"),
        (["--goal", "lockbox/a=1", "--still", "lockbox/x"], "There is no symbol 'lockbox/x'"),
        (["--goal", "lockbox/a=1", "--budget", "0"], "positive time in seconds"),
        (["--goal", "lockbox/a=1", "--jam", "lockbox/d"], "need --execute"),
        (["--goal", "lockbox/a=1", "--execute", "--jam", "lockbox/x"], "There is no symbol 'lockbox/x'"),
        (["--goal", "lockbox/a=1", "--execute", "--record", "run.txt"], ".mcap"),
        ([], "--goal"),
    ],
)
def test_unlock_refuses_bad_input(capsys, words, text):
    assert main(["unlock", "lockboxes/thesis", *words]) == 2
    assert text in capsys.readouterr().err
