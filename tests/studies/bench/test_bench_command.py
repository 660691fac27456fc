import json
import subprocess
import sys

import pytest

from kineverse.cli import main
from kineverse_studies import bench
from kineverse_studies.bench import BENCHMARKS, Bar, BenchmarkResult, Comparison, Measurement
from kineverse_studies.commands.bench import format_benchmark, format_quantity


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
    """Run the command with minimal settings, and return its calls of ``run_benchmarks``."""
    calls = []

    def few(names, settings):
        calls.append((names, settings))
        return measure(names, tiny)

    measure = bench.run_benchmarks
    monkeypatch.setattr(bench, "run_benchmarks", few)
    return calls


def test_list_names_all_benchmarks(run):
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


def test_output_names_the_machine_and_the_benchmarks(run, asked):
    status, out, err = run("frames")
    assert (status, err) == (0, "")
    for word in ("tier", "vector unit", "compiler", "processor", "casadi", "frames: ", "median"):
        assert word in out
    for word in ("bar", "target", "missed"):
        assert word not in out


@pytest.mark.long
def test_missing_peers_are_named_once_at_the_end(run, asked, without):
    without("mujoco", "pinocchio", "coal", "pybullet")
    status, out, err = run("frames", "geometry", "edit")
    assert (status, err) == (0, "")
    _, _, end = out.partition("not measured here:\n")
    lines = end.splitlines()
    assert [line.split()[0] for line in lines] == ["pinocchio", "mujoco", "geometry"]
    assert all("install -e '" in line for line in lines)
    assert "geometry: " not in out
    assert "edit: " in out


def test_options_reach_the_measurements(run, asked):
    assert run("frames", "--quick", "--robot", "r", "--frame", "f")[0] == 0
    ((names, settings),) = asked
    assert names == ["frames"]
    assert (settings.rounds, settings.robot, settings.frame) == (bench.QUICK.rounds, "r", "f")


def test_a_robot_that_does_not_exist_is_one_line(run):
    status, _, err = run("call", "--robot", "no_such_robot")
    assert status == 2
    assert "no_such_robot" in err
    assert len(err.splitlines()) == 1


RESULT = BenchmarkResult(
    "game",
    "playing",
    (Measurement("ours", "s", (1e-6,)), Measurement("packages", "packages", (4.0,))),
    (
        Comparison("good, beside peer", 4.0, "x", Bar(2.0, at_least=True), "good", "peer"),
        Comparison("bad", 0.03, "s", Bar(0.02, at_least=False)),
        Comparison("away, beside nobody", None, "x", Bar(2.0, at_least=True), "away", "nobody"),
        Comparison("so so, beside peer", 15432.1, "x", None, "so so", "peer"),
        Comparison("much over little", 1.25, "x", Bar(2.0, at_least=False)),
    ),
    ("peer is missing: get it",),
)


def test_tables_have_ratios_of_times():
    assert format_benchmark(RESULT) == (
        "game: playing\n"
        "              median        best\n"
        "--------  ----------  ----------\n"
        "ours            1 µs        1 µs\n"
        "packages  4 packages  4 packages\n"
        "\n"
        "times as fast  is     as\n"
        "-------------  -----  ----\n"
        "            4  good   peer\n"
        "        15432  so so  peer\n"
        "\n"
        "times as long\n"
        "-------------  ----------------\n"
        "         1.25  much over little"
    )


def test_tables_of_targets_say_whether_they_are_met():
    lines = format_benchmark(RESULT, targets=True).partition("target ")[2].splitlines()
    assert {line.partition("  ")[0]: line.partition("  ")[2].split() for line in lines[2:]} == {
        "good, beside peer": ["4", "x", ">=", "2", "x", "met"],
        "bad": ["30", "ms", "<=", "20", "ms", "missed"],
        "away, beside nobody": ["-", ">=", "2", "x", "missing"],
        "much over little": ["1.25", "x", "<=", "2", "x", "met"],
    }


def test_targets_are_printed_on_request(run, asked):
    status, out, _ = run("call", "--targets")
    assert status == 0
    assert "target " in out
    assert ">= 8 x" in out


@pytest.mark.long
def test_bullet_prints_no_greeting():
    pytest.importorskip("pybullet")
    program = "from kineverse_studies.bench.harness import has_peer; assert has_peer('pybullet')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == done.stderr == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [(2.5, "2.5 s"), (1e-3, "1 ms"), (2.5e-6, "2.5 µs"), (45.6e-9, "45.6 ns"), (0.0, "0 ns")],
)
def test_format_quantity_scales_times(value, text):
    assert format_quantity(value, "s") == text
