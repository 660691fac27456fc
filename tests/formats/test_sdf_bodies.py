"""Shapes, colours and inertia of SDF links."""

from __future__ import annotations

import pytest
from test_sdf_pose_graph import link, model_of, pose, sdf

import kineverse as kv
from kineverse.formats.sdf import parse_sdf
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Inertia, Mesh, Sphere


def shape(form: str, inside: str = "", tag: str = "visual") -> str:
    return f'<{tag} name="s"><geometry>{form}</geometry>{inside}</{tag}>'


ROUND = "<radius>1</radius><length>2</length>"


@pytest.mark.parametrize(
    ("form", "geometry"),
    [
        ("<box><size>1 2 3</size></box>", Box((1, 2, 3))),
        ("<sphere><radius>1</radius></sphere>", Sphere(1)),
        (f"<cylinder>{ROUND}</cylinder>", Cylinder(1, 2)),
        (f"<capsule>{ROUND}</capsule>", Capsule(1, 2)),
        (f"<cone>{ROUND}</cone>", Cone(1, 2)),
        ("<ellipsoid><radii>1 2 3</radii></ellipsoid>", Ellipsoid((1, 2, 3))),
        (
            "<mesh><uri>model://a/b.dae</uri><scale>2 2 2</scale></mesh>",
            Mesh("model://a/b.dae", (2, 2, 2), "/f"),
        ),
    ],
)
def test_sdf_shapes_are_read(form, geometry):
    body = parse_sdf(sdf(link("l", shape(form) + shape(form, tag="collision"))), folder="/f").links[0].body
    assert [s.geometry for s in (*body.visuals, *body.collisions)] == [geometry, geometry]


@pytest.mark.parametrize("tag", ["plane", "heightmap", "polyline", "image"])
def test_unsupported_sdf_shapes_are_left_out(tag):
    scene = parse_sdf(sdf(link("l", shape(f"<{tag}><size>1 1</size></{tag}>"))))
    assert not scene.links[0].body.visuals
    assert any(f"<{tag}> cannot be said here" in remark for remark in scene.remarks)


def test_sdf_poses_colours_and_inertia_are_read():
    text = sdf(
        '<frame name="f">' + pose("5 0 0 0 0 0") + "</frame>",
        link(
            "l",
            pose("1 0 0 0 0 0")
            + shape(
                "<sphere><radius>1</radius></sphere>",
                pose("0 1 0 0 0 0", 'relative_to="f"')
                + "<transparency>0.5</transparency><material><diffuse>1 0.5 0</diffuse></material>",
            )
            + "<inertial><mass>2</mass><pose>0 0 3 0 0 0</pose><inertia><ixx>1</ixx><iyz>0.5</iyz></inertia></inertial>",
        ),
    )
    body = model_of(text).bodies["l"]
    (seen,) = body.visuals
    assert seen.origin.matrix[:3, 3].tolist() == [4, 1, 0]
    assert seen.color == (1, 0.5, 0, 0.5)
    assert body.inertia == Inertia(
        2, (1, 0, 0, 1, 0.5, 1), kv.model.Pose.from_matrix(kv.translation(0, 0, 3))
    )
