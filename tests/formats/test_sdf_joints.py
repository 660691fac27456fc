"""Each joint type of SDF becomes its operation; limits, dynamics, mimic, gearboxes, loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_sdf_pose_graph import at, link, model_of, pose, sdf

import kineverse as kv
from kineverse.formats.sdf import parse_sdf

Z = "<axis><xyz>0 0 1</xyz></axis>"


def joint(name: str, kind: str, parent: str, child: str, inside: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>{inside}</joint>'
    )


def one(kind: str, inside: str = Z) -> kv.Model:
    return model_of(sdf(link("a"), link("b", pose("1 0 0 0 0 0")), joint("j", kind, "a", "b", inside)))


@pytest.mark.parametrize(
    ("kind", "inside", "operation", "coordinates"),
    [
        ("fixed", "", kv.Fixed, 0),
        ("revolute", Z, kv.Revolute, 1),
        ("Continuous", Z, kv.Continuous, 1),
        ("prismatic", Z, kv.Prismatic, 1),
        ("screw", Z, kv.articulations.Screw, 1),
        ("ball", "", kv.articulations.Ball, 4),
        ("universal", Z + "<axis2><xyz>0 1 0</xyz></axis2>", kv.articulations.Universal, 2),
    ],
)
def test_all_sdf_joint_types_are_read(kind, inside, operation, coordinates):
    model = one(kind, inside)
    record = model.articulations["j"]
    assert record.kind == operation.__name__.lower()
    assert len(record.coordinates) == coordinates
    assert at(model, "b", **{str(s): float(str(s).endswith("qw")) for s in record.coordinates})[0, 3] == 1


def test_revolute2_joint_becomes_two_hinges():
    model = one("revolute2", Z + "<axis2><xyz>0 1 1</xyz></axis2>")
    assert [str(s) for s in sorted(model.degrees_of_freedom, key=str)] == ["j/first", "j/second"]
    got = at(model, "b", **{"j/first": 0.3, "j/second": 0.4})
    axis = kv.rotation_z(0.3)({})[:3, :3] @ np.array([0, 1, 1]) / math.sqrt(2)
    np.testing.assert_allclose(got[:3, :3] @ np.array([0, 1, 1]) / math.sqrt(2), axis, atol=1e-14)
    assert at(model, "b", **{"j/first": 0.3, "j/second": 0.0})[0, 0] == pytest.approx(math.cos(0.3))


@pytest.mark.parametrize(
    ("inside", "pitch"),
    [
        ("", 1.0),
        ("<screw_thread_pitch>0.5</screw_thread_pitch>", 0.5),
        ("<thread_pitch>-12.566370614359172</thread_pitch>", 0.5),
        ("<screw_thread_pitch>0.25</screw_thread_pitch><thread_pitch>9</thread_pitch>", 0.25),
    ],
)
def test_screw_pitches_are_read(inside, pitch):
    assert at(one("screw", Z + inside), "b", j=math.tau)[2, 3] == pytest.approx(pitch)


def test_sdf_limits_and_dynamics_are_read():
    axis = (
        "<axis><xyz>0 0 2</xyz><limit><lower>-1</lower><upper>1e16</upper><velocity>2</velocity><effort>3</effort>"
        "</limit><dynamics><damping>0.1</damping><friction>0.2</friction><spring_reference>0.3</spring_reference>"
        "<spring_stiffness>0.4</spring_stiffness></dynamics></axis>"
    )
    model = one("revolute", axis)
    assert model.limits("j") == (-1, math.inf)
    assert model.limits("j:velocity") == (-2, 2)
    assert dict(model.articulations["j"].dynamics) == {
        "effort": 3,
        "damping": 0.1,
        "friction": 0.2,
        "spring_reference": 0.3,
        "spring_stiffness": 0.4,
    }
    open_ = "<axis><xyz>0 0 1</xyz><limit><lower>-inf</lower><upper>inf</upper><velocity>-1</velocity></limit></axis>"
    assert not one("revolute", open_).constraints
    assert not one("continuous", axis.replace("<velocity>2</velocity>", "")).constraints


def test_joint_off_its_child_link_has_a_frame():
    model = model_of(
        sdf(
            link("a"),
            link("b", pose("1 0 0 0 0 0")),
            joint("j", "revolute", "a", "b", pose("-1 0 0 0 0 0") + Z),
        )
    )
    assert set(model.frames) == {"a", "b", "j"}
    np.testing.assert_allclose(at(model, "b", j=math.pi / 2)[:3, 3], [0, 1, 0], atol=1e-15)


def mimic(
    leader: str, multiplier: float, offset: float = 0.0, reference: float = 0.0, axis: str = "axis"
) -> str:
    return (
        f'<mimic joint="{leader}" axis="{axis}"><multiplier>{multiplier}</multiplier><offset>{offset}</offset>'
        f"<reference>{reference}</reference></mimic></axis>"
    )


def test_sdf_mimic_joints_follow():
    model = model_of(
        sdf(
            "".join(link(name) for name in "abcd"),
            joint("c1", "revolute", "c", "d", Z.replace("</axis>", mimic("inner::q", 2, 1, 0.5))),
            joint("u", "universal", "a", "b", Z + "<axis2><xyz>0 1 0</xyz></axis2>"),
            joint("p", "prismatic", "b", "c", Z.replace("</axis>", mimic("u", -3, axis="axis2"))),
            f'<model name="inner">{link("x")}{link("y")}'
            + joint("q", "revolute", "x", "y", Z)
            + "</model>"
            + joint("on", "fixed", "a", "inner::x"),
        )
    )
    assert {str(s) for s in model.degrees_of_freedom} == {"inner/q", "u/first", "u/second"}
    assert model.articulations["p"].position({"u/second": 0.5}) == -1.5
    assert model.articulations["c1"].position({"inner/q": 2.0}) == 2 * (2.0 - 0.5) + 1


def test_an_axis_of_two_may_follow():
    second = f"<axis2><xyz>0 1 0</xyz>{mimic('u', 2)}".replace("</axis>", "</axis2>")
    model = model_of(sdf(link("a"), link("b"), joint("u", "universal", "a", "b", Z + second)))
    assert [str(s) for s in model.degrees_of_freedom] == ["u/first"]
    assert model.articulations["u/second"].position({"u/first": 0.2}) == 0.4


def test_mimic_of_a_joint_that_cannot_move_is_refused():
    static = f'<model name="s"><static>1</static>{link("x")}{link("y")}{joint("q", "revolute", "x", "y", Z)}</model>'
    text = sdf(
        link("a"), link("b"), static, joint("f", "revolute", "a", "b", Z.replace("</axis>", mimic("s::q", 2)))
    )
    with pytest.raises(kv.errors.FormatError, match='it follows "s/q", which cannot move'):
        parse_sdf(text)


GEARS = """<gearbox_reference_body>base</gearbox_reference_body><gearbox_ratio>{}</gearbox_ratio>
<axis><xyz>0 0 1</xyz></axis><axis2><xyz>0 0 {}</xyz></axis2>"""


@pytest.mark.parametrize("sense", [1, -1])
def test_a_gearbox_couples_two_hinges(sense):
    model = model_of(
        sdf(
            "".join(map(link, ("base", "fast", "slow"))),
            joint("one", "revolute", "base", "fast", Z),
            joint("two", "continuous", "base", "slow", Z),
            joint("gears", "gearbox", "fast", "slow", GEARS.format(5, sense)),
        )
    )
    assert [str(s) for s in model.degrees_of_freedom] == ["one"]
    assert model.articulations["two"].position({"one": 0.2}) == -sense


def test_a_gearbox_may_be_the_second_hinge():
    model = model_of(
        sdf(
            "".join(map(link, ("base", "fast", "slow"))),
            joint("one", "revolute", "fast", "base", Z),
            joint("gears", "gearbox", "fast", "slow", GEARS.format(5, 1)),
        )
    )
    assert model.articulations["gears"].kind == "gearbox"
    # The hinge leads from the fast link to the base: its angle is that of the base against the fast link.
    assert model.articulations["gears"].position({"one": 0.2}) == 1.0


def bar(name: str, x: float, y: float, angle: float) -> str:
    return link(name, pose(f"{x} {y} 0 0 0 {angle!r}"))


def parallelogram(second: str) -> str:
    """Crank and rocker of length 1 on a base of length 2, the coupler from one to the other."""
    axis = "<axis><xyz>0 0 1</xyz><limit><lower>-0.5</lower><upper>0.5</upper></limit></axis>"
    return sdf(
        link("base"),
        bar("crank", 0, 0, math.pi / 2),
        bar("coupler", 0, 1, 0.0),
        bar("rocker", 2, 0, math.pi / 2),
        joint("q1", "revolute", "base", "crank", axis),
        second,
        joint("q3", "revolute", "base", "rocker", axis),
        joint("q4", "revolute", "coupler", "rocker", pose("1 0 0 0 0 0") + Z),
    )


def test_sdf_loops_are_closed():
    text = parallelogram(joint("q2", "revolute", "crank", "coupler", Z))
    assert [loop.name for loop in parse_sdf(text).loops] == ["q4"]
    model = model_of(text)
    (free,) = model.degrees_of_freedom
    q = {str(free): 0.3}
    assert str(free) in ("q1", "q3")
    np.testing.assert_allclose(at(model, "rocker", **q)[:3, :3], at(model, "crank", **q)[:3, :3], atol=1e-9)
    np.testing.assert_allclose(at(model, "coupler", **q)[:3, :3], np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", ["q2", "q:2"])
def test_home_positions_of_ball_joints_in_loops_are_set(name):
    text = parallelogram(joint(name, "ball", "crank", "coupler"))
    # A quaternion does not follow, and nobody knows its range.
    with pytest.raises(kv.KineverseError, match=f"needs limits of '{name.replace(':', '%3A')}/qz'"):
        model_of(text)


def test_joints_are_reversed_if_the_root_is_at_their_child():
    text = sdf(
        link("a"),
        link("b"),
        link("c"),
        joint("one", "revolute", "a", "c", Z),
        joint("two", "revolute", "b", "c", pose("1 0 0 0 0 0") + Z),
    )
    scene = parse_sdf(text)
    assert [j.is_reversed for j in scene.joints] == [False, True]
    model = model_of(text)
    rest = np.linalg.inv(at(model, "b", one=0.2, two=0.0)) @ at(model, "c", one=0.2)
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-15)
    b_T_c = np.linalg.inv(at(model, "b", one=0.2, two=0.3)) @ at(model, "c", one=0.2)
    assert math.atan2(b_T_c[1, 0], b_T_c[0, 0]) == pytest.approx(0.3)
