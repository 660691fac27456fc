"""SDF files on the command line and in the viewer."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.cli import main
from kineverse.view.meshes import mesh_geometry

LAMP = """<sdf version="1.12"><world name="w"><model name="lamp"><static>true</static><link name="foot"/></model>
<model name="arm"><link name="base"><visual name="v"><geometry><cone><radius>1</radius><length>2</length></cone>
</geometry></visual></link><link name="tip"><visual name="v"><pose>0 0 1 0 0 0</pose><geometry><ellipsoid>
<radii>1 2 3</radii></ellipsoid></geometry></visual></link>
<joint name="fixed" type="fixed"><parent>world</parent><child>base</child></joint>
<joint name="hinge" type="revolute"><parent>base</parent><child>tip</child><axis><xyz>0 0 1</xyz></axis></joint>
</model></world></sdf>"""


@pytest.fixture
def lamp(tmp_path):
    path = tmp_path / "lamp.world"
    path.write_text(LAMP)
    return path


def test_info_and_fk(lamp, capsys):
    assert main(["info", str(lamp)]) == 0
    assert "arm/hinge" in capsys.readouterr().out
    assert main(["fk", str(lamp), "arm/tip", "--set", "arm/hinge=90deg"]) == 0
    assert "tip in world" in capsys.readouterr().out


def test_an_unsupported_file_is_an_error_of_one_line(lamp, capsys):
    lamp.write_text(LAMP.replace("<parent>base", "<parent>bass"))
    assert main(["info", str(lamp)]) != 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Did you mean 'base'?" in captured.err
    assert "Traceback" not in captured.err


def test_shapes_become_surfaces(lamp):
    model = kv.load(lamp)
    surfaces = {name: mesh_geometry(body.visuals[0].geometry) for name, body in model.bodies.items()}
    sizes = {name: np.diff(surface.bounds, axis=0)[0].round(6).tolist() for name, surface in surfaces.items()}
    assert sizes == {"arm/base": [2, 2, 2], "arm/tip": [2, 4, 6]}
