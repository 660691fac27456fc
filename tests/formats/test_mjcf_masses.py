"""Masses, centres and moments of all bodies are those of MuJoCo, whatever decides them."""

from __future__ import annotations

import numpy as np
import pytest
from mujoco_oracle import mujoco

from kineverse.errors import FormatError
from kineverse.formats.isolation import IsolatedCallError, call_isolated
from kineverse.formats.mjcf import parse_mjcf

MESH = 'vertex="0 0 0  1 0 0  0 1 0  0 0 1" face="0 2 1 0 1 3 0 3 2 1 2 3"'
GEAR = (
    '<extension><plugin plugin="mujoco.sdf.gear"><instance name="t"><config key="diameter" value="{}"/>'
    "</instance></plugin></extension>"
)
TORUS = GEAR.replace("gear", "torus").replace(
    '<config key="diameter" value="{}"/>',
    '<config key="radius1" value="0"/><config key="radius2" value="0"/>',
)
INERTIAL = '<inertial mass="3" pos=".1 .2 .3" diaginertia=".1 .2 .25" euler="10 20 30"/>'


def mjcf(geoms: str, assets: str = "", more: str = "") -> str:
    return (
        f"<mujoco>{more}<asset>{assets}</asset><worldbody>"
        f'<body name="a" pos="1 2 3"><freejoint/>{geoms}<body name="b" euler="10 20 30"><joint/>'
        f'<geom size=".1 .2 .3" type="box" pos=".1 0 0"/></body></body></worldbody></mujoco>'
    )


def shape(kind: str, reference: str, more: str = "") -> str:
    return f'<geom type="{kind}" {reference} {more}/>'


def builtin(kind: str, params: str, more: str = "") -> str:
    return f'<mesh name="m" builtin="{kind}" params="{params}" {more}/>'


HILLS = '<hfield name="h" nrow="3" ncol="2" size="1 2 3 4" elevation="0 1 0 1 0 1"/>'
FIELD, OF_MESH = shape("hfield", 'hfield="h"'), shape("mesh", 'mesh="m"')
PLUGGED = '<mesh name="m" {}><plugin instance="t"/></mesh>'
IN_PLACE = (
    '<mesh name="m"><plugin plugin="mujoco.sdf.gear"><config key="diameter" value="2"/></plugin></mesh>'
)
BALL = '<geom size=".1"/>'

CASES = {
    "height field": mjcf(FIELD, HILLS),
    "height field and ball": mjcf(FIELD + BALL, HILLS),
    "height field with a mass": mjcf(shape("hfield", 'hfield="h"', 'mass="2"'), HILLS),
    "height field of a class": mjcf(FIELD, HILLS, '<default><geom density="3"/></default>'),
    **{
        f"builtin {kind}": mjcf(OF_MESH, builtin(kind, params, 'scale=".1 .2 .3"'))
        for kind, params in [
            ("sphere", "2"), ("hemisphere", "3"), ("cone", "8 .5"), ("supersphere", "8 1 1"),
            ("supertorus", "10 .3 1 1"),
        ]
    },
    "builtin shell": mjcf(OF_MESH, builtin("cone", "8 .5", 'inertia="shell"')),
    "builtin turned": mjcf(OF_MESH, builtin("cone", "8 .5", 'refpos="1 0 0" refquat=".6 .8 0 0"')),
    "fitted to builtin": mjcf(shape("capsule", 'mesh="m"'), builtin("supersphere", "8 1 1", 'scale="1 2 3"')),
    "plugin on the geom": mjcf(
        '<geom type="sdf" mesh="m"><plugin instance="t"/></geom>', PLUGGED.format(""), GEAR.format(2)
    ),
    "plugin in place": mjcf(
        shape("sdf", 'mesh="m"'), IN_PLACE, '<extension><plugin plugin="mujoco.sdf.gear"/></extension>'
    ),
    "distance field of a mesh": mjcf(shape("sdf", 'mesh="m"'), f'<mesh name="m" {MESH}/>'),
    "legacy inertia": mjcf(OF_MESH, f'<mesh name="m" inertia="legacy" {MESH}/>'),
    "exact inertia": mjcf(OF_MESH, f'<mesh name="m" inertia="exact" {MESH}/>'),
    "geom shell": mjcf('<geom size=".1 .2 .3" type="box" shellinertia="true"/>'),
    "mass": mjcf('<geom size=".1 .2 .3" type="box" mass="2"/><geom size=".1" mass="0" pos="1 0 0"/>'),
    "density": mjcf('<geom size=".1" density="2" fromto="0 0 0 1 0 0" type="capsule"/>' + BALL),
    "inertial": mjcf(INERTIAL + FIELD, HILLS),
    "inertial overruled": mjcf(INERTIAL + FIELD, HILLS, '<compiler inertiafromgeom="true"/>'),
    "inertial required": mjcf(INERTIAL, "", '<compiler inertiafromgeom="auto" boundmass="5" boundinertia="1"/>'),
    "groups": mjcf(BALL + '<geom size="1" group="4"/>', "", '<compiler inertiagrouprange="0 3"/>'),
    "total mass": mjcf(FIELD + BALL, HILLS, '<compiler settotalmass="7"/>'),
    "balanced": mjcf(
        '<inertial mass="1" pos="0 0 0" diaginertia="1 1 3"/>' + BALL, "", '<compiler balanceinertia="true"/>'
    ),
    "aligned": mjcf(shape("sdf", 'mesh="m"'), PLUGGED.format(""), GEAR.format(2) + '<compiler alignfree="true"/>'),
    "discarded visuals": mjcf(
        BALL + '<geom size=".2" pos="0 1 0" contype="0" conaffinity="0"/>', "", '<compiler discardvisual="true"/>'
    ),
}  # fmt: skip


