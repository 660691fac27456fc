"""MJCF files on the command line and in the viewer."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.cli import main
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


@pytest.fixture
def door(tmp_path):
    path = tmp_path / "door.xml"
    path.write_text(DOOR)
    (tmp_path / "knob.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
    )
    return path


def test_info_and_fk(door, capsys):
    assert main(["info", str(door)]) == 0
    assert "hinge  rad       0  1.571" in capsys.readouterr().out
    assert main(["fk", str(door), "door", "--set", "hinge=90deg"]) == 0
    assert "door in world" in capsys.readouterr().out


def test_an_unsupported_file_is_an_error_of_one_line(door, capsys):
    door.write_text(DOOR.replace("stiffness", "stiffnes"))
    assert main(["info", str(door)]) != 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert 'door.xml, line 6, <joint name="hinge">: MuJoCo refuses it' in captured.err
    assert "Traceback" not in captured.err


def test_meshes_are_drawn(door):
    """The mesh is drawn at the frame of its file: lowered by its reference, raised by its geom."""
    shapes = kv.load(door).bodies["door"].visuals
    assert [shape.origin.matrix[2, 3] for shape in shapes] == [0.0, 1.0]
    assert np.diff(mesh_geometry(shapes[1].geometry).bounds, axis=0)[0].tolist() == [1.0, 1.0, 1.0]
