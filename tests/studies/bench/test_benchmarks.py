import importlib.util
import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse.cli.arguments import require
from kineverse_studies.bench import BENCHMARKS, DisagreementError, run_benchmarks, select_benchmarks
from kineverse_studies.bench.control_workloads import WORKLOADS
from kineverse_studies.bench.harness import ProgramError, has_peer, run_program
from kineverse_studies.bench.inverse_kinematics import ARMS
from kineverse_studies.bench.models import READERS, count_reruns, make_large_model
from kineverse_studies.commands.bench import benchmark_to_markdown

sys.path.append(str(Path(__file__).parents[3] / "tools"))

from figures.pages import DOCS, find_blocks, find_tables

HAS_PEERS = all(importlib.util.find_spec(name) for name in ("pinocchio", "mujoco"))
# One of those it compares is casadi's map in C.
BATCH = pytest.param("batch", marks=pytest.mark.compiler)


# test_control_bench.py and test_planning_bench.py run these without their long parts.
LONG = ("control", "planning")
SHORT = ("call", "frames", "batch", "edit", "examples")


# Some of their rows are about robots, kitchens and examples that the minimal settings leave out.
PARTS = (
    "geometry",
    "inverse_kinematics",
    "examples",
    "document",
    "edit",
    "motion",
    "identification",
    "learning",
)


def rows_of_markdown(text):
    """Return the first cells of a table, without numbers and the names of files."""
    (table,) = find_tables(text)
    return {
        re.sub(r"[\w.]+\.(urdf|kv\.json)|kitchen \(shipped\)|\d[\d,]*(\s\d+)*", "#", row[0])
        for row in table.rows
    }


def documented_rows(name):
    """Return the rows of a benchmark in docs/benchmarks.md; none of 'examples', which needs other people's robots."""
    blocks = {block.name: block.text for block in find_blocks(DOCS / "benchmarks.md")}
    return rows_of_markdown(blocks[f"bench-{name}"]) if name != "examples" else set()


@pytest.fixture
def programs_run_once(monkeypatch):
    """Have each program run in one fresh process, whose answer is given again at the next sample.

    It is another program with a cache folder that is full.
    """
    answers = {}

    def run_once(*words, cache=None):
        program = (*words, str(cache).endswith("full"))
        if program not in answers:
            answers[program] = run_program(*words, cache=cache)
        return answers[program]

    monkeypatch.setattr("kineverse_studies.bench.processes.run_program", run_once)


@pytest.mark.parametrize(
    "name",
    [
        BATCH if name == "batch" else name if name in SHORT else pytest.param(name, marks=pytest.mark.long)
        for name in BENCHMARKS
        if name not in LONG
    ],
)
@pytest.mark.usefixtures("programs_run_once", "clutter_made_once")
def test_a_benchmark_measures_all_installed_peers_and_its_rows_are_documented(name, tiny, monkeypatch):
    workload = replace(WORKLOADS[tiny.examples[0]], steps=40)
    monkeypatch.setattr("kineverse_studies.bench.examples.WORKLOADS", {tiny.examples[0]: workload})
    arms = {arm: ARMS[arm] for arm in ("ur5", "tiago")}  # one without a base and one with
    monkeypatch.setattr("kineverse_studies.bench.inverse_kinematics.ARMS", arms)
    (result,) = run_benchmarks([name], tiny)
    assert result.name == name
    assert result.work
    names = [m.name for m in result.measurements]
    assert len(names) == len(set(names)) >= 3
    for measurement in result.measurements:
        assert all(math.isfinite(sample) for sample in measurement.samples)
        assert len(measurement.samples) in (1, tiny.rounds, tiny.processes)
    assert result.comparisons
    measured, documented = rows_of_markdown(benchmark_to_markdown(result)), documented_rows(name)
    assert name == "examples" or measured <= documented
    if HAS_PEERS:
        assert name in PARTS or measured == documented
        # Pinocchio has no closed loops, no search for what is near, and no filters.
        others = {"loop": "casadi", "geometry": "mujoco", "tracking": "numpy,", "identification": "scipy"}
        others |= {"examples": "mink", "inverse_kinematics": "pink"}
        others["motion"] = "model.integrate"  # states beside vectors; nobody else has these constraints
        others["exchange"] = "relay"
        others["learning"] = "jaxadi"
        peer = others.get(name, "pinocchio")
        assert any(peer in n or "pin" in n.split() for n in names)
        # There is no wheel of Bullet for every Python, torch takes gigabytes, and ripl-articulation is in no
        # extra of ours.
        assert all(c.value is not None for c in result.comparisons if "bullet" not in c.name)
        assert [line for line in result.missing if not line.startswith(("pybullet", "ripl_", "torch"))] == []


