"""The experiment ``lockbox``: its jobs, its exhaustive search, and a run of few boxes."""

import json

import pytest

import kineverse as kv
from kineverse.gallery.lockboxes import THESIS, Condition, Lockbox, Slider, draw_tangled_lockbox, make_rings
from kineverse_studies.experiments import Options
from kineverse_studies.experiments.lockbox import (
    ExplorerJob,
    PlannerJob,
    list_explorer_jobs,
    list_planner_jobs,
    make_lockbox_report,
    record_thesis_box,
    run_explorer,
    run_planner,
)
from kineverse_studies.experiments.lockbox.unknown_locks import (
    can_be_opened,
    count_systematic_tries,
    list_unknown_jobs,
    run_unknown,
)
from kineverse_studies.experiments.lockbox.unlocking_runs import LOCK_RULES, run_unlocking


def test_jobs_are_those_of_the_documentation():
    jobs = list_explorer_jobs(1000, 5, False)
    plain = [job for job in jobs[:1000] if job.rule == "and" and not job.negated]
    assert len(plain) == 1000
    assert {job.parts for job in plain} == set(range(5, 101))
    assert len({job.seed for job in plain}) == 1000
    assert len([job for job in jobs if job.rule == "and" and job.negated]) == 500
    plans = list_planner_jobs(1000, 0, False)
    assert sum(job.kind == "tangled" and 2 <= job.parts <= 7 for job in plans) == 10_000
    assert max(job.parts for job in plans if job.kind == "rings") == 12
    assert Options().count is None


def test_exhaustive_search_of_known_boxes():
    assert can_be_opened(THESIS)
    assert can_be_opened(make_rings(4))
    circle = {"a": Slider(groups=((Condition("b", 0.5),),)), "b": Slider(groups=((Condition("a", 0.5),),))}
    assert not can_be_opened(Lockbox(circle, {"a": 1.0}))
    assert can_be_opened(Lockbox({**circle, "b": Slider()}, {"a": 1.0}))


def test_report_of_few_boxes():
    explored = [
        one
        for rule in LOCK_RULES
        for one in run_explorer(ExplorerJob(6, 2, 0.25 if rule == "undemanded" else 0.0, rule))
    ]
    planned = [
        one
        for job in (
            PlannerJob("monotone", 5, 0),
            PlannerJob("negated", 5, 0),
            PlannerJob("tangled", 4, 1),
            PlannerJob("rings", 3, 0),
        )
        for one in run_planner(job)
    ]
    assert not any(one.wrong for one in planned)
    thesis = {rule: run_unlocking(THESIS, rule, 160) for rule in LOCK_RULES}
    unknown = [one for job in list_unknown_jobs(1, 3) for one in run_unknown(job)]
    report = make_lockbox_report(thesis, explored, planned, unknown, 0)
    opened = {row["rule"]: (row["opened"], row["of"]) for row in report.numbers["explorer"]}
    assert opened["and"] == (1, 1)
    assert opened["none"] == (0, 1)
    assert report.numbers["thesis"]["and"]["done"]
    assert not report.numbers["thesis"]["none"]["done"]
    assert [row["wrong"] for row in report.numbers["planner"]] == [[], [], [], []]
    json.dumps(report.numbers, allow_nan=False)
    assert [len(table.rows) for table in report.tables] == [4, 4, 4, 4]
    for one in report.numbers["unknown locks"]:
        assert one["tries"] <= one["depth"]


def test_jobs_of_unknown_locks_are_those_of_the_documentation():
    assert len(list_unknown_jobs(1000, 0)) == 400
    assert {job.seed for job in list_unknown_jobs(30, 7)} == {7, 8, 9}


def test_systematic_search_finds_exactly_the_boxes_that_can_be_opened():
    """Both orders are complete: their numbers of tries are finite if and only if there is a solution."""
    found = 0
    for seed in range(40):
        box = draw_tangled_lockbox(4, seed)
        for order in ("depth", "breadth"):
            assert (count_systematic_tries(box, order) is not None) == can_be_opened(box), seed
        found += can_be_opened(box)
    assert 5 < found < 40


@pytest.mark.long
def test_thesis_box_is_recorded_in_three_ways(tmp_path):
    record_thesis_box(tmp_path / "runs")
    for name in ("trends", "plan", "unknown-locks"):
        run = kv.worlds.read_run_recording(tmp_path / "runs" / f"thesis-{name}.mcap")
        assert run.outcome["done"], name
        assert run.states.at(run.duration)[kv.position("a")] == pytest.approx(1.2, abs=0.01)
        assert len(run.commands.times) == len(run.times)
