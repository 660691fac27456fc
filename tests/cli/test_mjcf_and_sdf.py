"""MJCF and SDF files on the command line and in the viewer."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.view.meshes import mesh_geometry

DOOR = """<mujoco>
<asset><mesh name="knob" file="knob.obj" refpos="0 0 1"/></asset>
<worldbody>
  <geom type="plane" size="1 1 1"/>
  <body name="door">
    <joint name="hinge" range="0 90" stiffness="2"/>
    <geom type="box" size=".1 .2 .3"/>
    <geom type="mesh" mesh="knob" pos="0 0 2" mass="0"/>
  </body>
</worldbody>
</mujoco>"""

LAMP = """<sdf version="1.12"><world name="w"><model name="lamp"><static>true</static><link name="foot"/></model>
<model name="arm"><link name="base"><visual name="v"><geometry><cone><radius>1</radius><length>2</length></cone>
</geometry></visual></link><link name="tip"><visual name="v"><pose>0 0 1 0 0 0</pose><geometry><ellipsoid>
<radii>1 2 3</radii></ellipsoid></geometry></visual></link>
<joint name="fixed" type="fixed"><parent>world</parent><child>base</child></joint>
<joint name="hinge" type="revolute"><parent>base</parent><child>tip</child><axis><xyz>0 0 1</xyz></axis></joint>
</model></world></sdf>"""


@pytest.fixture
def door(tmp_path):
    path = tmp_path / "door.xml"
    path.write_text(DOOR)
    (tmp_path / "knob.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
    )
    return path


@pytest.fixture
def lamp(tmp_path):
    path = tmp_path / "lamp.world"
    path.write_text(LAMP)
    return path


@pytest.fixture
def files(door, lamp):
    return {"door": door, "lamp": lamp}


@pytest.mark.parametrize(
    ("file", "joint", "frame", "prefix"),
    [("door", "hinge  rad       0  1.571", "door", ""), ("lamp", "arm/hinge", "tip", "arm/")],
)
def test_info_and_fk(run, files, file, joint, frame, prefix):
    status, out, _ = run("info", files[file])
    assert status == 0
    assert joint in out
    status, out, _ = run("fk", files[file], prefix + frame, "--set", f"{prefix}hinge=90deg")
    assert status == 0
    assert f"{frame} in world" in out


@pytest.mark.parametrize(
    ("file", "before", "after", "says"),
    [
        ("door", "stiffness", "stiffnes", 'door.xml, line 6, <joint name="hinge">: MuJoCo refuses it'),
        ("lamp", "<parent>base", "<parent>bass", "Did you mean 'base'?"),
    ],
)
def test_an_unsupported_file_is_an_error_of_one_line(run, files, file, before, after, says):
    files[file].write_text(files[file].read_text().replace(before, after))
    status, out, err = run("info", files[file])
    assert status != 0
    assert out == ""
    assert says in err
    assert "Traceback" not in err


def test_meshes_are_drawn(door):
    """The mesh is drawn at the frame of its file: lowered by its reference, raised by its geom."""
    shapes = kv.load(door).bodies["door"].visuals
    assert [shape.origin.matrix[2, 3] for shape in shapes] == [0.0, 1.0]
    assert np.diff(mesh_geometry(shapes[1].geometry).bounds, axis=0)[0].tolist() == [1.0, 1.0, 1.0]


def test_shapes_become_surfaces(lamp):
    model = kv.load(lamp)
    surfaces = {name: mesh_geometry(body.visuals[0].geometry) for name, body in model.bodies.items()}
    sizes = {name: np.diff(surface.bounds, axis=0)[0].round(6).tolist() for name, surface in surfaces.items()}
    assert sizes == {"arm/base": [2, 2, 2], "arm/tip": [2, 4, 6]}
