"""Mesh files that draw their parts many times over are refused before they are read."""

from __future__ import annotations

import base64
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from kineverse.errors import FormatError
from kineverse.geometry.mesh_files import read_mesh
from kineverse.model.body import Mesh

COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset><unit meter="1"/></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="9">0 0 0 1 0 0 0 1 0
</float_array><technique_common><accessor source="#pa" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="1">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>
<library_nodes>{}</library_nodes><library_visual_scenes><visual_scene id="s"><node><instance_node url="#n0"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
THREEMF = """<?xml version="1.0"?>
<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>
<object id="g" type="model"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>
<vertex x="0" y="1" z="0"/></vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>
{}</resources><build><item objectid="n0"/></build></model>"""


def collada(depth: int, leaf: str = '<instance_geometry url="#g"/>') -> str:
    """Return a COLLADA in which each node instances the next one twice."""
    twice = '<instance_node url="#n{0}"/><instance_node url="#n{0}"/>'
    nodes = [f'<node id="n{k}">{twice.format(k + 1)}</node>' for k in range(depth)]
    return COLLADA.format("".join([f'<node id="n{depth}">{leaf}</node>', *reversed(nodes)]))


def gltf(count: int, **accessor: int) -> str:
    triangle = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32).tobytes()
    data = "data:application/octet-stream;base64," + base64.b64encode(triangle).decode()
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0, 1]}],
            "nodes": [{"mesh": 0}, {"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{"componentType": 5126, "count": count, "type": "VEC3", **accessor}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"byteLength": 36, "uri": data}],
        }
    )


def write(folder: Path, name: str, text: str, encoding: str = "utf-8") -> Mesh:
    inside = {".3mf": "3D/3dmodel.model", ".zae": "a.dae"}.get(name[-4:])
    if inside is not None:
        with zipfile.ZipFile(folder / name, "w") as packed:
            packed.writestr(inside, text)
    else:
        text = text.replace('<?xml version="1.0"?>', f'<?xml version="1.0" encoding="{encoding}"?>')
        (folder / name).write_text(text, encoding=encoding)
    return Mesh(name, folder=str(folder))


def threemf(depth: int) -> str:
    """Return a 3MF in which each object has the next one twice as a component."""
    objects = []
    for k in range(depth):
        part = '<component objectid="{}"/>'.format(f"n{k + 1}" if k + 1 < depth else "g")
        objects.append(f'<object id="n{k}"><components>{2 * part}</components></object>')
    return THREEMF.format("".join(objects))


@pytest.mark.parametrize(
    ("name", "text", "triangles"),
    [("a.dae", collada(4), 16), ("a.3mf", threemf(3), 8), ("a.gltf", gltf(3, bufferView=0), 2)],
)
def test_parts_that_are_drawn_several_times_are_read(
    name: str, text: str, triangles: int, tmp_path: Path
) -> None:
    pytest.importorskip("collada")
    assert len(read_mesh(write(tmp_path, name, text)).faces) == triangles


@pytest.mark.parametrize(
    ("name", "text", "encoding"),
    [
        ("a.dae", collada(30), "utf-8"),
        ("a.dae", collada(30), "utf-16"),
        ("a.zae", collada(30), "utf-8"),
        ("a.dae", collada(30, leaf=""), "utf-8"),  # nodes without triangles take as long
        ("a.3mf", threemf(30), "utf-8"),
        ("a.gltf", gltf(10**9), "utf-8"),  # all zeros
    ],
    ids=["collada", "utf-16", "zae", "empty", "3mf", "gltf"],
)
def test_files_that_would_draw_without_end_are_refused(
    name: str, text: str, encoding: str, tmp_path: Path
) -> None:
    pytest.importorskip("collada")
    with pytest.raises(FormatError, match=r"draws its parts so often that all of them would be .* MiB"):
        read_mesh(write(tmp_path, name, text, encoding))


def test_a_node_that_draws_itself_is_refused(tmp_path: Path) -> None:
    text = collada(1).replace(
        '<node id="n1"><instance_geometry url="#g"/>', '<node id="n1"><instance_node url="#n0"/>'
    )
    with pytest.raises(FormatError, match="a part of it draws itself"):
        read_mesh(write(tmp_path, "a.dae", text))


def test_long_files_that_draw_nothing_twice_are_not_refused(tmp_path: Path) -> None:
    from kineverse.geometry.mesh_files import expanded_size

    nodes = "".join(f'<node id="m{k}"><instance_geometry url="#g"/></node>' for k in range(1000))
    write(tmp_path, "a.dae", collada(0).replace('<node><instance_node url="#n0"/></node>', nodes))
    once = 9 * 2 + 5
    assert expanded_size(tmp_path / "a.dae") < 1000 * (once + 2)
