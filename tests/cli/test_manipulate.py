"""``kineverse open``, ``close`` and ``push``: start, target, result, and mistakes."""

import json
import re
import sys
from types import SimpleNamespace

import pytest

import kineverse as kv
from kineverse.cli import manipulate
from kineverse.manipulation.outcome import Outcome

pytest.importorskip("coal")
pytest.importorskip("daqp")

pytestmark = pytest.mark.compiler  # without one, these commands refuse before all else

ARM = """<robot name="arm">
  <link name="root"/>
  <link name="lift"/>
  <link name="finger">
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.03 0.03"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="root"/><child link="lift"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1.5" velocity="1" effort="9"/>
  </joint>
  <joint name="wrist" type="fixed"><parent link="lift"/><child link="finger"/></joint>
</robot>"""

DRAWER = """<robot name="box">
  <link name="wall"/>
  <link name="front">
    <collision><geometry><box size="0.02 0.4 0.3"/></geometry></collision>
  </link>
  <joint name="drawer" type="prismatic">
    <origin xyz="1.2 0 0.5"/><parent link="wall"/><child link="front"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="0.2" velocity="1" effort="9"/>
  </joint>
</robot>"""

HSR = ("--robot", "hsr", "--what", "shelf_drawers/upper_drawer")


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A robot of one joint and no gripper, and a drawer, in the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "box.urdf").write_text(DRAWER)
    return tmp_path


@pytest.fixture
def asked(monkeypatch):
    """Stand in for the skill: it holds still for two steps. Returns what it was asked for.

    With the seed 1 it says that the object is at the target, else that it was wanted where it is.
    """
    calls = []

    def open_object(session, what, *, target=None, **options):
        calls.append(SimpleNamespace(session=session, what=what, target=target, options=options))
        session.phase = "grasp"
        session.stop()
        session.stop()
        wanted = target if options["seed"] == 1 else session.state[what]
        measures = {"grasp": float("nan"), "target": wanted, "tolerance": 0.02}
        done = options["seconds"] != 7.0
        return Outcome(done, 0.3, "it is over", session.interface.name, 0.04, 2, measures)

    monkeypatch.setitem(
        sys.modules,
        "kineverse.manipulation.opening.grasped_opening",
        SimpleNamespace(open_object=open_object),
    )
    return calls


def test_a_robot_file_pushes_with_a_named_body_and_the_run_is_recorded(run, files):
    """The file's names get a prefix, it stands where @ says, and the world's truth is reported."""
    pytest.importorskip("mcap")
    from kineverse.worlds import read_run_recording

    words = ["push", "box.urdf", "--robot", "arm.urdf@0.3,0,0", "--base", "omni", "--what", "drawer"]
    words += ["--hand", "arm/finger", "--record", "run.mcap"]
    status, out, err = run(*words, "--json")
    answer = json.loads(out)
    assert (status, answer["done"]) == (0, True), answer["reason"]
    assert (answer["start"], answer["target"]) == (0.2, 0.0)
    assert abs(answer["value"]) < 0.02
    assert (answer["robot"], answer["hand"], answer["world"]) == ("arm", None, "kinematic")
    assert "push" in err
    recorded = read_run_recording("run.mcap")
    assert recorded.outcome["value"] == answer["value"]
    assert recorded.states[recorded.model.symbol("drawer")][-1] == pytest.approx(answer["value"])
    assert recorded.states[recorded.model.symbol("arm/base/x")][0] == pytest.approx(0.3, abs=0.02)


def test_a_push_on_estimates_from_noisy_sensors(run, files):
    words = ["push", "box.urdf", "--robot", "arm.urdf@0.3,0,0", "--base", "omni", "--what", "drawer"]
    words += ["--hand", "arm/finger", "--noise", "3mm,0.5deg,30Hz,drop=0.1", "--json"]
    status, out, err = run(*words)
    answer = json.loads(out)
    assert (status, answer["done"]) == (0, True), answer["reason"]
    assert abs(answer["value"]) < 0.02
    assert 0.0 < answer["measures"]["estimate_mean"] < 0.005
    assert "No frame of 'arm' is named like a camera" in err
    words[words.index("--noise") + 1] = "3mm,0.5deg,drop=1"
    status, out, _ = run(*words)
    answer = json.loads(out)
    assert (status, answer["done"]) == (1, False)
    assert "is not known" in answer["reason"]


