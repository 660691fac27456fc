"""Experiments about manipulation: trials and their summary, the papers' programs, locks, set-ups."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from kineverse.errors import FormatError, InvalidValueError, UnknownNameError
from kineverse.gallery.lockboxes import THESIS, draw_lockbox
from kineverse.geometry import Rule, Scene
from kineverse.manipulation import Outcome, Session, TrackedBelief
from kineverse.manipulation.robot_placement import find_free_state
from kineverse.manipulation.robot_sources import SHIPPED
from kineverse.worlds import TrueBelief, read_run_recording
from kineverse_studies.commands.reproduce import format_report
from kineverse_studies.experiments import Options, kitchens, reproduce, table1_open, table1_push
from kineverse_studies.experiments.execution import run_jobs
from kineverse_studies.experiments.lockbox.unlocking_runs import RULES, run_unlocking
from kineverse_studies.experiments.manipulation import skills
from kineverse_studies.experiments.manipulation.film import draw_vectors, find_telling_moment
from kineverse_studies.experiments.manipulation.paper_push import push_as_published
from kineverse_studies.experiments.manipulation.skills import (
    TrialSetting,
    TrialWatch,
    check_data,
    find_robots,
    list_series,
    make_settings,
)
from kineverse_studies.experiments.manipulation.trials import (
    Moment,
    Trial,
    count_objects,
    find_failure,
    make_exception_table,
    make_trial_tables,
)
from kineverse_studies.experiments.table1_open.programs import (
    OBJECTS,
    LeaderFollower,
    SpeedScale,
    make_opening_setup,
    open_by_program,
)
from kineverse_studies.experiments.table1_push import find_kitchens, make_push_report, make_push_setup
from robot_interface_proxy import InterfaceOnly


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


def test_count_objects_excuses_a_tenth_that_many_placements_prove():
    done = [_trial(f"a{k}", skill=skill) for k in range(16) for skill in ("open", "close")]
    half = [_trial("b"), _trial("b", "collision", skill="close")]
    far = [_trial(f"c{k}", "reach", placements=200) for k in range(3)]
    found = count_objects([*done, *half, *far])
    assert found == (20, 16, 2)  # a tenth of 20, not 3
    assert found.rate == pytest.approx(16 / 18)
    assert count_objects([*done, _trial("c", "reach", placements=199)]).excused == 0


def test_tables_have_a_row_for_each_robot_and_world_and_no_empty_columns():
    trials = [_trial("a", cpu=[1e-3] * 99), _trial("b", cpu=[5e-3]), replace(_trial("a"), world="mujoco")]
    trials[0] = replace(
        trials[0], measures={"grasp_error": 2e-4, "penetration": 1e-4, "penetrating": ("x", "y")}
    )
    success, times, quality = make_trial_tables(trials, "Success")
    assert [row[:2] for row in success.rows] == [("pr2", "kinematic"), ("pr2", "mujoco")]
    assert "noise" not in success.head
    row = dict(zip(times.head, times.rows[0], strict=True))
    assert (row["steps"], row["CPU mean"], row["worst"]) == ("100", "1.04", "5")
    row = dict(zip(quality.head, quality.rows[0], strict=True))
    assert row == {
        "robot": "pr2",
        "world": "kinematic",
        "grasp error [mm]": "0.2",
        "penetration [mm]": "0.1",
        "deepest pair": "x and y",
    }
    noisy = make_trial_tables([replace(trials[0], noise="3mm")], "Success")
    assert all("noise" in table.head for table in noisy[:3])


def test_exception_table_lists_all_pairs_once():
    pairs = [
        ("pr2/a", "pr2/b"),
        ("pr2/a", "pr2/c"),
        ("pr2/tip", "kitchen/handle"),
        ("kitchen/x", "kitchen/y"),
    ]
    assert make_exception_table([replace(_trial("a"), measures={"excepted": pairs})] * 2).rows == (
        ("pr2", "pr2: a", "b, c"),
        ("pr2", "handle that is grasped or pushed", "pr2: tip"),
        ("pr2", "kitchen: x", "y"),
    )


def test_run_jobs_keeps_the_order_of_the_jobs():
    def progress(items, what, unit):
        assert (len(items), what, unit) == (3, "trials", "job")
        return items

    found = run_jobs(_one_job, [3, 1, 2], progress, "trials", "job", Options(processes=1))
    assert [t.what for t in found] == ["3", "1", "2"]


def _one_job(number):
    return [_trial(str(number))]


def test_run_kitchen_opens_then_closes_and_reports_every_failure(monkeypatch):
    """A skill that fails at flaps, raises at a drawer, and fails to close another one."""
    calls = []

    def open_object(session, coordinate, *, target, **options):
        what = str(coordinate)
        calls.append((what, target))
        session.cpu["open"] = session.wall["open"] = [1e-3, 2e-3]
        if "pull_out" in what:
            raise RuntimeError("a bug")
        done = "larder_door" not in what and ("drawer_1" not in what or target > 0)
        measures = {"grasp_error": 0.4, "target": session.state[coordinate], "tolerance": 0.02}
        return Outcome(done, target, "The arm collides.", "kinematic", 3.0, 2, measures)

    monkeypatch.setattr(skills, "open_object", open_object)
    trials = kitchens.run_kitchen(kitchens.KitchenJob("kitchens/2", SHIPPED["hsr"]))
    model = kitchens.make_kitchen_with(SHIPPED["hsr"], "kitchens/2")
    objects = [str(s) for s in model.degrees_of_freedom if str(s).startswith("kitchen/")]
    assert {t.what for t in trials} == set(objects)
    assert all(t.cpu == (1e-3, 2e-3) for t in trials)
    assert all(t.dof == 11 for t in trials)
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
            assert own[0].reason == "RuntimeError: a bug"
        elif "drawer_1" in what:
            assert [(t.skill, t.done) for t in own] == [("open", True), ("close", False)]
        else:
            assert [(t.skill, t.done) for t in own] == [("open", True), ("close", True)]
    report = kitchens.report_trials(trials, ["kitchens/2"])
    numbers = json.loads(json.dumps(report.numbers, allow_nan=False))
    assert len(numbers["failures"]) == sum(not t.done for t in trials) > 2
    (row,) = numbers["robots"]
    assert (row["robot"], row["world"], row["objects"]) == ("hsr", "kinematic", len(objects))
    assert "larder_door" in format_report(report)


@pytest.mark.long
def test_hand_that_left_aside_takes_the_path_back_from_there():
    """The gripper of the Fetch leaves the oven's handle along the bar."""
    trials = kitchens.run_kitchen(kitchens.KitchenJob("kitchen", SHIPPED["fetch"], only="kitchen/oven_door"))
    assert [(t.skill, t.done, t.reason) for t in trials if not t.done] == []
    assert [t.skill for t in trials] == ["open", "close"]


