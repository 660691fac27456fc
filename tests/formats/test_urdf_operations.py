"""Descriptions become models: names, tags, degrees of freedom, limits."""

from __future__ import annotations

import numpy as np
import pytest
from urdf_texts import LIMIT, SMALL, chain, joint, model_of, pair, robot

import kineverse as kv
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.urdf import parse_urdf
from kineverse.formats.urdf.operations import urdf_operations


def bounds(model: kv.Model, name: str) -> tuple[float, float]:
    constraint = model.constraints[name]
    return float(constraint.lower), float(constraint.upper)


def test_operations_have_prefixed_names_and_tags():
    model = model_of(SMALL, "a/b")
    assert set(model.frames) - {"world"} == {"a/b/base", "a/b/arm"}
    assert model.history.tags == ["frame a/b/base", "body a/b/base", "joint a/b/elbow", "data a/b/base/urdf"]
    assert [str(s) for s in model.degrees_of_freedom] == ["a/b/elbow"]
    assert list(model.articulations) == ["a/b/elbow"]
    assert list(model.constraints) == ["a/b/elbow/position", "a/b/elbow/velocity"]
    assert model.bodies["a/b/base"].collisions[0].name == "hull"


def test_names_without_prefix_are_those_of_the_file():
    assert model_of(SMALL).history.tags == ["frame base", "body base", "joint elbow", "data base/urdf"]


def test_a_file_is_loaded_by_its_path(tmp_path):
    path = tmp_path / "small.urdf"
    path.write_text(SMALL)
    tags = kv.load(path, prefix="p").history.tags
    assert tags == ["frame p/base", "body p/base", "joint p/elbow", "data p/base/urdf"]
    assert kv.load(str(path)).bodies["base"].collisions[0].geometry.folder == str(tmp_path)


WORLD = robot('<link name="world"/>', joint("j", "world", "l0"), links=1)


def test_a_root_called_world_is_the_world_without_prefix():
    model = model_of(WORLD)
    assert model.history.tags == ["joint j", "data l0/urdf"]
    assert model.frames["l0"].parent == "world"


def test_a_root_called_world_is_a_frame_with_prefix():
    model = model_of(WORLD, "p")
    assert model.frames["p/l0"].parent == "p/world"
    assert model.frames["p/world"].parent == "world"


def test_a_root_can_be_attached_elsewhere():
    assert model_of(SMALL, "p", parent="table").fk("p/arm")({"p/elbow": 0.0})[:3, 3].tolist() == [1, 0, 1]
    with pytest.raises(kv.errors.FormatError, match="its root link is the world"):
        model_of(WORLD, parent="table")


def test_a_link_called_world_that_is_not_the_root_needs_a_prefix():
    text = robot('<link name="world"/>', joint("j", "l0", "world"), links=1)
    with pytest.raises(kv.errors.FormatError, match=r'line 3, <link name="world">: .* Give a prefix'):
        list(urdf_operations(parse_urdf(text), strict=True))
    with collect_warnings() as remarks:
        assert set(model_of(text).frames) == {"l0", "world_link"}
    assert remarks[0].endswith('Give a prefix; it is called "world_link".')
    assert "p/world" in model_of(text, "p").frames


def test_empty_parts_of_names_are_left_out():
    text = robot('<link name="/base"/>', '<link name="arm//tip/"/>', joint("//elbow", "/base", "arm//tip/"))
    model = model_of(text, "p")
    assert model.history.tags == ["frame p/base", "joint p/elbow", "data p/base/urdf"]
    assert model.frames["p/arm/tip"].parent == "p/base"


