from __future__ import annotations

import json

import pytest

from kineverse import bench
from kineverse.bench import BENCHMARKS, Bar, Comparison, Measurement, Result
from kineverse.cli import main
from kineverse.cli.bench import as_text, quantity


@pytest.fixture
def run(capsys):
    """Run the command in this process: status, standard output, standard error."""

    def call(*words):
        status = main(["bench", *map(str, words)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.fixture
def asked(monkeypatch, tiny):
    """Have the command measure next to nothing, and note what it was told to."""
    heard = []

    def few(names, settings):
        heard.append((names, settings))
        return measure(names, tiny)

    measure = bench.measure
    monkeypatch.setattr(bench, "measure", few)
    return heard


def test_the_list_names_all_of_them(run):
    status, out, err = run("--list")
    assert (status, err) == (0, "")
    assert all(name in out and text in out for name, text in BENCHMARKS.items())
    status, out, _ = run("--list", "--json")
    assert json.loads(out) == dict(BENCHMARKS)


def test_an_unknown_name_is_one_line(run):
    status, out, err = run("cal")
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "no benchmark 'cal'. Did you mean 'call'?" in err


def test_json_is_one_object_and_nothing_else(run, asked):
    status, out, err = run("call", "--json")
    assert (status, err) == (0, "")
    answer = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert answer["machine"]["tier"] in ("interpreter", "c", "c extension")
    assert answer["machine"]["compiler"]["vector_unit"]
    assert "pin" in answer["machine"]["versions"]
    (result,) = answer["benchmarks"]
    assert result["name"] == "call"
    assert all(m["unit"] == "s" and m["median"] >= m["best"] > 0 for m in result["measurements"])
    assert {c["status"] for c in result["comparisons"]} <= {"met", "missed", "missing", "no bar"}


def test_words_say_where_and_what(run, asked, without):
    without("mujoco")
    status, out, err = run("frames")
    assert (status, err) == (0, "")
    for word in ("tier", "vector unit", "compiler", "processor", "casadi", "frames: ", "bar", "median"):
        assert word in out
    assert "mujoco is missing: pip install" in out


def test_options_reach_the_measurements(run, asked):
    assert run("import", "--quick", "--robot", "r", "--frame", "f")[0] == 0
    ((names, settings),) = asked
    assert names == ["import"]
    assert (settings.rounds, settings.robot, settings.frame) == (bench.QUICK.rounds, "r", "f")


def test_a_robot_that_does_not_exist_is_one_line(run):
    status, _, err = run("call", "--robot", "no_such_robot")
    assert status == 2
    assert "no_such_robot" in err
    assert len(err.splitlines()) == 1


def test_tables_say_whether_bars_are_met():
    result = Result(
        "game",
        "playing",
        (Measurement("ours", "s", (1e-6,)), Measurement("packages", "packages", (4.0,))),
        (
            Comparison("good", 4.0, "x", Bar(2.0, at_least=True)),
            Comparison("bad", 0.03, "s", Bar(0.02, at_least=False)),
            Comparison("away", None, "x", Bar(2.0, at_least=True)),
            Comparison("so so", 1.5, "x"),
        ),
        ("peer is missing: get it",),
    )
    lines = as_text(result).splitlines()
    assert lines[0] == "game: playing"
    by_name = {line.split("  ")[0]: line.split() for line in lines[1:] if line}
    assert by_name["ours"][1:] == ["1", "µs", "1", "µs"]
    assert by_name["good"][1:] == ["4", "x", ">=", "2", "x", "met"]
    assert by_name["bad"][1:] == ["30", "ms", "<=", "20", "ms", "missed"]
    assert by_name["away"][1:] == ["-", ">=", "2", "x", "missing"]
    assert by_name["so so"][2:] == ["1.5", "x", "-", "no", "bar"]
    assert lines[-1] == "peer is missing: get it"


@pytest.mark.parametrize(
    ("value", "text"),
    [(2.5, "2.5 s"), (1e-3, "1 ms"), (2.5e-6, "2.5 µs"), (45.6e-9, "45.6 ns"), (0.0, "0 ns")],
)
def test_times_are_in_the_unit_that_suits_them(value, text):
    assert quantity(value, "s") == text
