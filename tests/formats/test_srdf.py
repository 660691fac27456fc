"""SRDF: groups, rules, end effectors and states, with the names of the model and a warning for each fault."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.errors import FormatError, UnknownNameError
from kineverse.formats.srdf import EndEffector, Srdf, VirtualJoint, parse_srdf, read_srdf
from kineverse.formats.srdf.reader import MOST_GROUPS


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/>{more}</joint>'
    )


LINKS = ("base", "upper", "lower", "flange", "palm", "left", "right", "head")
URDF = (
    '<robot name="r">'
    + "".join(f'<link name="{link}"/>' for link in LINKS)
    + joint("shoulder", "base", "upper")
    + joint("elbow", "upper", "lower")
    + joint("wrist", "lower", "flange", "fixed")
    + joint("mount", "flange", "palm", "fixed")
    + joint("finger", "palm", "left", "prismatic")
    + joint("other", "palm", "right", "prismatic", '<mimic joint="finger" multiplier="-1"/>')
    + joint("neck", "base", "head")
    + "</robot>"
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> kv.Model:
    path = tmp_path_factory.mktemp("srdf") / "r.urdf"
    path.write_text(URDF)
    return kv.load(path, "bob")


def read(model: kv.Model, *parts: str, strict: bool = False) -> Srdf:
    text = '<robot name="r">\n' + "\n".join(parts) + "\n</robot>"
    return parse_srdf(text, model, "bob", source="r.srdf", strict=strict)


ARM = '<group name="arm"><chain base_link="base" tip_link="flange"/></group>'
HAND = '<group name="hand"><link name="palm"/><joint name="finger"/><joint name="other"/></group>'


def test_a_chain_has_the_moving_joints_between_its_links(model: kv.Model) -> None:
    arm = read(model, ARM).groups["arm"]
    assert arm.joints == arm.coordinates == ("bob/shoulder", "bob/elbow")
    assert arm.links == ("bob/base", "bob/upper", "bob/lower", "bob/flange")


def test_a_chain_may_go_up_and_down_again(model: kv.Model) -> None:
    group = read(model, '<group name="g"><chain base_link="head" tip_link="upper"/></group>').groups["g"]
    assert group.joints == ("bob/neck", "bob/shoulder")
    assert group.links == ("bob/head", "bob/base", "bob/upper")


def test_links_bring_the_joint_above_and_mimic_joints_no_coordinate(model: kv.Model) -> None:
    hand = read(model, HAND).groups["hand"]
    assert hand.joints == ("bob/finger", "bob/other")
    assert hand.coordinates == ("bob/finger",)
    assert hand.links == ("bob/palm", "bob/left", "bob/right")


def test_subgroups_are_expanded_wherever_they_are_defined(model: kv.Model) -> None:
    both = '<group name="both"><group name="hand"/><group name="arm"/><joint name="neck"/></group>'
    groups = read(model, both, ARM, HAND).groups
    assert groups["both"].coordinates == ("bob/finger", "bob/shoulder", "bob/elbow", "bob/neck")
    assert list(groups) == ["both", "arm", "hand"]


def test_passive_joints_are_joints_that_are_not_planned_for(model: kv.Model) -> None:
    srdf = read(model, ARM, '<passive_joint name="elbow"/>')
    assert srdf.passive_joints == ("bob/elbow",)
    assert srdf.groups["arm"].joints == ("bob/shoulder", "bob/elbow")
    assert srdf.groups["arm"].coordinates == ("bob/shoulder",)


def test_rules_are_those_of_a_scene_and_of_a_model(model: kv.Model) -> None:
    srdf = read(
        model,
        '<disable_collisions link1="base" link2="lower" reason="Never"/>',
        '<enable_collisions link1="head" link2="palm"/>',
        '<disable_default_collisions link="head"/>',
    )
    assert srdf.rules == (
        ("bob/head", "bob/*", False, "off by default"),
        ("bob/head", "bob/palm", True, ""),
        ("bob/base", "bob/lower", False, "Never"),
    )
    assert kv.geometry.rules_as_data(srdf.rules) == srdf.rules
    edited = model.copy()
    with edited.edit() as edit:
        edit.write(kv.geometry.RULES, kv.geometry.rules_as_data(srdf.rules))
    assert kv.geometry.Scene(edited).rules == kv.geometry.Scene(model, rules=srdf.rules).rules


def test_end_effectors_and_virtual_joints(model: kv.Model) -> None:
    srdf = read(
        model,
        ARM,
        HAND,
        '<end_effector name="tool" group="hand" parent_link="flange" parent_group="arm"/>',
        '<virtual_joint name="stand" type="planar" parent_frame="map" child_link="base"/>',
        '<group name="all"><joint name="stand"/><group name="arm"/></group>',
    )
    assert srdf.end_effectors == {"tool": EndEffector("tool", "hand", "bob/flange", "arm")}
    assert srdf.virtual_joints == {"stand": VirtualJoint("stand", "planar", "map", "bob/base")}
    assert srdf.groups["all"].joints == srdf.groups["arm"].joints
    assert srdf.warnings == ()


def test_a_virtual_joint_in_a_group_is_the_base_of_the_model() -> None:
    text = (
        '<robot><virtual_joint name="stand" type="planar" parent_frame="map" child_link="base_link"/>'
        '<group name="base"><joint name=" stand "/></group></robot>'
    )
    group = parse_srdf(text, kv.load("pr2"), "pr2", strict=True).groups["base"]
    assert group.coordinates == ("pr2/base/x", "pr2/base/y", "pr2/base/angle")


def state(name: str, group: str, **values: object) -> str:
    joints = "".join(f'<joint name="{k}" value="{v}"/>' for k, v in values.items())
    return f'<group_state name="{name}" group="{group}">{joints}</group_state>'


def test_states_are_states_of_the_model(model: kv.Model) -> None:
    srdf = read(
        model,
        ARM,
        HAND,
        state("up", "arm", shoulder=0.5, elbow=-1),
        state("up", "hand", finger=0.02, other=3),
    )
    assert srdf.groups["arm"].states == {"up": {"bob/shoulder": 0.5, "bob/elbow": -1.0}}
    assert srdf.states == {"up": {"bob/shoulder": 0.5, "bob/elbow": -1.0, "bob/finger": 0.02}}
    assert model.default_state().updated(srdf.states["up"])["bob/finger"] == 0.02
    assert srdf.warnings == ()
    assert pickle.loads(pickle.dumps(srdf)) == srdf


def test_of_differing_states_of_one_name_the_first_one_counts(model: kv.Model) -> None:
    wide = '<group name="wide"><group name="arm"/><joint name="neck"/></group>'
    srdf = read(model, ARM, wide, state("up", "arm", elbow=1), state("up", "wide", elbow=0, neck=1))
    assert srdf.states["up"] == {"bob/elbow": 1.0, "bob/neck": 1.0}
    assert srdf.groups["wide"].states["up"] == {"bob/elbow": 0.0, "bob/neck": 1.0}
    assert len(srdf.warnings) == 1
    assert "differs from the state of that name" in srdf.warnings[0]


FAULTS = {
    "unknown joint": (
        '<group name="g"><joint name="neck"/><joint name="elbows"/></group>',
        "line 2",
        "Did you mean 'elbow'?",
    ),
    "unknown link": (
        '<group name="g"><link name="head"/><link name="plam"/></group>',
        "line 2",
        "Did you mean 'palm'?",
    ),
    "no name": ('<group><joint name="elbow"/></group>', "<group>", "has no name"),
    "two groups": (ARM + HAND.replace("hand", "arm"), '<group name="arm">', "the first one counts"),
    "unknown subgroup": ('<group name="g"><group name="x"/></group>', "line 2", 'there are "g"'),
    "group of itself": ('<group name="g"><group name="g"/></group>', "line 2", "contains itself"),
    "chain without tip": ('<group name="g"><chain base_link="base"/></group>', "<chain>", "has no tip_link"),
    "unknown pair": ('<disable_collisions link1="base" link2="x"/>', "line 2", '"x" is no link'),
    "pair of one": ('<disable_collisions link1="base" link2="base"/>', "line 2", "twice"),
    "state of no group": (state("s", "x"), "line 2", 'group="x" is no group'),
    "state twice": (ARM + state("s", "arm") + state("s", "arm"), "line 2", "already"),
    "no number": (ARM + state("s", "arm", elbow="1,5"), "line 2", "a finite number is expected"),
    "not finite": (ARM + state("s", "arm", elbow="inf"), "line 2", "a finite number is expected"),
    "two values": (ARM + state("s", "arm", elbow="1 2"), "line 2", "has 2 values, and the model has 1"),
    "fixed": (ARM + state("s", "arm", wrist=1), "line 2", "is fixed in the model"),
    "end effector of no group": (
        '<end_effector name="e" group="x" parent_link="palm"/>',
        "line 2",
        'group="x" is no group',
    ),
    "virtual joint of no kind": (
        '<virtual_joint name="v" type="x" parent_frame="map" child_link="base"/>',
        "line 2",
        "fixed, planar, floating",
    ),
}


@pytest.mark.parametrize(("part", "where", "what"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_a_warning_with_its_line_and_an_error_if_strict(
    model: kv.Model, part: str, where: str, what: str
) -> None:
    (warning,) = read(model, part).warnings
    assert where in warning
    assert what in warning
    with pytest.raises(FormatError) as info:
        read(model, part, strict=True)
    assert "r.srdf, line 2" in str(info.value)


def test_an_unknown_link_is_reported_once(model: kv.Model) -> None:
    rules = [f'<disable_collisions link1="{link}" link2="wheel"/>' for link in LINKS]
    srdf = read(model, *rules, '<disable_collisions link1="base" link2="palm"/>')
    assert len(srdf.warnings) == len(srdf.rules) == 1


def test_groups_in_a_circle_and_deep_ones_end(model: kv.Model) -> None:
    ring = [f'<group name="g{k}"><group name="g{(k + 1) % 900}"/></group>' for k in range(900)]
    srdf = read(model, *ring, '<group name="end"><group name="g0"/><joint name="elbow"/></group>')
    assert len(srdf.warnings) == 1
    assert srdf.groups["end"].joints == ("bob/elbow",)
    with pytest.raises(FormatError, match="more than"):
        read(model, *(f'<group name="g{k}"/>' for k in range(MOST_GROUPS + 1)))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("<sdf/>", "is not <robot>"),
        (URDF, "is a URDF"),
        ("<robot", "not well-formed XML"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot/>', "entities are refused"),
    ],
)
def test_other_texts_are_refused(model: kv.Model, text: str, what: str) -> None:
    with pytest.raises(FormatError, match=what):
        parse_srdf(text, model)


def test_a_wrong_prefix_is_an_error_that_names_the_right_one(model: kv.Model) -> None:
    text = '<robot><group name="g"><joint name="elbow"/></group></robot>'
    with pytest.raises(UnknownNameError, match="below prefix 'bob'"):
        parse_srdf(text, model)


def test_an_empty_description_is_none_of_these_errors(model: kv.Model) -> None:
    assert parse_srdf("<robot/>", model) == Srdf("")


@pytest.mark.parametrize(
    ("robot", "rules", "group", "free"), [("panda", 34, "panda_arm", 7), ("fetch", 75, "arm_with_torso", 8)]
)
def test_published_descriptions(
    robot: str, rules: int, group: str, free: int, published: Callable[..., Path]
) -> None:
    folder, model = published("planning_problems", robot), kv.Model()
    model.include(folder / f"{robot}_spherized.urdf", "one")
    srdf = read_srdf(folder / f"{robot}.srdf", model, "one")
    assert len(srdf.rules) == rules
    assert len(srdf.groups[group].coordinates) == free
    assert kv.geometry.Scene(model, rules=srdf.rules).rules
    if robot == "panda":
        assert srdf.states["ready"]["one/panda_joint4"] == -2.356
        assert srdf.end_effectors["hand"].parent_group == "panda_arm"