@pytest.mark.long
def test_leader_follower_opens_the_drawer_within_the_papers_tolerance():
    setup = make_opening_setup(SHIPPED["hsr"], OBJECTS["drawer"])
    start, program = setup.find_start(), LeaderFollower(setup)
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
def test_open_box_thesis_needs_trends_of_and(rule):
    found = run_unlocking(THESIS, rule)
    assert found.done == (rule == "and")
    if rule == "and":
        assert found.order[:3] == ("f", "e", "d")
        assert found.order[-1] == "a"
    else:
        assert found.order == {"product": ("f", "e", "d"), "none": ()}[rule]


def test_open_box_random_boxes_with_trends():
    assert all(run_unlocking(draw_lockbox(10, seed), "and", 400).done for seed in range(3))


def test_make_push_setup_opens_the_object_and_takes_the_papers_start():
    setup = make_push_setup(SHIPPED["pr2"], *find_kitchens(None), "oven door")
    assert setup.start[setup.model.symbol("kitchen/oven_door")] == table1_push.OPENED
    assert setup.start[setup.model.symbol("pr2/r_elbow_flex_joint")] == -2.1213
    assert [setup.start[setup.model.symbol(f"pr2/base/{key}")] for key in ("x", "y", "angle")] == [0, 0, 0]
    with pytest.raises(UnknownNameError, match="Did you mean 'oven door'"):
        make_push_setup(SHIPPED["pr2"], *find_kitchens(None), "oven dor")