@pytest.mark.parametrize(
    ("links", "message", "frames"),
    [
        (["/"], 'line 2, <link name="/">: the name has nothing but slashes', {"link"}),
        (
            ["a", "/a"],
            'line 3, <link name="/a">: only slashes tell it from the one on line 2',
            {"a", "a_link"},
        ),
        (
            ["a", "/a", "a_link", "a/"],
            'line 3, <link name="/a">: only slashes tell it from the one on line 2',
            {"a", "a_link", "a_link_2", "a_link_3"},
        ),
        (
            ["a&#9;b"],
            r'line 2, <link name="a\\tb">: the name has nothing but slashes, or a control character',
            {"a_b"},
        ),
    ],
)
def test_names_that_cannot_be_names_are_replaced(links, message, frames):
    joints = [joint(f"j{i}", links[0], name) for i, name in enumerate(links[1:])]
    text = robot(*(f'<link name="{name}"/>' for name in links), *joints)
    with pytest.raises(kv.errors.FormatError, match=message):
        list(urdf_operations(parse_urdf(text), strict=True))
    with collect_warnings() as remarks:
        assert set(model_of(text).frames) == frames
    assert len(remarks) == len(frames) - (len(links) > 1) - ("a_link" in links)
    assert all("; it is called " in remark for remark in remarks)


def test_clashing_coordinate_names_are_replaced():
    text = robot(joint("a", "l0", "l1", "planar", ""), joint("a/x", "l1", "l2"), links=3)
    with pytest.raises(
        kv.errors.FormatError, match=r'line 5, <joint name="a">: its coordinate "a/x" has the name'
    ):
        list(urdf_operations(parse_urdf(text), strict=True))
    assert [str(s) for s in model_of(text).degrees_of_freedom] == [
        "a/x",
        "a_joint/angle",
        "a_joint/x",
        "a_joint/y",
    ]


def test_a_ball_joint_in_a_urdf_is_that_of_mujoco():
    model = model_of(pair("", "spherical"))
    assert [str(s) for s in model.degrees_of_freedom] == ["j/qw", "j/qx", "j/qy", "j/qz"]


@pytest.mark.parametrize(
    ("kind", "symbols"),
    [
        ("fixed", []),
        ("revolute", ["j"]),
        ("continuous", ["j"]),
        ("prismatic", ["j"]),
        ("planar", ["j/angle", "j/x", "j/y"]),
        ("floating", ["j/qw", "j/qx", "j/qy", "j/qz", "j/x", "j/y", "j/z"]),
    ],
)
def test_degrees_of_freedom_of_every_type(kind, symbols):
    text = pair(LIMIT, kind)
    model = model_of(text)
    assert [str(s) for s in model.degrees_of_freedom] == symbols
    assert sum(len(a.speeds) for a in model.articulations.values()) == parse_urdf(text).dof


def test_urdf_limits_become_constraints():
    model = model_of(pair())
    assert bounds(model, "j/position") == (-1.0, 2.0)
    assert bounds(model, "j/velocity") == (-3.0, 3.0)
    assert model.constraints["j/velocity"].expression == kv.velocity("j")
    assert dict(model.articulations["j"].dynamics) == {"effort": 10.0}


def test_a_continuous_joint_has_no_range():
    assert list(model_of(pair(LIMIT, "continuous")).constraints) == ["j/velocity"]


def test_magnitude_without_effect_makes_no_constraint():
    text = pair('<limit lower="0" upper="1" effort="1" velocity="-1"/>')
    assert list(model_of(text).constraints) == ["j/position"]


def test_dynamics_are_in_the_articulation():
    inside = '<limit lower="0" upper="1" acceleration="3" jerk="9"/><dynamics damping="2"/>'
    model = model_of(pair(inside, attributes='name="r" version="1.2"'))
    assert dict(model.articulations["j"].dynamics) == {
        "acceleration": 3.0,
        "deceleration": 3.0,
        "jerk": 9.0,
        "damping": 2.0,
    }


SOFT = '<safety_controller k_velocity="5" k_position="7" soft_lower_limit="-.5" soft_upper_limit="1.5"/>'


def test_soft_limits_are_a_separate_removable_constraint():
    model = model_of(pair(LIMIT + SOFT))
    assert bounds(model, "j/position") == (-1.0, 2.0)
    assert bounds(model, "j/soft_limits") == (-0.5, 1.5)
    assert model.limits("j") == (-0.5, 1.5)
    assert dict(model.articulations["j"].dynamics) == {"effort": 10.0, "k_position": 7.0, "k_velocity": 5.0}
    with model.edit() as edit:
        edit.remove("soft limits j")
    assert model.limits("j") == (-1.0, 2.0)