def assert_bodies_are_those_of_mujoco(text: str, tolerance: float = 2e-6) -> list[str]:
    """Compare mass, centre and tensor of all bodies; return the remarks. Meshes are single precision."""
    engine, scene = mujoco.MjModel.from_xml_string(text), parse_mjcf(text, "x.xml")
    for link in scene.links[1:]:
        number = engine.body(link.name).id
        mass, moments = engine.body_mass[number], engine.body_inertia[number]
        assert link.body.inertia is not None
        assert link.body.inertia.mass == pytest.approx(mass, rel=tolerance)
        size = max(1e-9, abs(engine.body_ipos[number]).max(), np.sqrt(moments.max() / mass))
        place = link.body.inertia.origin.matrix
        np.testing.assert_allclose(place[:3, 3], engine.body_ipos[number], rtol=0, atol=tolerance * size)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, engine.body_iquat[number])
        theirs = turn.reshape(3, 3) @ np.diag(moments) @ turn.reshape(3, 3).T
        xx, xy, xz, yy, yz, zz = link.body.inertia.tensor
        ours = place[:3, :3] @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ place[:3, :3].T
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2 * tolerance * moments.max())
    return list(scene.remarks)


SLOW = ("aligned", "plugin on the geom")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n in SLOW else ()) for n in CASES]
)
def test_bodies_have_the_masses_that_mujoco_computes(name: str):
    assert_bodies_are_those_of_mujoco(CASES[name])


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (TORUS, "its process ended with"),  # which MuJoCo itself does not survive
        (GEAR.format("abc"), "invalid attribute value for 'diameter'"),
        (GEAR.replace("gear", "cog"), "plugin mujoco.sdf.cog not found"),
    ],
    ids=["crash", "settings", "unknown"],
)
def test_a_plugin_that_makes_no_mesh_leaves_the_inertia_out(settings: str, reason: str):
    scene = parse_mjcf(mjcf(shape("sdf", 'mesh="m"') + BALL, PLUGGED.format(""), settings), "x.xml")
    assert [link.body.inertia is None for link in scene.links] == [True, True, False]
    assert any("has no inertia here" in r and reason in r for r in scene.remarks)
    assert len(scene.links[1].body.collisions) == 1  # the ball


def test_meshes_of_plugins_that_decide_nothing_are_not_made(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("kineverse.formats.mjcf.meshes.make_plugin_meshes", None)
    text = mjcf(INERTIAL + shape("sdf", 'mesh="m"'), PLUGGED.format(""), GEAR.format(2))
    assert_bodies_are_those_of_mujoco(text)


def test_generated_meshes_of_too_many_triangles_are_left_out():
    scene = parse_mjcf(mjcf(OF_MESH + BALL, builtin("supersphere", "100000 1 1")), "x.xml")
    assert scene.links[1].body.inertia is None
    assert any("too many triangles" in r for r in scene.remarks)


def fail() -> None:
    raise ValueError


def test_an_isolated_call_returns_its_result_or_one_error():
    assert call_isolated("math", "hypot", 3, 4) == 5
    with pytest.raises(IsolatedCallError, match="ended with signal"):
        call_isolated("os", "abort")
    with pytest.raises(IsolatedCallError, match="GiB"):
        call_isolated("builtins", "bytearray", 1 << 40)


def test_actuators_and_keys_are_read_from_attached_models_too(tmp_path):
    (tmp_path / "arm.xml").write_text(
        '<mujoco model="arm"><worldbody><body name="a"><joint name="j"/><geom size=".1"/></body></worldbody>'
        '<actuator><motor joint="j" ctrlrange="-2 2" ctrllimited="true" gear="3"/></actuator></mujoco>'
    )
    text = (
        '<mujoco><asset><model name="arm" file="arm.xml"/></asset><worldbody><attach model="arm" prefix="l_"/>'
        '<body name="b"><joint name="k"/><geom size=".1"/></body></worldbody>'
        '<keyframe><key name="home" qpos=".1 .2"/></keyframe>'
        '<actuator><motor joint="k" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>'
    )
    scene = parse_mjcf(text, "x.xml", str(tmp_path))
    joints = {joint.name: joint for link in scene.links for joint in link.joints}
    assert {name: dict(joint.dynamics)["effort"] for name, joint in joints.items()} == {"l_j": 6.0, "k": 1.0}
    assert {name: joint.home for name, joint in joints.items()} == {"l_j": (0.1,), "k": (0.2,)}


def test_errors_after_actuators_name_their_lines():
    text = (
        '<mujoco>\n<actuator>\n<motor joint="j"/>\n</actuator>\n<worldbody>\n<body name="a"><joint name="j"/>'
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(FormatError, match=r'x.xml, line 6, <body name="a">: MuJoCo refuses it'):
        parse_mjcf(text, "x.xml")
