from __future__ import annotations

import numpy as np
import pytest
from mujoco_oracle import Pair, model_of, mujoco
from test_mjcf_kinematics import GEOM, body, mjcf

import kineverse as kv
from kineverse.formats.mjcf import parse_mjcf
from kineverse.model.body import Mesh, Pose

TETRAHEDRON = np.array([[0.1, 0.2, 0.3], [1.4, 0.1, 0.2], [0.3, 1.2, 0.4], [0.2, 0.4, 2.1]])


def obj(vertices: np.ndarray = TETRAHEDRON) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join([*lines, "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"])


def link(text: str, folder: object = "", name: str = "a"):
    scene = parse_mjcf(text, "x.xml", str(folder))
    return next(found for found in scene.links if found.name == name), scene


def asset(more: str, name: str = "m", file: str = "m.obj") -> str:
    return f'<asset><mesh name="{name}" file="{file}" {more}/></asset>'


TURNS = [
    "",
    'refpos="1 2 3"',
    'refpos="1 2 3" refquat=".6 0 0 .8"',
    'refquat="1 1 0 0" scale="1 2 3"',
    'scale="-1 2 3" refpos="0 0 1"',
]


@pytest.mark.parametrize("inertial", ["", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'])
@pytest.mark.parametrize("more", TURNS)
def test_meshes_are_in_the_frames_of_their_files(tmp_path, more, inertial):
    """Vertices of the file, scaled and placed, are where MuJoCo has them, whether it reads the file or not."""
    (tmp_path / "m.obj").write_text(obj())
    text = mjcf(asset(more), f'<worldbody><body name="a">{inertial}<joint/><geom type="mesh" mesh="m" pos="1 2 3" euler="10 20 30"/></body></worldbody>')  # fmt: skip
    (tmp_path / "x.xml").write_text(text)
    engine = mujoco.MjModel.from_xml_path(str(tmp_path / "x.xml"))
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, engine.geom_quat[0])
    expected = engine.mesh_vert @ turn.reshape(3, 3).T + engine.geom_pos[0]
    found, scene = link(text, tmp_path)
    (shape,) = found.body.visuals
    assert isinstance(shape.geometry, Mesh)
    assert (shape.geometry.uri, shape.geometry.folder) == ("m.obj", str(tmp_path))
    here = (TETRAHEDRON * shape.geometry.scale) @ shape.origin.matrix[:3, :3].T + shape.origin.matrix[:3, 3]
    # MuJoCo keeps vertices in single precision, and in an order of its own.
    order = [int(np.argmin(np.linalg.norm(here - vertex, axis=1))) for vertex in expected]
    assert sorted(order) == [0, 1, 2, 3]
    np.testing.assert_allclose(here[order], expected, atol=2e-6)
    assert scene.remarks == ()


def test_inertia_from_a_mesh_needs_the_file(tmp_path):
    text = mjcf(asset(""), f"<worldbody>{body('a', '<joint/>').replace(GEOM, '')}</worldbody>").replace(
        "<joint/>", '<joint/><geom type="mesh" mesh="m"/>'
    )
    without, scene = link(text, tmp_path)
    assert without.body.inertia is None
    assert len(without.body.collisions) == 1
    (remark,) = scene.remarks
    assert remark.startswith(
        'line 2, <mesh name="m"> is not read, where its triangles decide an inertia or a size'
    )
    assert "there is no such file" in remark
    (tmp_path / "m.obj").write_text(obj())
    (tmp_path / "x.xml").write_text(text)
    engine = mujoco.MjModel.from_xml_path(str(tmp_path / "x.xml"))
    found, _ = link(text, tmp_path)
    assert found.body.inertia.mass == engine.body_mass[1]
    (tmp_path / "m.obj").write_text("v 0 0 0\nf 1 1 1")
    broken, scene = link(text, tmp_path)
    assert broken.body.inertia is None
    assert scene.remarks[0].startswith(
        "inertia and sizes that follow from meshes are left out: x.xml, line 2, "
    )


def test_meshes_are_not_blamed_for_other_mistakes(caplog):
    caplog.set_level("INFO", "kineverse")
    with pytest.raises(kv.errors.FormatError, match="mass and inertia of moving bodies"):
        parse_mjcf(mjcf("<worldbody><body><joint/></body></worldbody>"))
    assert caplog.messages == []


def test_free_bodies_are_aligned_with_an_inertia_that_is_known(tmp_path):
    text = mjcf(
        asset(""),
        '<worldbody><body name="a"><freejoint align="true"/><geom type="mesh" mesh="m"/></body></worldbody>',
    )
    found, scene = link(text, tmp_path)
    assert found.pose == Pose()
    assert scene.remarks[-1] == 'line 3, <body name="a"> is not aligned with its inertia, which is not known.'
    (tmp_path / "m.obj").write_text(obj())
    (tmp_path / "x.xml").write_text(text)
    Pair.of_file(tmp_path / "x.xml").compare()


def test_sizes_fitted_to_a_mesh_need_the_file(tmp_path):
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    text = mjcf(
        asset(""),
        f'<worldbody><body name="a">{inertial}<joint/><geom type="box" mesh="m"/></body></worldbody>',
    )
    found, scene = link(text, tmp_path)
    assert found.body.collisions == ()
    assert scene.remarks[-1] == "line 3, <geom> is left out: its size is that of a mesh that is not there."
    (tmp_path / "m.obj").write_text(obj())
    (tmp_path / "x.xml").write_text(text)
    engine = mujoco.MjModel.from_xml_path(str(tmp_path / "x.xml"))
    found, _ = link(text, tmp_path)
    np.testing.assert_allclose(found.body.collisions[0].geometry.size, 2 * engine.geom_size[0], rtol=1e-12)


def test_files_are_where_the_compiler_settings_say():
    for settings, uri in (
        ('meshdir="meshes"', "meshes/sub/part.stl"),
        ('assetdir="assets"', "assets/sub/part.stl"),
        ('assetdir="assets" meshdir="../meshes"', "../meshes/sub/part.stl"),
        ('meshdir="meshes" strippath="true"', "meshes/part.stl"),
        ("", "sub/part.stl"),
    ):
        text = mjcf(
            f"<compiler {settings}/>",
            '<asset><mesh file="sub/part.stl"/></asset>',
            '<worldbody><geom type="mesh" mesh="part"/></worldbody>',
        )
        found, _ = link(text, name="world")
        assert found.body.visuals[0].geometry.uri == uri


def test_primitive_geoms_become_shapes():
    geoms = """<geom type="box" size="1 2 3"/><geom type="sphere" size="1"/><geom type="capsule" size="1 2"/>
    <geom type="cylinder" size="1 2" name="c"/><geom type="ellipsoid" size="1 2 3" rgba="1 0 0 .5"/>"""
    found, _ = link(mjcf(f'<worldbody><body name="a">{geoms}</body></worldbody>'))
    from kineverse.model.body import Box, Capsule, Cylinder, Ellipsoid, Sphere

    assert [shape.geometry for shape in found.body.collisions] == [
        Box((2.0, 4.0, 6.0)),
        Sphere(1.0),
        Capsule(1.0, 4.0),
        Cylinder(1.0, 4.0),
        Ellipsoid((1.0, 2.0, 3.0)),
    ]
    assert found.body.visuals == found.body.collisions
    assert found.body.collisions[3].name == "c"
    assert found.body.collisions[4].color == (1.0, 0.0, 0.0, 0.5)


@pytest.mark.parametrize(
    ("attributes", "seen", "touched"),
    [
        ("", 1, 1),
        ('contype="0" conaffinity="0"', 1, 0),
        ('contype="0"', 1, 1),
        ('group="3"', 0, 1),
        ('group="4" contype="0" conaffinity="0"', 0, 0),
        ('rgba="0 0 0 0"', 0, 1),
    ],
)
def test_geom_groups_and_contacts_decide_visuals_and_collisions(attributes, seen, touched):
    found, _ = link(mjcf(f'<worldbody><body name="a"><geom size="1" {attributes}/></body></worldbody>'))
    assert (len(found.body.visuals), len(found.body.collisions)) == (seen, touched)


def test_colours_are_those_of_materials_unless_a_geom_has_its_own():
    text = mjcf(
        '<asset><texture name="t" file="../no.png"/><material name="m" rgba=".1 .2 .3 .4" texture="t"/></asset>',
        '<worldbody><body name="a"><geom size="1" material="m"/><geom size="1" material="m" rgba="1 0 0 1"/></body></worldbody>',
    )
    found, scene = link(text)
    assert [shape.color for shape in found.body.visuals] == [(0.1, 0.2, 0.3, 0.4), (1.0, 0.0, 0.0, 1.0)]
    assert scene.remarks == ()


def test_planes_and_height_fields_are_left_out_with_a_remark():
    text = mjcf(
        '<asset><hfield name="h" file="h.png" size="1 1 1 1"/></asset>',
        '<worldbody><geom name="floor" type="plane" size="1 1 1"/>\n<geom name="hills" type="hfield" hfield="h"/></worldbody>',
    )
    found, scene = link(text, name="world")
    assert found.body.visuals == ()
    assert scene.remarks == (
        'line 3, <geom name="floor"> is left out: a plane has no end, which no shape here has.',
        'line 4, <geom name="hills"> is left out: a height field is no shape here.',
    )


@pytest.mark.parametrize(
    "inertial",
    [
        '<inertial pos=".1 .2 .3" euler="10 20 30" mass="2" diaginertia="3 2 1.5"/>',
        '<inertial pos=".1 .2 .3" mass="2" fullinertia="3 2 2.5 .1 .2 .3"/>',
        "",
    ],
)
def test_inertia_is_that_of_mujoco(inertial):
    """The tensor in the axes of the body, by MuJoCo's mass matrix of a ball joint at the origin."""
    text = mjcf(
        f'<worldbody><body name="a"><joint type="ball"/>{inertial}<geom type="box" size=".1 .2 .3" pos=".1 0 0" euler="10 0 30"/></body></worldbody>'
    )
    pair = Pair.of_text(text)
    mujoco.mj_forward(pair.engine, pair.data)
    full = np.zeros((3, 3))
    mujoco.mj_fullM(pair.engine, pair.data, full) if mujoco.mj_version() >= 4000000 else mujoco.mj_fullM(
        pair.engine, full, pair.data.qM
    )
    inertia = pair.model.bodies["a"].inertia
    pose: Pose = inertia.origin
    xx, xy, xz, yy, yz, zz = inertia.tensor
    turn, centre = pose.matrix[:3, :3], pose.matrix[:3, 3]
    about_centre = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    about_origin = about_centre + inertia.mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    np.testing.assert_allclose(about_origin, full, atol=1e-12)


def test_joint_dynamics_are_data():
    joints = """<joint name="h" stiffness="3" springref="20" damping="2" frictionloss=".5" armature=".1"/>
    <joint name="s" type="slide" actuatorfrcrange="-5 8"/><joint name="m"/><joint name="p"/><joint name="u"/><joint name="b" type="slide"/>"""
    actuators = """<actuator><motor joint="s" gear="3" ctrlrange="-4 4"/><motor joint="m" gear="3" ctrlrange="-2 1"/>
    <position joint="p" kp="7" forcerange="-4 4" gear="2"/><motor joint="u"/><motor joint="b" gear="-2" forcerange="-1 3"/>
    <muscle joint="u" range=".7 1.1"/></actuator>"""
    # MuJoCo itself fails here, since such a muscle cannot be as long as it is said to be.
    model = model_of(parse_mjcf(mjcf(f"<worldbody>{body('a', joints)}</worldbody>", actuators)))
    assert {name: dict(record.dynamics) for name, record in model.articulations.items()} == {
        "h": {"damping": 2.0, "friction": 0.5, "armature": 0.1, "spring_stiffness": 3.0, "spring_reference": pytest.approx(np.radians(20))},
        "s": {"effort": 8.0},
        "m": {"effort": 6.0},
        "p": {"effort": 8.0},
        "u": {},
        "b": {"effort": 6.0},
    }  # fmt: skip


HOMED = mjcf(
    f"""<worldbody>{body("a", '<joint name="h" ref="20" range="-90 90"/>' + body("b", '<joint name="q" type="ball"/>'))}
    {body("f", '<freejoint name="f"/>', 'pos="1 2 3" euler="0 0 90"')}</worldbody>""",
    "{}",
)


def test_home_position_is_that_of_the_file():
    pair = Pair.of_text(HOMED.format(""))
    state = pair.model.default_state()
    assert state[kv.position("h")] == pytest.approx(np.radians(20))
    pair.place(dict(state))
    np.testing.assert_allclose(pair.data.qpos, pair.engine.qpos0, atol=1e-15)


def test_home_position_is_the_key_home():
    key = '<keyframe><key name="other" qpos="0 1 0 0 0 0 0 0 1 0 0 0"/><key name="home" qpos=".5 .6 .8 0 0 4 5 6 .5 .5 .5 .5" ctrl=""/></keyframe>'
    pair = Pair.of_text(HOMED.format(key))
    pair.place(dict(pair.model.default_state()))
    np.testing.assert_allclose(pair.data.qpos, [0.5, 0.6, 0.8, 0, 0, 4, 5, 6, 0.5, 0.5, 0.5, 0.5], atol=1e-15)


def test_key_of_another_size_is_left_out():
    soft = '<worldbody><flexcomp name="f" type="grid" count="2 2 1" dim="2" mass="1" radius=".01"/><body><joint/><geom size="1"/></body></worldbody>'
    scene = parse_mjcf(mjcf(soft, '<keyframe><key name="home" qpos="' + "0 " * 13 + '"/></keyframe>'))
    assert scene.remarks[0] == 'line 2, <flexcomp name="f"> is left out: what bends has no frames here.'
    assert scene.remarks[1] == 'the key "home" does not fit the joints that are read, and is left out.'
