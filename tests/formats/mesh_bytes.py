"""A tetrahedron in the file formats of meshes."""

from __future__ import annotations

import struct

CORNERS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.3))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def tetrahedron() -> bytes:
    """Return a binary STL."""
    data = b"\0" * 80 + struct.pack("<I", len(FACES))
    for face in FACES:
        corners = [c for k in face for c in CORNERS[k]]
        data += struct.pack("<12fH", 0.0, 0.0, 0.0, *corners, 0)
    return data


def tetrahedron_as_text() -> bytes:
    """Return an STL of text."""
    lines = ["solid t"]
    for face in FACES:
        corners = ["vertex {} {} {}".format(*CORNERS[k]) for k in face]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid t", ""]).encode()


def tetrahedron_as_ply() -> bytes:
    """Return a PLY of text."""
    head = f"""ply
format ascii 1.0
element vertex {len(CORNERS)}
property float x
property float y
property float z
element face {len(FACES)}
property list uchar int vertex_indices
end_header
"""
    body = ["{} {} {}".format(*corner) for corner in CORNERS] + ["3 {} {} {}".format(*f) for f in FACES]
    return (head + "\n".join(body) + "\n").encode()


def tetrahedron_as_collada(metres: float = 1.0) -> bytes:
    """Return a COLLADA file in some unit."""
    points = " ".join(f"{c / metres:g}" for corner in CORNERS for c in corner)
    indices = " ".join(str(k) for face in FACES for k in face)
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="unit" meter="{metres:g}"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{points}</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
""".encode()