def test_find_robots_and_options_name_what_there_is(tmp_path):
    assert [r.name for r in find_robots()] == ["pr2", "fetch", "hsr"]
    with pytest.raises(UnknownNameError, match="Did you mean 'fetch'"):
        find_robots(["fetsch"])
    (tmp_path / "data/pr2/pr2_description/robots").mkdir(parents=True)
    (tmp_path / "data/pr2/pr2_description/robots/pr2.urdf").touch()
    assert [r.name for r in find_robots(["pr2", "hsr"], tmp_path / "data")] == ["pr2 (authors)", "hsr"]
    with pytest.raises(InvalidValueError, match="There is no folder"):
        check_data(tmp_path / "none")
    with pytest.raises(InvalidValueError, match="has none of pr2, fetch"):
        check_data(tmp_path)
    (tmp_path / "file").touch()
    for options, error, wrong in (
        (Options(count=0), InvalidValueError, "--count"),
        (Options(seed=-1), InvalidValueError, "--seed"),
        (Options(world="moon"), UnknownNameError, "--world moon"),
        (Options(noise="3parsec"), InvalidValueError, "3parsec"),
        (Options(record=tmp_path / "file"), FormatError, "--record"),
        (Options(robot=("hrs",)), UnknownNameError, "hsr"),
    ):
        for name in ("kitchens", "table1-open", "table1-push", "ablations"):
            if name != "table1-push" or options.count is None:
                with pytest.raises(error, match=wrong):
                    reproduce(name, options=options)
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
            measures={"programs": 2, "grasp_error": 5e-4, "limit_violation": 0.0},
        )
        for robot in ("hsr", "hsr (authors)")
        for program in table1_open.PROGRAMS
    ]
    report = table1_open.make_opening_report(trials, 1, 0)
    first = report.numbers["programs"][0]
    assert first["published_mean_ms"] == 3.3
    assert first["solve_mean_ms"] == pytest.approx(0.2)
    assert first["solve_sd_ms"] == pytest.approx(np.std([0.1, 0.3]))
    json.dumps(report.numbers, allow_nan=False)
    assert first["grasp_error_mm"] == 0.5
    assert report.numbers["programs"][1]["published_mean_ms"] is None
    assert "paper mean" in format_report(report)


def test_start_in_aisle_is_free_where_the_middle_is_not():
    """The elbow of the PR2 at its start is wider than the narrowest aisles."""
    robot, model = SHIPPED["pr2"], kitchens.make_kitchen_with(SHIPPED["pr2"], "kitchens/305")
    start = kitchens.start_in_aisle(robot, model)
    scene = Scene(model, rules=[Rule("*", "kitchen/floor")])

    def near(state):
        scene.update(state)
        return [d for d in scene.pairs_within(0.015) if d.a.startswith("pr2") != d.b.startswith("pr2")]

    middle = {"pr2/base/y": 0.0, "pr2/base/angle": math.pi / 2}
    assert near(start.updated(middle))
    assert not near(start)
    states = [start.updated(middle), start]
    found, contact = find_free_state(model, "pr2", states, 0.02, [Rule("*", "kitchen/floor")])
    assert found is start
    assert "pr2/" in contact
    assert find_free_state(model, "pr2", states[:1], 0.02) == (
        None,
        find_free_state(model, "pr2", states, 0.02)[1],
    )