def test_what_is_in_the_way_is_said_before_anything_moves(run, files, asked):
    blocked = DRAWER.replace(
        '<link name="wall"/>',
        '<link name="wall"><collision><origin xyz="1.0 0 0.5"/><geometry><box size="0.1 0.1 0.1"/></geometry>'
        "</collision></link>",
    )
    (files / "blocked.urdf").write_text(blocked)
    words = ["blocked.urdf", "--robot", "hsr@-1,0,0", "--what", "drawer", "--json"]
    status, out, _ = run("open", *words)
    answer = json.loads(out)
    assert (status, answer["claimed"], answer["done"], answer["seconds"]) == (1, False, False, 0.0)
    assert "'front' meets 'wall' at 0.141 m of 'drawer'" in answer["reason"]
    assert answer["measures"]["in_the_way"] == ["front", "wall"]
    assert answer["measures"]["free"] == pytest.approx(0.137, abs=1e-3)
    assert not asked


def test_without_a_gripper_it_is_not_done_and_says_why(run, files):
    for skill in ("open", "push"):
        status, out, _ = run(skill, "box.urdf", "--robot", "arm.urdf", "--what", "drawer", "--json")
        answer = json.loads(out)
        assert (status, answer["done"], answer["seconds"]) == (1, False, 0)
        assert "no gripper" in answer["reason"]
        assert "--hand" in answer["reason"]
        assert ("kineverse push" in answer["reason"]) == (skill == "open")


def test_a_robot_out_of_reach_without_a_base_is_to_get_one(run, files):
    words = ["box.urdf", "--robot", "arm.urdf", "--what", "drawer", "--hand", "arm/finger"]
    status, out, _ = run("push", *words)
    assert status == 1
    assert "--base omni" in out


def test_without_a_handle_it_is_not_done_and_says_how_else(run, files):
    for more in ((), ("--unknown",)):
        status, out, _ = run("open", "box.urdf", *HSR[:2], "--what", "drawer", "--json", *more)
        answer = json.loads(out)
        assert (status, answer["done"], answer["steps"]) == (1, False, 0)
        assert "moves no handle" in answer["reason"]
        assert "kineverse push" in answer["reason"]


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [(0.5, "m", "0.5 m"), ("", "", "-"), (None, "m", "-"), (["", ""], "", "-"), (3, "", "3")],
)
def test_a_measure_is_printed_with_its_unit(value, unit, said):
    assert manipulate._format_measure(value, unit) == said


def test_what_is_there_from_the_start_is_done(run, files):
    words = ["box.urdf", "--robot", "arm.urdf", "--what", "drawer", "--hand", "arm/finger", "--from", "1cm"]
    status, out, _ = run("push", *words)
    assert (status, out) == (0, "drawer: shut at 0.01 m, after 0 s in the kinematic world\n")


@pytest.mark.parametrize(
    ("upper", "skill", "more", "done", "says"),
    [
        ("0", "open", (), False, "cannot move"),
        ("0", "open", ("--to", "0.1"), False, "cannot move"),
        ("0", "close", (), True, "there from the start"),
        ("0.01", "open", (), False, "moves no handle"),
    ],
)
def test_what_hardly_moves_is_not_open_from_the_start(run, files, upper, skill, more, done, says):
    (files / "box.urdf").write_text(DRAWER.replace('upper="0.2"', f'upper="{upper}"'))
    status, out, _ = run(skill, "box.urdf", *HSR[:2], "--what", "drawer", "--json", *more)
    answer = json.loads(out)
    assert (status, answer["done"]) == (1 - done, done)
    assert says in answer["reason"]


def test_what_has_no_shape_is_not_to_be_pushed(run, files):
    (files / "box.urdf").write_text(re.sub("<collision>.*</collision>", "", DRAWER))
    status, out, _ = run("open", "box.urdf", *HSR[:2], "--what", "drawer")
    assert status == 1
    assert "push" not in out


