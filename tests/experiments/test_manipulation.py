"""Experiments about manipulation: trials and their summary, the papers' programs, locks, set-ups."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from kineverse.cli.reproduce import format_report
from kineverse.errors import InvalidValueError, ModelError, UnknownNameError
from kineverse.experiments import Options, kitchens, reproduce, table1_open, table1_push
from kineverse.experiments.ablations.locks import RULES, THESIS, UPPER, draw_box, unlock
from kineverse.experiments.manipulation import skills
from kineverse.experiments.manipulation.robots import SHIPPED, find_robots
from kineverse.experiments.manipulation.trial_pool import run_jobs
from kineverse.experiments.manipulation.trials import Trial, find_failure, summarize_robots
from kineverse.experiments.table1_open.objects import OBJECTS, make_opening_setup
from kineverse.experiments.table1_open.programs import LeaderFollower, SpeedScale, open_by_program
from kineverse.experiments.table1_push.objects import find_kitchens, make_push_setup
from kineverse.geometry import Rule, Scene
from kineverse.manipulation.outcome import Outcome


def _trial(what, failure="", *, skill="open", placements=0, case="7", cpu=()):
    return Trial(
        case,
        "pr2",
        what,
        skill,
        not failure,
        1.0,
        failure,
        "",
        1.0,
        50,
        tuple(cpu),
        measures={"placements": placements},
    )


@pytest.mark.parametrize(
    ("reason", "failure"),
    [
        ("The elbow touches kitchen/oven_door on the way, after 30 placements.", "collision"),
        ("None of 200 placements reaches the handle.", "reach"),
        ("Out of time at 0.3.", "time"),
        ("An oracle was wrong.", "other"),
    ],
)
def test_find_failure_reads_the_reason_unless_it_is_measured(reason, failure):
    assert find_failure(Outcome(False, 0.0, reason, "kinematic", 1.0, 5)) == failure
    assert find_failure(Outcome(True, 0.0, reason, "kinematic", 1.0, 5)) == ""
    assert find_failure(Outcome(False, 0.0, reason, "kinematic", 1.0, 5, {"failure": "time"})) == "time"


def test_summarize_robots_excuses_a_tenth_that_many_placements_prove():
    done = [_trial(f"a{k}", skill=skill) for k in range(16) for skill in ("open", "close")]
    half = [_trial("b"), _trial("b", "collision", skill="close")]
    far = [_trial(f"c{k}", "reach", placements=200) for k in range(3)]
    (one,) = summarize_robots([*done, *half, *far])
    assert (one.objects, one.done, one.excused) == (20, 16, 2)  # a tenth of 20, not 3
    assert one.rate == pytest.approx(16 / 18)
    (one,) = summarize_robots([*done, _trial("c", "reach", placements=199)])
    assert one.excused == 0


def test_summarize_robots_step_times_are_over_all_steps():
    (one,) = summarize_robots([_trial("a", cpu=[1e-3] * 99), _trial("b", cpu=[5e-3])])
    assert one.steps.count == 100
    assert one.steps.mean == pytest.approx(1.04)
    assert one.steps.worst == pytest.approx(5.0)


def test_run_jobs_keeps_the_order_of_the_jobs():
    def progress(items, what, unit):
        assert (len(items), what, unit) == (3, "trials", "job")
        return items

    found = run_jobs(_one_job, [3, 1, 2], progress, "trials", "job", 1)
    assert [t.what for t in found] == ["3", "1", "2"]


def _one_job(number):
    return [_trial(str(number))]


def test_run_kitchen_opens_then_closes_and_reports_every_failure(monkeypatch):
    """A skill that fails at flaps, raises at a drawer, and fails to close another one."""
    calls = []

    def open_object(session, what, *, target):
        calls.append((what, target))
        session.cpu["open"], session.cpu["plan"] = [1e-3, 2e-3], [5.0]
        session.wall["open"] = [1e-3, 2e-3]
        if "pull_out" in what:
            raise ModelError("no model")
        done = "larder_door" not in what and ("drawer_1" not in what or target > 0)
        return Outcome(done, target, "The arm collides.", "kinematic", 3.0, 2, {"grasp_error": 0.4})

    class World(SimpleNamespace):
        def __init__(self, model, robot):
            super().__init__(model=model, robot=robot, name="kinematic", time=0.0)

        def reset(self, state):
            self.state = state

    monkeypatch.setattr(skills, "import_entry", lambda text: open_object if "opening" in text else World)
    trials = kitchens.run_kitchen(kitchens.KitchenJob(2, SHIPPED["hsr"]))
    model = kitchens.make_kitchen_with(SHIPPED["hsr"], 2)
    objects = kitchens.list_objects(model, "kitchen")
    assert {t.what for t in trials} == set(objects)
    assert all(t.cpu == (1e-3, 2e-3) for t in trials if "Error" not in t.reason)
    for what in objects:
        own = [t for t in trials if t.what == what]
        assert own[0].measures["height"] > 0.15
        lower, upper = model.limits(what)
        assert next(target for name, target in calls if name == what) == pytest.approx(0.98 * upper)
        assert lower == 0
        if "larder_door" in what:
            assert [(t.skill, t.failure) for t in own] == [("open", "collision")]
        elif "pull_out" in what:
            assert [(t.skill, t.failure) for t in own] == [("open", "other")]
            assert own[0].reason == "ModelError: no model"
        elif "drawer_1" in what:
            assert [(t.skill, t.done) for t in own] == [("open", True), ("close", False)]
        else:
            assert [(t.skill, t.done) for t in own] == [("open", True), ("close", True)]
    report = kitchens.report_trials(trials, range(2, 3))
    numbers = json.loads(json.dumps(report.numbers, allow_nan=False))
    assert len(numbers["failures"]) == sum(not t.done for t in trials) > 2
    assert numbers["robots"]["hsr"]["objects"] == len(objects)
    assert "larder_door" in format_report(report)


def test_leader_follower_opens_the_drawer_within_the_papers_tolerance():
    setup = make_opening_setup(SHIPPED["hsr"], OBJECTS["drawer"])
    start = setup.find_start()
    program = LeaderFollower(setup)
    found = open_by_program(program, setup, start)
    assert found.done
    assert found.position_error <= 1e-3
    assert found.violation <= 1e-9
    # The gain of 1 leaves 1 % after 4.6 s.
    assert found.steps == pytest.approx(math.log(100) / 0.02, abs=3)
    follower = program.controllers[1]
    speeds = dict.fromkeys(follower.speeds, 50.0)
    scale = SpeedScale(setup.model, follower.speeds)(start, speeds)
    rows = setup.model.violations(start.extended({s: scale * v for s, v in speeds.items()}))
    assert all(v.excess <= 1e-6 for v in rows)
    faster = setup.model.violations(start.extended({s: 1.01 * scale * v for s, v in speeds.items()}))
    assert any(v.excess > 1e-6 for v in faster)


@pytest.mark.parametrize("rule", RULES)
def test_unlock_thesis_box_needs_trends_of_and(rule):
    found = unlock(THESIS, "a", UPPER, rule)
    assert found.done == (rule == "and")
    if rule == "and":
        assert found.order[:3] == ("f", "e", "d")
        assert found.order[-1] == "a"
    else:
        assert found.order == {"product": ("f", "e", "d"), "none": ()}[rule]


def test_unlock_random_boxes_with_trends():
    assert all(unlock(*draw_box(10, seed), "and", 400).done for seed in range(3))


def test_make_push_setup_opens_the_object_and_takes_the_papers_start():
    setup = make_push_setup(SHIPPED["pr2"], *find_kitchens(None), "oven door")
    assert setup.start[setup.model.symbol("kitchen/oven_door")] == table1_push.objects.OPENED
    assert setup.start[setup.model.symbol("pr2/r_elbow_flex_joint")] == -2.1213
    assert [setup.start[setup.model.symbol(f"pr2/base/{key}")] for key in ("x", "y", "angle")] == [0, 0, 0]
    with pytest.raises(UnknownNameError, match="Did you mean 'oven door'"):
        make_push_setup(SHIPPED["pr2"], *find_kitchens(None), "oven dor")


def test_find_robots_and_options_name_what_there_is(tmp_path):
    assert [r.name for r in find_robots()] == ["pr2", "fetch", "hsr"]
    with pytest.raises(UnknownNameError, match="Did you mean 'fetch'"):
        find_robots(["fetsch"])
    with pytest.raises(InvalidValueError, match="There is no folder"):
        find_robots(data=tmp_path / "none")
    for options, wrong in ((Options(count=0), "count"), (Options(seed=-1), "seed")):
        with pytest.raises(InvalidValueError, match=f"--{wrong}"):
            reproduce("kitchens", options=options)
    with pytest.raises(InvalidValueError, match="takes no --seed"):
        reproduce("fig3", options=Options(seed=3))


def test_opening_report_without_skill_has_the_papers_figures():
    trials = [
        Trial(
            "drawer",
            robot,
            "object/upper_drawer",
            program,
            True,
            0.22,
            "",
            "open",
            4.0,
            2,
            (1e-3, 1e-3),
            series={"solve": (1e-4, 3e-4)},
            measures={"programs": 2, "grasp_error": 0.5, "limits": 0.0},
        )
        for robot in ("hsr", "hsr (authors)")
        for program in table1_open.report.PROGRAMS
    ]
    report = table1_open.report.make_opening_report(trials, 1, 0)
    first = report.numbers["programs"][0]
    assert first["published_mean_ms"] == 3.3
    assert first["solve_mean_ms"] == pytest.approx(0.2)
    assert first["solve_sd_ms"] == pytest.approx(np.std([0.1, 0.3]))
    json.dumps(report.numbers, allow_nan=False)
    assert "3.3 / 2.2" in format_report(report)


def test_start_in_aisle_is_free_where_the_middle_is_not():
    """The elbow of the PR2 at its start is wider than the narrowest aisles."""
    robot, model = SHIPPED["pr2"], kitchens.make_kitchen_with(SHIPPED["pr2"], 305)
    start = kitchens.start_in_aisle(robot, model)
    scene = Scene(model, rules=[Rule("*", "kitchen/floor")])

    def near(state):
        scene.update(state)
        return [d for d in scene.pairs_within(0.015) if d.a.startswith("pr2") != d.b.startswith("pr2")]

    middle = {"pr2/base/y": 0.0, "pr2/base/angle": math.pi / 2}
    assert near(start.updated(middle))
    assert not near(start)


def test_command_log_keeps_the_speeds_since_the_last_reset():
    applied = []
    world = SimpleNamespace(
        time=0.5,
        name="kinematic",
        reset=lambda state: None,
        apply=lambda *given, stamp: applied.append(given),
    )
    log = skills.CommandLog(world)
    log.apply({"a": 9.0}, 0.02)
    log.reset({})
    log.apply({"a": 1.0}, 0.02)
    log.apply({"b": 2.0}, 0.02)
    log.apply({}, 0.02)
    assert log.commands == {"time": [0.5] * 3, "a": [1.0, 0.0, 0.0], "b": [0.0, 2.0, 0.0]}
    assert [speeds for speeds, _ in applied] == [{"a": 9.0}, {"a": 1.0}, {"b": 2.0}, {}]
    assert log.name == "kinematic"