def test_trial_watch_keeps_commands_of_the_last_session_and_records(tmp_path):
    pytest.importorskip("mcap")
    robot = SHIPPED["hsr"]
    model = robot.load()
    (recorded,) = make_settings(Options(record=tmp_path / "new"))
    world = recorded.make_world(model, "hsr", robot.start_state(model))
    x, lift = (model.symbol(f"hsr/{name}").derivative() for name in ("base/x", "arm_lift_joint"))
    with TrialWatch(recorded, model, world, {"case": "a b", "what": "x/y"}, film=True) as watch:
        watch.open_session(0.02).act({x: 9.0})
        world.reset(robot.start_state(model))
        session = watch.open_session(0.02)
        for speeds in ({x: 0.1}, {lift: 0.05}, {}):
            session.act(speeds)
        watch.write_outcome(Outcome(True, 0.0, "", "kinematic", 0.06, 3))
    assert list_series(watch.commands) == {
        "time": pytest.approx([0.0, 0.02, 0.04]),
        str(x): [0.1, 0.0, 0.0],
        str(lift): [0.0, 0.05, 0.0],
    }
    assert read_run_recording(tmp_path / "new" / "a_b-x_y.mcap").duration >= 0.06 - 1e-9


def test_setting_believes_the_truth_only_without_noise():
    model = kitchens.make_kitchen_with(SHIPPED["hsr"], "kitchens/2")
    start = SHIPPED["hsr"].start_state(model)
    world = TrialSetting("kinematic", "3mm").make_world(model, "hsr", start)
    assert isinstance(TrialSetting("kinematic", "3mm").make_belief(world), TrackedBelief)
    assert isinstance(TrialSetting().make_belief(world), TrueBelief)
    assert [one.world for one in make_settings(Options(world="both"))] == ["kinematic", "mujoco"]


def test_papers_controller_moves_an_object_only_where_it_touches():
    robot = SHIPPED["hsr"]
    setup = make_push_setup(robot, table1_push.SHIPPED_KITCHEN, "folding door")
    what, touches, speeds = setup.model.symbol(setup.what), [], []
    world = TrialSetting().make_world(setup.model, "hsr", setup.start, dt=0.1)

    def look(session):
        touches.append(session.contact.touching)
        speeds.append(session.command.speeds[what.derivative()])

    session = Session(InterfaceOnly(world), dt=0.1, belief=TrueBelief(world), on_step=look)
    outcome = push_as_published(session, world, robot, what, 500)
    assert outcome, outcome.reason
    assert max(map(abs, speeds)) > 0.05
    assert not touches[0]
    assert [v for v, touched in zip(speeds, touches, strict=True) if not touched] == pytest.approx(
        [0.0] * touches.count(False), abs=1e-9
    )


def test_push_report_has_the_papers_controller_apart():
    ours = Trial("shipped kitchen", "hsr", "door", "push (2020)", False, 0.4, "time", "", 1.0, 10)
    papers = replace(ours, skill="papers' push (2020)", done=True, failure="")
    report = make_push_report([ours, papers], 0)
    tables = {table.title: table for table in report.tables}
    assert len(tables["Starts and bars"].rows) == 2
    assert tables["Objects pushed shut"].rows[0][:4] == ("hsr", "kinematic", "0", "1")
    assert len(tables["Failures"].rows) == 1
    assert [row["published_dof"] for row in report.numbers["pushes"]] == [23, 23]


def test_push_vectors_are_drawn_at_nearest_points_with_the_longest_tangent():
    def moment(time, apart, tangent):
        p, n, push = np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        vectors = {"n": n, "push": push, "tangent": tangent * push, "r - p": apart * n}
        return Moment(time, "push", {}, {name: (p, vector) for name, vector in vectors.items()})

    film = [moment(0, 0.5, 0.9), moment(1, 0.03, 0.2), moment(2, 0.01, 0.6), Moment(3, "approach", {}, {})]
    assert find_telling_moment(film) == (pytest.approx(0.6), film[2])
    assert find_telling_moment(film[:1]) == (0.0, None)
    parts, ends = draw_vectors(film[2].vectors, 0.2)
    np.testing.assert_allclose(
        ends, [[0, 0, 0], [0, 0, 0.01], [0, 0, 0.2], [0.2, 0, 0], [0, -0.2, 0], [0.2, 0, 0]]
    )
    assert len(parts) == 1 + 2 * 4