@pytest.mark.parametrize("name", ["call", "frames", BATCH, "edit"])
def test_peers_that_are_not_installed_are_reported(name, tiny, without):
    without("pinocchio", "mujoco")
    (result,) = run_benchmarks([name], tiny)
    missing = [c for c in result.comparisons if c.status == "missing"]
    assert missing
    assert all("pinocchio" in c.name or "mujoco" in c.name for c in missing)
    assert any("studies[peers]' brings it" in line for line in result.missing)
    assert any("'pin'" in line for line in result.missing)
    assert not any("pinocchio" in m.name for m in result.measurements)


def test_a_benchmark_without_its_extra_is_left_out(tiny, without):
    without("coal")
    (result,) = run_benchmarks(["geometry"], tiny)
    assert (result.measurements, result.comparisons) == ((), ())
    (line,) = result.missing
    assert line.startswith("geometry is left out: distances need coal: ")
    assert line.endswith("[geometry]'")


@pytest.mark.usefixtures("no_compiler")
def test_a_benchmark_that_needs_a_compiler_is_left_out_without_one(tiny, monkeypatch):
    def measure(settings):
        require("Planning", {}, compiler=True)

    monkeypatch.setattr("kineverse_studies.bench.planning.measure_planning", measure)
    (result,) = run_benchmarks(["planning"], tiny)
    assert result.measurements == ()
    assert result.missing[0].startswith("planning is left out: Planning needs a C compiler")


@pytest.mark.usefixtures("no_compiler")
def test_a_missing_compiler_is_reported(tiny):
    (result,) = run_benchmarks(["batch"], tiny)
    assert any("no C compiler" in line for line in result.missing)
    assert not any("casadi" in m.name for m in result.measurements)
    assert any("casadi" in c.name for c in result.comparisons if c.status == "missing")
    assert any(m.name == "numpy, same graph" for m in result.measurements)


def test_a_peer_that_computes_something_else_ends_the_benchmark(tiny, monkeypatch):
    pytest.importorskip("pinocchio")
    from kineverse_studies.bench.peers.pinocchio import PinocchioRobot

    right = PinocchioRobot.pose_and_jacobian

    def wrong(self, row):
        pose, jacobian = right(self, row)
        return pose, jacobian + 1e-7

    monkeypatch.setattr(PinocchioRobot, "pose_and_jacobian", wrong)
    with pytest.raises(DisagreementError, match="pinocchio, reduced to the chain"):
        list(run_benchmarks(["call"], tiny))


def test_benchmarks_run_in_their_order_and_once():
    assert select_benchmarks([]) == list(BENCHMARKS)
    assert select_benchmarks(["batch", "load", "batch"]) == ["load", "batch"]


def test_an_unknown_name_is_refused_before_anything_is_run(tiny):
    with pytest.raises(kv.errors.UnknownNameError, match=r"'bacth'\. Did you mean 'batch'\?"):
        next(run_benchmarks(["call", "bacth"], tiny))


def test_run_program_reports_the_last_line_of_a_failure(tmp_path):
    with pytest.raises(ProgramError, match=r"'import_time' ended with status 1.*no_such_module"):
        run_program("import_time", "no_such_module")


def test_large_models_have_the_requested_size():
    model = make_large_model(100)
    assert len(model.constraints) == 100
    assert len(model.history.tags) >= 100
    assert count_reruns(model) == 1 + READERS
    assert model.constraints_for(model.fk("link 15")).keys() >= {f"joint {k}/position" for k in range(8, 16)}


def test_a_joint_is_replaced_in_a_copy(tiny):
    from kineverse_studies.bench.models import replace_joint
    from kineverse_studies.bench.workloads import find_benchmark_robot

    robot = find_benchmark_robot(tiny)
    before, values = robot.model.snapshot(), dict.fromkeys(robot.chain, 0.3)
    contender = replace_joint(robot)
    (moved,) = contender.results()
    assert contender.sample() > 0.0
    assert robot.model.snapshot() == before
    assert 1e-3 < np.abs(moved - robot.model.fk(robot.frame)(values)).max() < 2e-2


def test_the_frame_is_a_gripper_unless_one_is_given(tiny):
    from kineverse_studies.bench.workloads import find_benchmark_robot

    assert find_benchmark_robot(replace(tiny, frame=None)).frame == "left"  # the longest way


def test_mujoco_leaves_no_file_of_warnings(tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    monkeypatch.chdir(tmp_path)
    assert has_peer("mujoco")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[0] = np.nan
    mujoco.mj_step(model, data)
    mujoco.set_mju_user_warning(before)
    assert not list(tmp_path.iterdir())