@pytest.mark.parametrize(
    "inside", [LIMIT + '<safety_controller k_velocity="5" k_position="7"/>', "<dynamics/>" + SOFT]
)
def test_soft_limits_without_range_or_limited_joint_are_ignored(inside):
    text = pair(inside, "revolute" if "limit lower" in inside else "continuous")
    assert "j/soft_limits" not in model_of(text).constraints


FOLLOWING = '<mimic joint="{}" multiplier="{}" offset="{}"/>'


def test_joints_that_follow_have_no_degree_of_freedom_and_keep_their_limits():
    text = robot(
        joint("c", "l2", "l3", inside=LIMIT + SOFT + FOLLOWING.format("b", 3, 0.5)),
        joint("a", "l0", "l1", "continuous", ""),
        joint("b", "l1", "l2", "prismatic", LIMIT + FOLLOWING.format("a", -2, 1)),
        links=4,
    )
    model, a = model_of(text, "p"), kv.position("p/a")
    assert model.degrees_of_freedom == (a,)
    # b = -2 a + 1 and c = 3 b + 0.5 = -6 a + 3.5, each within [-1, 2] and at most 3 fast.
    for name, value in (("b", -2 * a + 1), ("c", -6 * a + 3.5)):
        constraint = model.constraints[f"p/{name}/position"]
        assert bounds(model, f"p/{name}/position") == (-1.0, 2.0)
        assert float(constraint.expression({a: 0.3})) == pytest.approx(float(value({a: 0.3})))
        speed = model.constraints[f"p/{name}/velocity"].expression
        assert float(speed({kv.velocity("p/a"): 1.0})) == (-2.0 if name == "b" else -6.0)
    assert bounds(model, "p/c/soft_limits") == (-0.5, 1.5)
    assert {name for name, *_ in model.violations({"p/a": 0.0})} == {"p/c/position", "p/c/soft_limits"}


def test_multiplier_of_zero_fixes_the_joint():
    text = robot(
        joint("a", "l0", "l1", "continuous", ""),
        joint("b", "l1", "l2", "prismatic", LIMIT + SOFT + FOLLOWING.format("a", 0, 0.25)),
        links=3,
    )
    model = model_of(text)
    assert not model.constraints
    assert model.fk("l2", "l1")({})[:3, 3].tolist() == [0.25, 0, 0]


def test_frame_with_a_body_cannot_be_removed():
    model = model_of(SMALL)
    with pytest.raises(kv.errors.EditError, match="base"), model.edit() as edit:
        edit.remove("frame base")
    assert "base" in model.bodies


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, -1), (0.6, 0, 0.8), (1, 2, -3)])
def test_planar_joints_move_in_the_plane_of_their_axis(axis):
    text = pair(
        f'<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>', "planar"
    )
    l0_T_l1 = model_of(text).fk("l1", "l0")
    rest = l0_T_l1({"j/x": 0.0, "j/y": 0.0, "j/angle": 0.0})
    normal = rest[:3, :3] @ np.array(axis) / np.linalg.norm(axis)
    assert np.allclose(rest, parse_urdf(text).joints[0].origin.matrix, atol=1e-15)
    moved = l0_T_l1({"j/x": 0.4, "j/y": -0.7, "j/angle": 1.1})
    step = moved[:3, 3] - rest[:3, 3]
    assert abs(step @ normal) < 1e-14
    assert np.linalg.norm(step) == pytest.approx(np.hypot(0.4, 0.7))
    assert np.allclose(moved[:3, :3] @ rest[:3, :3].T @ normal, normal, atol=1e-14)


def test_a_long_chain_becomes_a_model():
    assert len(model_of(chain(2000, "", "continuous")).degrees_of_freedom) == 2000