def test_open_begins_shut_and_close_begins_open(run, asked, tmp_path):
    status, out, err = run("open", "shelf_drawers", *HSR, "--json", "--seconds", 5)
    answer = json.loads(out)
    assert status == 0
    assert {"done", "value", "reason", "world", "seconds"} <= answer.keys()
    assert answer["measures"]["grasp"] is None
    assert {"limit_violation", "penetration", "grasp_error", "contact_losses"} <= answer["measures"].keys()
    assert "gripper of hsr/hand_palm_link" in err
    assert "handle shelf_drawers/" in err
    assert err.count("grasp") == 1
    assert "touch, so the robot begins at" in err  # it would stand in the drawers
    assert asked[0].target == kv.load("shelf_drawers").limits(asked[0].what)[1]
    options, found = asked[0].options, (asked[0].options["hand"].hand, asked[0].options["handle"].frame)
    assert (options["seconds"], options["seed"]) == (5.0, 0)
    assert found == ("hsr/hand_palm_link", "shelf_drawers/upper_drawer_handle")

    picture = tmp_path / "end.png"
    words = ["close", "shelf_drawers", "--robot", "hsr@-1,0.5,90deg", *HSR[2:]]
    handle = next(line.split()[1].strip(":") for line in err.splitlines() if line.startswith("handle"))
    status, out, _ = run(*words, "--handle", handle, "--picture", picture, "--seconds", 7)
    assert status == 1
    assert out.startswith("shelf_drawers/upper_drawer: not done, at 0.22 m. it is over\n")
    assert "steps" in out
    assert picture.read_bytes()[:4] == b"\x89PNG"
    state, drawer = asked[1].session.state, asked[1].what
    model = kv.load("shelf_drawers")
    assert asked[1].target == model.limits(drawer)[0]
    assert state[drawer] == min(0.4, model.limits(drawer)[1])
    assert [state[f"hsr/base/{c}"] for c in ("x", "y", "angle")] == pytest.approx([-1, 0.5, 1.5708], abs=1e-4)


def test_what_is_claimed_and_not_true_is_not_done(run, asked):
    status, out, _ = run("open", "shelf_drawers", *HSR, "--json", "--seed", 1)
    answer = json.loads(out)
    assert (status, answer["claimed"], answer["done"], answer["value"]) == (1, True, False, 0.0)
    assert answer["reason"] == "it is over. The world says 0, not 0.22 ± 0.02."
    assert answer["measures"]["failure"] == "other"


def test_a_base_that_does_not_drive_is_put_to_the_handle(run, asked, monkeypatch):
    def stand(session, world, handle, target, **options):
        assert handle.frame == "shelf_drawers/upper_drawer_handle"
        world.reset(world.state.updated({"hsr/base/x": -0.25, "hsr/base/y": 0.5}))
        session.refresh()
        return True

    monkeypatch.setattr("kineverse.manipulation.stand_at_handle", stand)
    status, out, err = run("open", "shelf_drawers", *HSR, "--json")
    assert (status, asked[0].session.state["hsr/base/x"]) == (0, -0.25)
    assert "does not drive to the handle by itself; it is put to -0.25, 0.50" in err
    assert json.loads(out)["measures"]["distance"] == 0.0


def test_a_part_with_an_unknown_joint_is_as_far_open_as_the_world_says(run, monkeypatch):
    def open_unknown(session, handle, **options):
        session.stop()
        measures = {"way": 0.2, "turn": 0.0}
        return Outcome(True, 0.2, "open by 20 cm", session.interface.name, 0.02, 1, measures)

    monkeypatch.setattr("kineverse.manipulation.open_unknown", open_unknown)
    status, out, _ = run("open", "shelf_drawers", *HSR, "--unknown", "--json")
    answer = json.loads(out)
    assert (status, answer["claimed"], answer["done"], answer["value"]) == (1, True, False, 0.0)
    assert answer["reason"] == "open by 20 cm. The world says that it is open by 0 cm and 0°."
    assert (answer["measures"]["way"], answer["target"]) == (0.0, None)


def test_other_coordinates_are_set_at_the_start(run, asked):
    lower = HSR[3].replace("upper", "lower")
    status, *_ = run(
        "open", "shelf_drawers", *HSR, "--set", f"{lower}=10cm", "--set", "hsr/arm_lift_joint=0.2"
    )
    state = asked[0].session.state
    assert status == 0
    assert (state[HSR[3]], state[lower], state["hsr/arm_lift_joint"]) == (0.0, 0.1, 0.2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["shelf_drawers", *HSR[:2], "--what", "shelf_drawers/uper_drawer"],
            "Did you mean 'shelf_drawers/upper",
        ),
        (["shelf_drawers", *HSR[:2], "--what", "hsr/arm_lift_joint"], "is a coordinate of the robot"),
        (["shelf_drawers", "--robot", "hsr@0,0,0", *HSR[2:]], "begins in contact: shelf_drawers/"),
        (["shelf_drawers", *HSR, "--from", "2m"], "--from 2: 'shelf_drawers/upper_drawer' is between 0 and"),
        (["shelf_drawers", *HSR, "--to", "far"], "'far' is not a value"),
        (["shelf_drawers", *HSR, "--set", f"{HSR[3]}=1cm"], "--from VALUE says where it is"),
        (
            ["shelf_drawers", *HSR, "--set", "shelf_drawers/uper_drawer=1cm"],
            "Did you mean 'shelf_drawers/upper",
        ),
        (["shelf_drawers", *HSR, "--to", "30deg"], "'shelf_drawers/upper_drawer' is in m"),
        (["shelf_drawers", *HSR, "--robot", "pr2"], "--robot is given twice"),
        (["shelf_drawers", *HSR, "--picture", "no_such_folder/end.png"], "no_such_folder: No such file"),
        (["shelf_drawers", *HSR, "--hand", "hsr/hnd_palm_link"], "hsr/hand_palm_link"),
        (["shelf_drawers", *HSR, "--set", "hsr/hand_l_distal_joint=0"], "it follows 'hsr/hand_motor_joint'"),
        (["shelf_drawers", *HSR, "--set", "hsr/base=0"], "of other names: 'hsr/base/x'"),
        (["shelf_drawers", *HSR, "--set", "hsr/hand_palm_joint=0"], "is fixed"),
        (["shelf_drawers", *HSR, "--handle", "shelf_drawers/frame"], "shelf_drawers/"),
        (["shelf_drawers", *HSR, "--grasp", "tie"], "--world mujoco"),
        (["shelf_drawers", *HSR, "--noise", "3apples"], "Noise '3apples' is not readable"),
        (["shelf_drawers", *HSR, "--noise", "3mm,camera=hsr/haed"], "no frame 'hsr/haed'"),
        (["shelf_drawers", *HSR, "--seconds", "-1"], "--seconds"),
        (["shelf_drawers", *HSR, "--record", "run.bag"], ".mcap"),
        (["shelf_drawers", "--robot", "hrs", *HSR[2:]], "hsr"),
        (["hsr", "--robot", "hsr", "--what", "x"], "Give the furniture alone"),
        (["hsr", "--robot", "hsr", "--base", "omni", "--what", "x"], "Give the furniture alone"),
        (["box.urdf", "--robot", "arm.urdf@1,0", "--what", "drawer"], "a place is X,Y,ANGLE"),
        (["box.urdf", "--robot", "hsr@1,0,0.5,0", "--what", "drawer"], "stands on the floor"),
        (["box.urdf", "--robot", "hsr", "--base", "omni", "--what", "drawer"], "moves already"),
        (["arm.urdf", "--robot", "box.urdf", "--what", "box/drawer"], "is a coordinate of the robot"),
    ],
)
def test_mistakes_are_reported_in_one_line(run, asked, files, words, message):
    status, out, err = run("open", *words)
    assert (status, out) == (2, "")
    assert message in err.splitlines()[-1]
    assert not asked
